"""Kill the fit of a tiled map at random moments and restart it until it is complete.

    python scripts/soak_tiles.py --kills 20 --seed 0

Every other kill stops all ranks of a job under torchrun; the others stop one rank, and torchrun then
stops the rest. After each kill, the previous map must be valid, and at most the tiles in progress may
be lost. At the end of a round, the files must equal those of an uninterrupted job. Exit code 0 if all
checks pass.
"""

from __future__ import annotations

import argparse
import contextlib
import filecmp
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from lardhm_torch import simulate_room
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.manifest import read_manifest
from lardhm_torch.tiles.routing import TilingConfig, tile_scans

EDGE, RANKS = 1.0, 2
PATIENCE = 300.0  # [s] for a job that nobody kills


def make_folder(folder: Path, rays: int) -> int:
    """A room of small tiles, routed; how many there are."""
    scans = simulate_room(num_rays=rays)
    pieces = [scans.select(torch.arange(start, len(scans), 4)) for start in range(4)]
    return len(tile_scans(pieces, folder, TilingConfig(edge=EDGE)).cores)


def start(folder: Path) -> subprocess.Popen[bytes]:
    """A fit under torchrun, in a session of its own."""
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(RANKS)]
    job = ["-m", "lardhm_torch.cli", "fit-tiles", str(folder)]
    return subprocess.Popen(
        [sys.executable, *command, *job],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def ranks_of(process: subprocess.Popen[bytes]) -> list[int]:
    """The processes that torchrun started."""
    listing = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    return [int(pid) for pid in listing.read_text().split()] if listing.exists() else []


def finished(folder: Path) -> set[str]:
    """What need not be done again: clusters of tiles, fitted tiles, tiles taken over."""
    marks = {f"clusters {path.name}" for path in (folder / "clusters").glob("[!.]*")}
    marks |= {f"fitted {path.stem}" for path in (folder / "fitted").glob("[!.]*.json")}
    return marks | {f"fitted {path.stem}" for path in (folder / "tiles").glob("[!.]*.safetensors")}


def kill(process: subprocess.Popen[bytes], everyone: bool, rng: random.Random) -> None:
    """All of a job's processes at once, or one of its ranks."""
    with contextlib.suppress(ProcessLookupError):
        ranks = ranks_of(process)
        if everyone or not ranks:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            os.kill(rng.choice(ranks), signal.SIGKILL)
    process.communicate(timeout=PATIENCE)


def run_killed(folder: Path, kills: int, rng: random.Random) -> int:
    """Fit with up to so many kills; how many there were. The last job is let finish."""
    before, killed, spread = read_manifest(folder), 0, 1.0
    done = finished(folder)
    while killed < kills:
        process = start(folder)
        while process.poll() is None and finished(folder) == done:
            time.sleep(0.005)  # until the ranks have started
        try:
            process.communicate(timeout=rng.uniform(0.0, spread))
        except subprocess.TimeoutExpired:
            kill(process, everyone=killed % 2 == 0, rng=rng)
        if process.returncode == 0:
            return killed
        killed += 1
        now = finished(folder)
        if not done <= now:
            sys.exit(f"kill {killed}: finished work was lost: {sorted(done - now)[:5]}")
        if read_manifest(folder) != before:
            break  # killed after the tiles were moved into place
        print(
            f"kill {killed}: {len(now)} pieces of work are done, {len(now - done)} new", flush=True
        )
        done = now
    process = start(folder)
    _, errors = process.communicate(timeout=PATIENCE)
    if process.returncode:
        sys.exit(f"the job after kill {killed} failed: {errors.decode()[-500:]}")
    return killed


def compare(folder: Path, whole: Path) -> None:
    """Exit unless both folders hold the same files."""
    for name in ("manifest.json", "tiles", "clusters", "samples"):
        names = sorted(path.name for path in (whole / name).glob("*")) or [""]
        if names != (sorted(path.name for path in (folder / name).glob("*")) or [""]):
            sys.exit(f"{folder / name} holds other files than that of a job that nobody killed")
        for file in names:
            if not filecmp.cmp(folder / name / file, whole / name / file, shallow=False):
                sys.exit(f"{folder / name / file} differs from that of a job that nobody killed")


def main() -> None:
    """Kill, go on, compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument(
        "--rays", type=int, default=30_000, help="rays of the room (default: 30000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        whole = Path(name) / "whole"
        tiles = make_folder(whole, arguments.rays)
        fit_tiles(whole)
        killed, rounds = 0, 0
        while killed < arguments.kills:
            folder = Path(name) / f"killed_{rounds}"
            make_folder(folder, arguments.rays)
            killed += run_killed(folder, min(4, arguments.kills - killed), rng)
            compare(folder, whole)
            rounds += 1
    print(f"{killed} kills in {rounds} jobs of {tiles} tiles: all went on and gave the same map")


if __name__ == "__main__":
    main()
