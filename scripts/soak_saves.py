"""Kill writers of map files, and fill the disk under every command that writes.

    python scripts/soak_saves.py --kills 50 --seed 0

After a kill, the file must hold the old or the new map, and the next writer must leave nothing else
behind. On a full disk, a command must fail in one line that names its output, and leave the old
output as it was. The full disk is a small tmpfs for root, and a limit of the file size for others.
Exit code 0 if all checks pass.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from lardhm_torch import LardHilbertMap, sample_rays, save_scans, simulate_room

ROOM = 6_000  # bytes left for an output on the full disk, less than any of them needs
SAVER = """
import sys
from lardhm_torch import LardHilbertMap
maps = [LardHilbertMap.load(name) for name in sys.argv[2:]]
while True:
    for model in maps:
        model.save(sys.argv[1])
        print("saved", flush=True)
"""
COMMANDS = (
    ("simulate -o {here}/out.npz --rays 5000", "out.npz"),
    ("split {scans} -o {here}/out.npz {here}/out.npz.npz", "out.npz"),
    ("fit {scans} -o {here}/out.pt --clusters 200", "out.pt"),
    ("fit {scans} -o {here}/out.safetensors --clusters 200", "out.safetensors"),
    ("fit {scans} -o {here}/out.pt --clusters 200 --incremental", "out.pt"),
    ("fit {scans} -o {other}/map.pt --clusters 200 --tune-state {here}/out.pt", "out.pt"),
    ("update {map} {scans} -o {here}/out.pt", "out.pt"),
    ("update {map} {scans} -o {here}/out.safetensors", "out.safetensors"),
    ("join {map} {map} -o {here}/out.pt", "out.pt"),
    ("query {map} {scans} -o {here}/out.npy", "out.npy"),
    ("mesh {map} -o {here}/out.ply --resolution 0.2", "out.ply"),
    ("mesh {map} -o {here}/out.glb --resolution 0.2", "out.glb"),
    ("mesh {map} -o {here}/out.obj --resolution 0.2", "out.obj"),
    ("grid {map} -o {here}/out.npz --resolution 0.2", "out.npz"),
    ("grid {map} -o {here}/out.npz --resolution 0.2 --sparse", "out.npz"),
    ("grid {map} -o {here}/out.ot --resolution 0.05", "out.ot"),
    ("grid {map} --nav2 {here}/out.yaml --heights 0.2 2 --resolution 0.02", "out"),
    ("render {map} -o {here}/out.png --resolution 0.2", "out.png"),
    ("evaluate {map} {scans} --reliability {here}/out.png", "out.png"),
    ("view {map} --export {here}/out.html --resolution 0.2", "out.html"),
    ("tile {scans} -o {here}/out --edge 4", "out"),
)


def make_inputs(folder: Path) -> dict[str, str]:
    """Scans and two maps of a room."""
    scans = simulate_room(num_rays=3000, seed=0)
    save_scans(scans, folder / "scans.npz")
    samples = sample_rays(scans)
    for number, clusters in enumerate((150, 3000)):
        model = LardHilbertMap().fit(samples.points, samples.labels, clusters)
        model.save(folder / f"map{number}.pt")
    (folder / "other").mkdir()
    return {name: str(folder / path) for name, path in
            (("scans", "scans.npz"), ("map", "map0.pt"), ("other", "other"))}  # fmt: skip


def kill_saves(folder: Path, path: Path, kills: int, rng: random.Random) -> None:
    """Exit unless a killed writer leaves the old or the new map, and the next one nothing else."""
    sources = [folder / f"map{number}.pt" for number in range(2)]
    wanted = [LardHilbertMap.load(source).weights for source in sources]
    path.parent.mkdir()
    LardHilbertMap.load(sources[0]).save(path)
    left, piled = 0, 0
    for kill in range(1, kills + 1):
        command = [sys.executable, "-c", SAVER, str(path), *map(str, sources)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.2))
            process.send_signal(signal.SIGKILL)
        found = LardHilbertMap.load(path).weights
        if not any(torch.equal(found, weights) for weights in wanted):
            sys.exit(f"kill {kill}: {path} holds neither the old nor the new map")
        others = len(list(path.parent.iterdir())) - 1
        left, piled = left + (others > 0), max(piled, others)
    if piled > 1:
        sys.exit(f"{piled} partial files of {path} were left lying at once")
    LardHilbertMap.load(sources[0]).save(path)
    if rest := [other for other in path.parent.iterdir() if other != path]:
        sys.exit(f"the next writer did not remove {rest[0]}")
    print(
        f"{path.suffix}: {kills} kills, {left} of them while writing: old or new map, nothing left"
    )


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """Whether the folder is a file system of its own for the time being, which takes root."""
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    own = (
        shutil.which("mount") is not None
        and not subprocess.run(mount, capture_output=True).returncode
    )
    try:
        yield own
    finally:
        if own:
            subprocess.run(["umount", str(folder)], check=True)


def fill_disk(folder: Path) -> None:
    """Leave no more than `ROOM` bytes."""
    size = max(0, shutil.disk_usage(folder).free - ROOM)
    (folder / "filler").write_bytes(b"0" * size)


def limit_files() -> None:
    """No file of this process may be larger than `ROOM` bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, ROOM))


def run_on_full_disk(command: str, name: str, inputs: dict[str, str], folder: Path) -> str:
    """What is wrong with the way a command fails on a full disk; empty if nothing is."""
    with small_disk(folder) as is_own:
        old = folder / name
        writes_file = bool(old.suffix) and "--tune-state" not in command
        if writes_file:
            old.write_bytes(b"old")
        if is_own:
            fill_disk(folder)
        before = {path.name for path in folder.iterdir()}
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "lardhm_torch.cli",
                *command.format(here=folder, **inputs).split(),
            ],
            capture_output=True,
            text=True,
            preexec_fn=None if is_own else limit_files,
        )
        lines = [line for line in done.stderr.splitlines() if line.startswith("lardhm ")]
        errors = [line for line in lines if "warning" not in line]
        rest = {path.name for path in folder.iterdir()} - before
        kept = not writes_file or old.read_bytes() == b"old"
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    if done.returncode != 1 or "Traceback" in done.stderr:
        return f"exit code {done.returncode}: {done.stderr[-300:]}"
    if len(errors) != 1 or str(folder / name) not in errors[0]:
        return f"no line that names {name}: {done.stderr[-300:]}"
    if not kept:
        return "the old output was changed"
    return f"left behind: {rest}" if any(part.startswith(".") for part in rest) else ""


def main() -> None:
    """Kill savers, then fill disks."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50, help="for each format of map files")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        inputs = make_inputs(folder)
        check = functools.partial(run_on_full_disk, inputs=inputs, folder=folder / "full")
        for command, output in COMMANDS:
            problem = check(command, output)
            failed += bool(problem)
            print(f"full disk: {command.split(' {')[0]} -> {output}: {problem or 'ok'}", flush=True)
        rng = random.Random(arguments.seed)
        for suffix in (".pt", ".safetensors"):
            kill_saves(folder, folder / f"kills{suffix}" / f"map{suffix}", arguments.kills, rng)
    print(f"{len(COMMANDS)} commands on a full disk: {failed} failures")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
