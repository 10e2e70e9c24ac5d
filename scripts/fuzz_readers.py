"""Feed broken files to every reader: the answer is Scans or a clear error, never a hang or crash.

    python scripts/fuzz_readers.py --mutations 1000 --seed 0

Each format runs in a process of its own, with a limit on time and memory, so that a crash in a
compiled library is seen and named. Exit code 0 if all formats pass.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from pathlib import Path

import numpy as np

from lardhm_torch.io import load_points, load_scans, save_scans
from lardhm_torch.scans import Scans

SECONDS_A_FILE = 5
MEMORY_ON_TOP = 1 << 30  # [bytes] that a reader may need for a file of some kilobytes
NUM_POINTS = 300
HUGE = (0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)


def write_ply(path: Path, points: np.ndarray, encoding: str) -> None:
    """A PLY file with points and one origin per point."""
    header = f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {len(points)}\n"
    header += "".join(f"property double {name}\n" for name in ("x", "y", "z", "ox", "oy", "oz"))
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.hstack([points, np.ones_like(points)])
    if encoding == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()).encode() + b"\n3 0 1 2"
    else:
        order = "<" if "little" in encoding else ">"
        body = rows.astype(f"{order}f8").tobytes() + b"\3" + np.arange(3, dtype="<i4").tobytes()
    path.write_bytes(header.encode() + body)


def write_pcd(path: Path, points: np.ndarray, encoding: str) -> None:
    """A PCD file with VIEWPOINT; compressed ones hold copies that run into themselves."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
    header += f"COUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\n"
    header += f"POINTS {len(points)}\nDATA {encoding}\n"
    rows = np.hstack([points, np.zeros((len(points), 1))]).astype("<f4")
    if encoding == "ascii":
        body = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    elif encoding == "binary":
        body = rows.tobytes()
    else:
        packed, size = compress_lzf(np.ascontiguousarray(rows.T).tobytes()), rows.nbytes
        body = len(packed).to_bytes(4, "little") + size.to_bytes(4, "little") + packed
    path.write_bytes(header.encode() + body)


def compress_lzf(content: bytes) -> bytes:
    """LZF of content: runs of one byte as copies that run into themselves, the rest as literals."""
    packed, literal, i = bytearray(), bytearray(), 0
    while i < len(content) or literal:
        run = 0
        while i and i + run < len(content) and run < 264 and content[i + run] == content[i - 1]:
            run += 1
        if literal and (run >= 3 or len(literal) == 32 or i == len(content)):
            packed += bytes([len(literal) - 1]) + literal
            literal = bytearray()
        if run >= 9:
            packed += bytes([7 << 5, run - 9, 0])
        elif run >= 3:
            packed += bytes([(run - 2) << 5, 0])
        elif i < len(content):
            literal.append(content[i])
            run = 1
        i += run
    return bytes(packed)


def write_las(path: Path, points: np.ndarray, point_format: int) -> None:
    """A LAS 1.4 or LAZ file; formats from 6 on are compressed in layers, older ones are not."""
    import laspy

    las = laspy.create(file_version="1.4", point_format=point_format)
    las.header.scales = [1e-3] * 3
    las.x, las.y, las.z = points.T
    las.return_number = np.ones(len(points), dtype=np.uint8)
    las.write(path)


def write_kitti(folder: Path, points: np.ndarray) -> Path:
    """A KITTI scan; the folder gets its poses.txt too."""
    (folder / "poses.txt").write_text("1 0 0 5 0 1 0 6 0 0 1 7\n")
    np.hstack([points, points[:, :1]]).astype("<f4").tofile(folder / "000000.bin")
    return folder / "000000.bin"


def healthy_file(name: str, folder: Path) -> Path:
    """One small whole file of a format, such as "ply-ascii" or "poses"."""
    points = np.random.default_rng(0).normal(size=(NUM_POINTS, 3)).round(3)
    extension, _, variant = name.partition("-")
    path = folder / f"scan.{extension}"
    if extension == "npz":
        ids = np.arange(NUM_POINTS) % 3
        save_scans(Scans(np.ones((3, 3)), points, ids), path)  # type: ignore[arg-type]
        if variant == "deflate":
            np.savez_compressed(path, **np.load(path))
    elif extension == "npy":
        np.save(path, points)
    elif extension == "ply":
        write_ply(path, points, variant)
    elif extension == "pcd":
        write_pcd(path, points, variant)
    elif extension in ("las", "laz"):
        write_las(path, points, int(variant or 6))
    elif extension in ("bin", "poses"):
        path = write_kitti(folder, points)
        path = path if extension == "bin" else folder / "poses.txt"
    else:
        rows = np.hstack([points, np.ones_like(points)])
        np.savetxt(path, rows, delimiter=",", header="x,y,z,ox,oy,oz", comments="")
    return path


FORMATS = [
    *("npz", "npz-deflate", "npy", "csv", "txt", "xyz", "bin", "poses"),
    *("ply-ascii", "ply-binary_little_endian", "ply-binary_big_endian"),
    *("pcd-ascii", "pcd-binary", "pcd-binary_compressed"),
]
if importlib.util.find_spec("laspy") and importlib.util.find_spec("lazrs"):
    FORMATS += ["las", "laz-6", "laz-3"]


def mutate(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four random changes: a cut, flipped bits, an edited header, a huge count."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        kind = rng.integers(7)
        header = min(len(changed), 400)
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
        elif kind == 5 and changed:  # a piece said twice or left out
            start, stop = sorted(rng.integers(len(changed) + 1, size=2))
            changed[start:stop] = changed[start:stop] * int(rng.integers(3))
            del changed[4 * len(content) :]
        elif kind == 6:  # noise put in
            at = rng.integers(len(changed) + 1)
            changed[at:at] = rng.bytes(int(rng.integers(1, 30)))
    return bytes(changed)


def outcome(path: Path, named: Path, is_points: bool) -> str:
    """What reading a file came to: "Scans" or "error"; anything else is a failure and raises."""
    try:
        if is_points:
            load_points(path)
        else:
            needs_origin = path.suffix in (".las", ".laz")
            scans = load_scans(path, origin=(0, 0, 0) if needs_origin else None)
            assert len(scans.ends) == len(scans.scan_id)
        return "Scans"
    except (ValueError, OSError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError):
                raise AssertionError("memory ran out before the file was checked") from error
            cause = cause.__cause__
        if str(named) not in str(error):
            raise AssertionError("the error does not name the file") from error
        return "error"


def fuzz(name: str, mutations: int, seed: int) -> Counter[str]:
    """How often mutated files of one format gave Scans, and how often an error."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path = healthy_file(name, Path(folder))
        content = path.read_bytes()
        is_poses, is_points = name == "poses", name == "npy"
        read = path.with_name("000000.bin") if is_poses else path
        assert outcome(read, read, is_points) == "Scans"
        for number in range(mutations):
            path.write_bytes(mutate(content, np.random.default_rng([seed, number])))
            signal.alarm(SECONDS_A_FILE)
            try:
                counts[outcome(read, read, is_points)] += 1
            except BaseException:
                print(f"{name}: mutation {number} of seed {seed}", file=sys.stderr)
                raise
            finally:
                signal.alarm(0)
    return counts


def limit_memory() -> None:
    """Let this process grow by MEMORY_ON_TOP and no further."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_ON_TOP
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def fuzz_apart(name: str, arguments: argparse.Namespace) -> bool:
    """Fuzz one format in a process of its own; True if it passed."""
    command = [sys.executable, __file__, "--format", name, "--seed", str(arguments.seed)]
    command += ["--mutations", str(arguments.mutations)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    print(run.stdout.strip() if run.returncode == 0 else f"{name}: FAILED ({run.returncode})")
    if run.returncode:
        print(run.stderr[-4000:])
    return run.returncode == 0


def main() -> int:
    """Fuzz one format here, or all of them apart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=1000, help="files per format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", choices=FORMATS, help="only this one")
    arguments = parser.parse_args()
    if arguments.format is None:
        passed = [fuzz_apart(name, arguments) for name in FORMATS]
        return 0 if all(passed) else 1
    limit_memory()
    try:
        counts = fuzz(arguments.format, arguments.mutations, arguments.seed)
    except BaseException:
        traceback.print_exc()
        return 1
    print(f"{arguments.format}: {counts['Scans']} read, {counts['error']} clear errors")
    return 0


if __name__ == "__main__":
    sys.exit(main())
