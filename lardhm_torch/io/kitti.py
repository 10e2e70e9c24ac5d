"""KITTI .bin scans (float32 x y z intensity, sensor frame) with their poses.txt."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.paths import natural_key
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.records import read_table

_POINT_BYTES = 16


def read_kitti(path: Path) -> Readout:
    """Points moved into the world by the scan's line of poses.txt; without one, as they are.

    poses.txt lies beside the scan or one folder up. Each line has 12 numbers, the upper 3 x 4 of
    world_from_sensor row by row. Scan 000123.bin has line 123 (counted from 0); where names are no
    such numbers, lines follow the natural order of the names.

    Raises:
        ValueError: the file is no whole number of points, or poses.txt has no pose for it.
    """
    size = path.stat().st_size
    if size == 0 or size % _POINT_BYTES:
        raise ValueError(
            f"points of {_POINT_BYTES} bytes (float32 x y z intensity) are needed; got {size} bytes"
        )
    ends = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    found = [folder for folder in (path.parent, path.parent.parent) if _poses_in(folder).is_file()]
    if not found:
        return Readout(ends, origin_cure="Put its poses.txt beside it")
    stamps = (_stamp(path.parent), _stamp(_poses_in(found[0])), _stamp(_calib_in(found[0])))
    world_from_sensor = _pose_of_each(path.parent, found[0], stamps)[path.name]
    rotation, origin = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
    return Readout(ends @ rotation.T + origin, origins=origin[None].copy())


def _poses_in(folder: Path) -> Path:
    return folder / "poses.txt"


def _calib_in(folder: Path) -> Path:
    return folder / "calib.txt"


def _stamp(path: Path) -> int:
    """Changes when the file or folder does; 0 where there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


@lru_cache(maxsize=4)
def _pose_of_each(
    scan_folder: Path, pose_folder: Path, stamps: tuple[int, ...]
) -> dict[str, NDArray[np.float64]]:
    """(4, 4) world_from_sensor of each .bin by name; stamps keep the cache from getting old."""
    source = _poses_in(pose_folder)
    poses = _read_poses(source)
    if _calib_in(pose_folder).is_file():
        poses = _sensor_poses(poses, _calib_in(pose_folder))
    names = sorted(
        (file.name for file in scan_folder.iterdir() if file.suffix.lower() == ".bin"),
        key=natural_key,
    )
    stems = [Path(name).stem for name in names]
    numbers = [int(stem) for stem in stems if stem.isascii() and stem.isdigit()]
    if len(numbers) == len(names) and max(numbers) < len(poses):
        return {name: poses[number] for name, number in zip(names, numbers, strict=True)}
    if len(names) == len(poses):
        return dict(zip(names, poses, strict=True))
    raise ValueError(
        f"{source} must have a line for each scan, by number or by order; "
        f"got {len(poses)} lines for {len(names)} scans, {names[0]} to {names[-1]}"
    )


def _read_poses(path: Path) -> NDArray[np.float64]:
    """(L, 4, 4) rigid transforms."""
    try:
        rows = read_table(path, 0, list(range(12)))
    except ValueError as error:
        raise ValueError(f"{path} must have 12 numbers a line: {error}") from error
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    drift = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_rigid = (drift < 1e-3) & (np.linalg.det(rotations) > 0) & np.isfinite(rows).all(axis=1)
    if not is_rigid.all():
        raise ValueError(
            f"{path} must hold rotations and positions; line {int(np.argmin(is_rigid))} is none"
        )
    return poses


def _sensor_poses(poses: NDArray[np.float64], calib: Path) -> NDArray[np.float64]:
    """Poses of the laser from those of the camera, if calib.txt has Tr (camera from laser).

    The published KITTI poses are the camera's: world_from_laser = inv(Tr) pose Tr, the world being
    the laser's frame at line 0.
    """
    lines = [line.split() for line in calib.read_text(encoding="latin-1").splitlines()]
    rows = [words[1:] for words in lines if words and words[0] == "Tr:"]
    if not rows:
        return poses
    camera_from_laser = np.eye(4)
    try:
        camera_from_laser[:3] = np.array(rows[0], dtype=np.float64).reshape(3, 4)
        return np.linalg.inv(camera_from_laser) @ poses @ camera_from_laser
    except ValueError as error:
        raise ValueError(f"{calib} must have 12 numbers after Tr: {error}") from error
