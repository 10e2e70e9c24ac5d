"""Poses for a folder of lidar scans, estimated by KISS-ICP, for `lardhm fit`.

    python scripts/kiss_icp_poses.py drive/ --max-range 60
    lardhm fit drive/ -o map.pt --poses-frame lidar

The folder holds one file per scan, in the order of their names, with points in the frame of the
sensor. The script writes `poses.txt` there, one line of 12 numbers for each scan: the transform from
the sensor to the frame of the first scan (KITTI's format). Points at 0 0 0 and points that are not
finite are left out. Every scan is treated as recorded at one moment; deskew the scans of a fast sensor
beforehand. The poses are odometry: they drift, and loops are not closed.

Needs kiss-icp: pip install "lardhm_torch[kiss-icp]"
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from lardhm_torch import load_points
from lardhm_torch.io.atomic_files import replaced_file

SUFFIXES = (".bin", ".pcd", ".ply", ".npy", ".xyz")  # one scan a file
POSES = "poses.txt"


def scan_files(folder: Path) -> list[Path]:
    """The scans of a folder by name, all of one format."""
    found = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
    kinds = {path.suffix for path in found}
    if len(kinds) != 1:
        raise SystemExit(
            f"{folder} must hold scans of one format ({', '.join(SUFFIXES)}); "
            f"found {', '.join(sorted(kinds)) or 'none'}"
        )
    return found


def usable(points: np.ndarray) -> np.ndarray:
    """The (n, 3) points that are finite and not at 0 0 0, which stands for no return."""
    return points[np.isfinite(points).all(axis=1) & points.any(axis=1)]


def estimate_poses(
    scans: Iterable[np.ndarray], max_range: float, voxel: float | None = None
) -> Iterator[np.ndarray]:
    """Register (n, 3) scans in the frame of the sensor one after the other.

    Args:
        scans: points [m].
        max_range: points farther away are ignored [m].
        voxel: edge of a cell of KISS-ICP's own map [m]; None: a hundredth of max_range.

    Yields:
        (4, 4) transforms from the sensor to the frame of the first scan.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.deskew = max_range, False
    config.mapping.voxel_size = max_range / 100 if voxel is None else voxel
    odometry = KissICP(config)
    for points in scans:
        odometry.register_frame(points.astype(np.float64), np.empty(0))
        yield np.array(odometry.last_pose)


def write_poses(path: Path, poses: Iterable[np.ndarray]) -> int:
    """Write the upper three rows of each pose as a line; how many there were."""
    lines = [" ".join(repr(float(value)) for value in pose[:3].ravel()) for pose in poses]
    with replaced_file(path) as partial:
        partial.write_text("".join(f"{line}\n" for line in lines))
    return len(lines)


def main() -> None:
    """Estimate the poses and write them beside the scans."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="scans in the frame of the sensor, one file each")
    parser.add_argument("--max-range", type=float, default=100.0, help="[m] (default: 100)")
    parser.add_argument("--voxel", type=float, help="[m] (default: a hundredth of the range)")
    arguments = parser.parse_args()
    target = arguments.folder / POSES
    if target.exists():
        sys.exit(f"{target} exists; move it away first")
    scans = (usable(load_points(path).numpy()) for path in scan_files(arguments.folder))
    number = write_poses(target, estimate_poses(scans, arguments.max_range, arguments.voxel))
    print(f"{number} poses -> {target}")


if __name__ == "__main__":
    main()
