"""Kill an incremental fit at random moments and resume it until it is complete.

    python scripts/soak_kills.py --kills 50 --seed 0

Every run is killed with SIGKILL after a random time and continued with --resume. After each kill, the
map file must be valid, and at most the current scan may be lost. At the end, the accuracy of the map
must equal that of an uninterrupted run. Exit code 0 if all checks pass.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    resume_stream,
    save_scans,
    simulate_room,
    split_rays,
)
from lardhm_torch.evaluation.held_out import evaluate
from lardhm_torch.scans import concatenate_scans

TOLERANCE = 0.005  # largest difference of accuracy
STREAM = Path(__file__).with_name("stream.py")


def make_scans(folder: Path, count: int, rays: int) -> tuple[list[Path], Scans]:
    """Files of one scan each, and test rays: the simulated room, seen ``count`` times."""
    files, tests = [], []
    for number in range(count):
        room = simulate_room(num_rays=rays, seed=number)
        scan = room.select(room.scan_id == number % room.num_scans)
        train, test = split_rays(scan, 0.8, seed=number)
        files.append(folder / f"scan_{number}.npz")
        of_all = torch.zeros_like(train.scan_id)
        place = train.origins[train.scan_id[:1]]
        save_scans(Scans(place, train.ends, of_all, train.is_return, train.target_index), files[-1])
        tests.append(test)
    return files, concatenate_scans(tests)


def start(files: list[Path], target: Path, *options: str) -> subprocess.Popen[bytes]:
    """A streamed fit in a process of its own."""
    command = [sys.executable, str(STREAM), *map(str, files), str(target), *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def wait_for_checkpoint(process: subprocess.Popen[bytes], target: Path) -> None:
    """Until the first checkpoint: before it there is nothing to resume."""
    while process.poll() is None and not target.exists():
        time.sleep(0.01)


def run_killed(files: list[Path], target: Path, kills: int, rng: random.Random) -> int:
    """Stream with up to ``kills`` kills; how many there were. The last run is let finish."""
    killed, before = 0, 0
    patience = 0.0  # [s] that a run is given at least: it must start before it can learn
    while True:
        process = start(files, target, *(["--resume"] if target.exists() else []))
        wait_for_checkpoint(process, target)
        if killed < kills:
            try:
                _, errors = process.communicate(timeout=patience + rng.uniform(0.0, 1.5))
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.communicate()
                killed += 1
                _, done = resume_stream(target)  # raises if the file is damaged
                if left := list(target.parent.glob(f".*.{target.name}")):
                    sys.exit(f"kill {killed}: {left[0]} was left behind")
                if done.scans < before:
                    sys.exit(f"kill {killed}: {before} scans became {done.scans}")
                if done.scans == before:
                    patience += 0.5  # killed before the first scan was finished
                before = done.scans
                continue
        else:
            _, errors = process.communicate()
        if process.returncode:
            sys.exit(f"resume after kill {killed} failed: {errors.decode()[-500:]}")
        return killed


@torch.no_grad()
def main() -> None:
    """Kill, resume, compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--scans", type=int, default=20, help="scans in the stream (default: 20)")
    parser.add_argument(
        "--rays", type=int, default=9_000, help="rays of the room, a third per scan (default: 9000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, test = make_scans(folder, arguments.scans, arguments.rays)
        whole = folder / "whole.pt"
        process = start(files, whole)
        _, errors = process.communicate()
        if process.returncode:
            sys.exit(f"the run without kills failed: {errors.decode()[-500:]}")
        wanted = evaluate(LardHilbertMap.load(whole), test)
        killed, rounds = 0, 0
        while killed < arguments.kills:
            target = folder / f"killed_{rounds}.pt"
            killed += run_killed(files, target, arguments.kills - killed, rng)
            found = evaluate(LardHilbertMap.load(target), test)
            for kind in ("unif", "near"):
                lost = wanted[kind]["balanced_accuracy"] - found[kind]["balanced_accuracy"]
                print(
                    f"round {rounds}, {killed} kills so far, {kind}: lost {lost:+.5f}", flush=True
                )
                if abs(lost) > TOLERANCE:
                    sys.exit(f"accuracy must stay within {TOLERANCE}; it changed by {lost}")
            rounds += 1
    print(f"{killed} kills in {rounds} streams of {arguments.scans} scans: all resumed")


if __name__ == "__main__":
    main()
