"""Reading speed of every scan format, in MB of file and millions of points per second.

    python benchmarks/reading.py --points 1000000 --repeats 7
    python benchmarks/reading.py --compare PATH     # another checkout, read alternately

All files hold the same points of the simulated room and are written to a temporary folder first.
Folders of many small scans with a pose file stand for drives: there the time per file counts.
The page cache is warm, and seconds are those of the processor: the figures are those of the readers,
not of the disk or of other programs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

NUM_SCANS = 500  # of a folder
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

# Run in the process of a checkout: the processor time of one reading of each file, best of three.
TIMED = """
import json, sys, time, warnings
warnings.simplefilter("ignore")
from lardhm_torch import load_scans
seconds = {}
for path in sys.argv[1:]:
    has_origin = path.endswith((".ptx", ".npz", ".pcd", ".e57", ".ply", "_scans"))
    options = {} if has_origin else {"origin": (1.0, 2.0, 3.0)}
    try:
        for _ in range(3):
            begin = time.process_time()
            load_scans(path, **options)
            taken = time.process_time() - begin
            seconds[path] = min(taken, seconds.get(path, taken))
    except (ValueError, ImportError):
        seconds[path] = None
print(json.dumps(seconds))
"""


def write_files(folder: Path, count: int) -> list[Path]:
    """One file of count points in every format whose library is installed."""
    from healthy_files import write_e57, write_las, write_pcd, write_ply, write_pts, write_ptx

    from lardhm_torch import Scans, save_scans, simulate_room

    scans = simulate_room(num_rays=count + count // 5, seed=0)
    points = scans.hits[:count].numpy().astype(np.float32).astype(np.float64)
    save_scans(Scans(scans.origins[:1], points), folder / "a.npz")  # type: ignore[arg-type]
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        write_ply(folder / f"{encoding}.ply", points, encoding)
    for encoding in ("ascii", "binary", "binary_compressed"):
        write_pcd(folder / f"{encoding}.pcd", points, encoding)
    np.savetxt(folder / "a.xyz", points, fmt="%.4f")
    np.savetxt(folder / "a.csv", points, fmt="%.4f", delimiter=",", header="x,y,z", comments="")
    np.hstack([points, np.ones((len(points), 1))]).astype("<f4").tofile(folder / "a.bin")
    write_pts(folder / "a.pts", [points.round(4)])
    write_ptx(folder / "a.ptx", points.round(4), np.eye(4)[None], False)
    if find_spec("lazrs"):
        write_las(folder / "a.las", points, 6)
        write_las(folder / "a.laz", points, 6)
    if find_spec("pye57"):
        write_e57(folder / "a.e57", [points], np.eye(4)[None])
    for suffix in ("bin", "pcd"):
        write_drive(folder / f"{suffix}_scans", points, suffix)
    return sorted(folder.iterdir())


def write_drive(folder: Path, points: np.ndarray, suffix: str) -> None:
    """A folder of small scans, and its poses where the format has none."""
    from healthy_files import write_pcd

    folder.mkdir()
    for number, scan in enumerate(np.array_split(points, NUM_SCANS)):
        path = folder / f"{number:06d}.{suffix}"
        if suffix == "pcd":
            write_pcd(path, scan, "binary")
        else:
            np.hstack([scan, np.ones((len(scan), 1))]).astype("<f4").tofile(path)
    if suffix == "bin":
        np.savetxt(folder / "poses.txt", np.tile(np.eye(4)[:3].reshape(12), (NUM_SCANS, 1)))


def megabytes(path: Path) -> float:
    """Size of a file, or of all files of a folder."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files) / 1e6


def timed(checkout: Path, files: list[Path]) -> dict[str, float | None]:
    """Seconds to read each file with the code of a checkout, in a process of its own."""
    command = [sys.executable, "-c", TIMED, *map(str, files)]
    run = subprocess.run(command, cwd=checkout, check=False, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(run.stderr[-2000:])
    return json.loads(run.stdout)


def main() -> None:
    """Print a table of the formats, or write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--compare", type=Path, help="another checkout, read alternately")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    checkouts = [ROOT] + ([arguments.compare.resolve()] if arguments.compare else [])
    with tempfile.TemporaryDirectory() as folder:
        files = write_files(Path(folder), arguments.points)
        runs = [[timed(path, files) for path in checkouts] for _ in range(arguments.repeats)]
        rows = []
        for file in files:
            values = [[run[i][str(file)] for run in runs] for i in range(len(checkouts))]
            medians = [statistics.median(v) if None not in v else None for v in values]
            rows.append({"file": file.name, "MB": megabytes(file), "seconds": medians})
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    print(f"{'file':<26}{'MB':>8}{'MB/s':>9}{'Mpoints/s':>11}{'other MB/s':>12}{'ratio':>7}")
    for row in rows:
        speeds = [None if s is None else row["MB"] / s for s in row["seconds"]]
        other, ratio = "-", ""
        if speeds[0] and len(speeds) > 1 and speeds[1]:
            other, ratio = f"{speeds[1]:.0f}", f"{speeds[0] / speeds[1]:.2f}"
        if speeds[0] is None:
            print(f"{row['file']:<26} cannot be read")
            continue
        points = arguments.points / 1e6 / row["seconds"][0]
        print(
            f"{row['file']:<26}{row['MB']:>8.1f}{speeds[0]:>9.0f}{points:>11.2f}{other:>12}{ratio:>7}"
        )


if __name__ == "__main__":
    main()
