"""Feed damaged files to every reader: it must return Scans or raise a clear error.

    python scripts/fuzz_readers.py --mutations 1000 --seed 0

Each format runs in its own process with limits on time and memory, so that a crash of a compiled
library is detected and reported. Exit code 0 if all formats pass. All of them take about 15 minutes.
"""

from __future__ import annotations

import argparse
import faulthandler
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from healthy_files import (
    BagMaker,
    bag_messages,
    checksums_mended,
    write_depth_images,
    write_e57,
    write_kitti,
    write_las,
    write_organized_pcd,
    write_pcd,
    write_ply,
    write_ply_lists,
    write_pts,
    write_ptx,
    write_tum,
)

from lardhm_torch import LardHilbertMap
from lardhm_torch.io.scan_files import load_points, load_scans, save_scans
from lardhm_torch.scans import Scans

SECONDS_A_FILE = 5  # processor time
MEMORY_ON_TOP = 1 << 30  # [bytes] that a reader may need for a file of some kilobytes
NUM_POINTS = 300
HUGE = (0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)


def healthy_file(name: str, folder: Path) -> tuple[Path, Path]:
    """One small whole file of a format, such as "ply-ascii" or "poses", and what is to be read."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(NUM_POINTS, 3)).round(3)
    extension, _, variant = name.partition("-")
    path = folder / f"scan.{extension}"
    if extension == "npz":
        ids = np.arange(NUM_POINTS) % 3
        save_scans(Scans(np.ones((3, 3)), points, ids), path)  # type: ignore[arg-type]
        if variant == "deflate":
            np.savez_compressed(path, **np.load(path))
    elif extension == "npy":
        np.save(path, points)
    elif name.startswith("ply-lists"):
        write_ply_lists(path, points, name.endswith("ascii"))
    elif extension == "pts":
        write_pts(path, np.array_split(points, 3 if variant else 1))
    elif extension == "ptx":
        write_ptx(path, points, POSES, bool(variant))
    elif name.startswith("bin-"):
        columns = np.hstack([points, rng.random((NUM_POINTS, 2))])[:, : 5 if variant == "5" else 4]
        columns.astype("<f4" if variant == "5" else "<f8").tofile(path)
    elif extension == "ply":
        write_ply(path, points, variant)
    elif name == "pcd-organized":
        write_organized_pcd(path, 20, NUM_POINTS // 20)
    elif extension == "pcd":
        write_pcd(path, points, variant)
    elif extension in ("las", "laz"):
        write_las(path, points, int(variant or 6))
    elif extension == "e57":
        write_e57(path, [points[:100], points[100:]], POSES)
    elif extension in ("bag", "db3", "mcap"):
        maker = BagMaker(extension == "bag")
        messages = bag_messages(maker, [points[:100], points[100:]], POSES)
        if variant in ("laser", "livox"):
            rays = points if variant == "livox" else np.abs(points[:, 0])
            messages = [messages[0], getattr(maker, variant)(rays, 100.0)]
            variant = ""
        messages.append(maker.transform(POSES[1], 100.0, ("odom", "base")))
        maker.write(path, messages, variant)
    elif extension in ("calib", "metadata", "wal", "track"):
        return healthy_sidecar(extension, folder, points)
    elif extension in ("depth", "tum"):
        return healthy_images(extension, variant, folder, rng)
    elif extension == "map":
        path = folder / f"map.{variant}"
        LardHilbertMap().fit(torch.as_tensor(points), torch.arange(NUM_POINTS) % 2, 20).save(path)
    elif extension in ("bin", "poses"):
        read = write_kitti(folder, points)
        if variant == "tum":
            write_tum(folder / "poses.txt", [0.0, 1.0], POSES)
        return (read if extension == "bin" else folder / "poses.txt"), read
    else:
        rows = np.hstack([points, np.ones_like(points)])
        np.savetxt(path, rows, delimiter=",", header="x,y,z,ox,oy,oz", comments="")
    return path, path


def healthy_sidecar(name: str, folder: Path, points: np.ndarray) -> tuple[Path, Path]:
    """A file beside a scan, and the scan that cannot be read without it."""
    if name == "calib":
        scan = write_kitti(folder, points)
        (folder / "calib.txt").write_text("P0: 1 0 0 0\nTr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n")
        return folder / "calib.txt", scan
    if name == "track":
        write_las(folder / "scan.las", points, 6)
        (folder / "trajectory.txt").write_text("# time x y z\n-0.1 1 2 3\n0.1 1 2 4\n")
        return folder / "trajectory.txt", folder / "scan.las"
    maker = BagMaker(is_ros1=False)
    messages = bag_messages(maker, [points[:100], points[100:]], POSES)
    if name == "metadata":
        maker.write(folder / "bag.mcap", messages)  # its metadata.yaml is in the folder bag
        (folder / "bag.mcap").rename(folder / "bag" / "bag.mcap")
        return folder / "bag" / "metadata.yaml", folder / "bag"
    scan = folder / "scan.db3"
    database = sqlite3.connect(maker.write(folder / "live.db3", messages))
    database.executescript("PRAGMA journal_mode=WAL; PRAGMA wal_autocheckpoint=0; VACUUM")
    for ending in ("", "-wal"):
        shutil.copy(folder / f"live.db3{ending}", folder / f"scan.db3{ending}")
    database.close()
    return scan.with_name("scan.db3-wal"), scan


def healthy_images(
    layout: str, variant: str, folder: Path, rng: np.random.Generator
) -> tuple[Path, Path]:
    """Two depth images in the 7-Scenes or TUM layout; variant says which of the files to break."""
    images = [rng.integers(0, 4000, size=(24, 32)) for _ in POSES]
    path = write_depth_images(folder, images, POSES)
    if layout == "tum":
        names = sorted(file.name for file in folder.glob("*.png"))
        lines = [f"{100 + number}.5 {name}\n" for number, name in enumerate(names)]
        (folder / "depth.txt").write_text("# stamp file\n" + "".join(lines))
        write_tum(folder / "groundtruth.txt", [100.4, 100.6, 101.4, 101.6], POSES[[0, 0, 1, 1]])
    files = {"png": path, "pose": folder / "frame-000001.pose.txt"}
    if variant == "pairs":
        lines = [f"{line.strip()} {100 + i}.5 rgb/{i}.png\n" for i, line in enumerate(lines)]
        (folder / "depth.txt").rename(folder / "associations.txt")
        (folder / "associations.txt").write_text("".join(lines))
        return folder / "associations.txt", folder
    files |= {"camera": folder / "camera-intrinsics.txt", "list": folder / "depth.txt"}
    return files.get(variant, folder / "groundtruth.txt"), folder


POSES = np.tile(np.eye(4), (2, 1, 1))
POSES[1, :3] = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
FORMATS = {  # and the library that reads or makes them
    **dict.fromkeys(("npz", "npz-deflate", "npy", "csv", "txt", "xyz"), ""),
    **dict.fromkeys(("pts", "pts-several", "ptx", "ptx-zeros", "bin-5", "bin-double"), ""),
    **dict.fromkeys(("ply-lists-ascii", "ply-lists-binary"), ""),
    **dict.fromkeys(("bin", "poses", "poses-tum", "map-pt"), ""),
    **dict.fromkeys(("ply-ascii", "ply-binary_little_endian", "ply-binary_big_endian"), ""),
    **dict.fromkeys(("pcd-ascii", "pcd-binary", "pcd-binary_compressed", "pcd-organized"), ""),
    **dict.fromkeys(("las", "laz-6", "laz-3"), "lazrs"),
    **dict.fromkeys(("depth-png", "depth-pose", "depth-camera", "tum-list", "tum-poses"), "PIL"),
    "tum-pairs": "PIL",
    **dict.fromkeys(("bag", "bag-bz2", "bag-lz4", "db3", "db3-zstd-message"), "rosbags"),
    **dict.fromkeys(("mcap", "mcap-zstd", "mcap-laser", "mcap-livox", "bag-livox"), "rosbags"),
    **dict.fromkeys(("wal", "metadata"), "rosbags"),
    "calib": "",
    "track": "lazrs",
    "e57": "pye57",
    "map-safetensors": "safetensors",
}


def available_formats() -> list[str]:
    """The formats whose library is installed."""
    return [name for name, library in FORMATS.items() if not library or find_spec(library)]


def mutate(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four random changes: a cut, flipped bits, an edited header, a huge count."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        kind = rng.integers(7)
        header = min(len(changed), 400 if rng.random() < 0.7 else 1 << 20)  # or anywhere
        if kind == 0:  # cut
            del changed[rng.integers(len(changed) + 1) :]
        elif kind == 1 and changed:  # bit flips anywhere
            for at in rng.integers(len(changed), size=rng.integers(1, 20)):
                changed[at] ^= 1 << rng.integers(8)
        elif kind == 2 and header:  # a header byte
            changed[rng.integers(header)] = rng.integers(256)
        elif kind == 3:  # a digit anywhere in the header becomes a huge count
            digits = [at for at in range(header) if chr(changed[at]).isdigit()]
            if digits:
                at = int(rng.choice(digits))
                changed[at : at + 1] = str(rng.choice(np.array(HUGE, dtype=object))).encode()
        elif kind == 4 and len(changed) > 8:  # a binary count at either end of the file
            width = int(rng.choice([2, 4, 8]))
            number = int(rng.choice(np.array(HUGE, dtype=object))) % 256**width
            at = int(rng.integers(min(len(changed) - 8, 400)))
            at = at if rng.random() < 0.7 else len(changed) - 8 - at % len(changed[8:])
            changed[at : at + width] = number.to_bytes(width, "little")
        elif kind == 5 and changed:  # a block repeated or removed
            start, stop = sorted(rng.integers(len(changed) + 1, size=2))
            changed[start:stop] = changed[start:stop] * int(rng.integers(3))
            del changed[4 * len(content) :]
        elif kind == 6:  # random bytes inserted
            at = rng.integers(len(changed) + 1)
            changed[at:at] = rng.bytes(int(rng.integers(1, 30)))
    return bytes(changed)


def read(name: str, path: Path) -> None:
    """Read a file of a format as its users would."""
    if name.startswith("map"):
        LardHilbertMap.load(path)
    elif name == "npy":
        load_points(path)
    else:
        given = name.startswith(("la", "pts", "ply-lists", "bin-"))
        scans = load_scans(path, origin=(0, 0, 0) if given else None)
        assert len(scans.ends) == len(scans.scan_id)


def outcome(name: str, path: Path) -> str:
    """What reading a file came to: "read" or "error"; anything else is a failure and raises."""
    try:
        read(name, path)
        return "read"
    except (ValueError, OSError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError):
                raise AssertionError("memory ran out before the file was checked") from error
            cause = cause.__cause__
        if str(path) not in str(error):
            raise AssertionError("the error does not name the file") from error
        return "error"


def fuzz(name: str, mutations: int, seed: int) -> Counter[str]:
    """How often mutated files of one format were read, and how often they gave an error."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path, named = healthy_file(name, Path(folder))
        content = path.read_bytes()
        assert outcome(name, named) == "read"
        for number in range(mutations):
            broken = mutate(content, np.random.default_rng([seed, number]))
            if name == "e57" and number % 4:  # otherwise only the first checksum would be tested
                broken = checksums_mended(broken)
            path.write_bytes(broken)
            print(f"{name}: mutation {number} of seed {seed}", file=sys.stderr)
            signal.setitimer(signal.ITIMER_PROF, SECONDS_A_FILE)
            signal.alarm(60 * SECONDS_A_FILE)  # wall time: a reader may also wait forever
            try:
                counts[outcome(name, named)] += 1
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.alarm(0)
    return counts


def limit_memory() -> None:
    """Let this process grow by MEMORY_ON_TOP and no further."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_ON_TOP
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def fuzz_apart(name: str, arguments: argparse.Namespace) -> bool:
    """Fuzz one format in a process of its own; True if it passed."""
    command = [sys.executable, __file__, name, "--seed", str(arguments.seed)]
    command += ["--mutations", str(arguments.mutations), "--here"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    print(run.stdout.strip() if run.returncode == 0 else f"{name}: FAILED ({run.returncode})")
    if run.returncode:
        print(run.stderr[-4000:])
    return run.returncode == 0


def main() -> int:
    """Fuzz formats one after the other here, or each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("formats", nargs="*", help=f"{', '.join(FORMATS)} (default: all)")
    parser.add_argument(
        "--mutations", type=int, default=1000, help="files per format (default: 1000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--here", action="store_true", help="run in this process")
    arguments = parser.parse_args()
    names = arguments.formats or available_formats()
    if not arguments.here:
        passed = [fuzz_apart(name, arguments) for name in names]
        return 0 if all(passed) else 1
    warnings.simplefilter("ignore")
    faulthandler.enable()
    for number in (signal.SIGPROF, signal.SIGALRM):  # say where, then end the process
        faulthandler.register(number, chain=True)
    limit_memory()
    for name in names:
        try:
            counts = fuzz(name, arguments.mutations, arguments.seed)
        except BaseException:
            traceback.print_exc()
            return 1
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        said = f"{counts['read']} read, {counts['error']} clear errors, peak {peak:.0f} MiB"
        print(f"{name}: {said}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
