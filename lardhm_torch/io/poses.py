"""Pose files beside scans, in KITTI's or TUM's format."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import POSE_FILES, natural_key
from lardhm_torch.io.records import read_table
from lardhm_torch.io.trajectories import (
    MAX_STAMP_GAP,
    Trajectory,
    check_rigid,
    poses_from_quaternions,
    trajectory_from,
)


def read_poses(path: Path) -> NDArray[np.float64] | Trajectory:
    """(L, 4, 4) poses of a KITTI file, 12 numbers a line; a Trajectory of a TUM file, 8 numbers.

    KITTI: the upper 3 x 4 of world_from_sensor row by row. TUM: stamp tx ty tz qx qy qz qw.

    Raises:
        ValueError: the lines hold another number of numbers, or no poses.
    """
    columns = _count_columns(path)
    if columns not in (8, 12):
        raise ValueError(
            f"{path} must have 12 numbers a line (KITTI) or 8 (TUM: stamp tx ty tz qx qy qz qw); "
            f"got {columns}"
        )
    try:
        rows = read_table(path, 0, list(range(columns)))
    except ValueError as error:
        raise ValueError(f"{path} must have {columns} numbers a line: {error}") from error
    if columns == 8:
        return _tum_trajectory(path, rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    check_rigid(poses, str(path))
    return poses


def _count_columns(path: Path) -> int:
    """How many words the first line that is no comment has."""
    with open(path, encoding="latin-1") as file:
        for line in iter(lambda: file.readline(65_536), ""):
            words = line.partition("#")[0].split()
            if words:
                return len(words)
    return 0


def _tum_trajectory(path: Path, rows: NDArray[np.float64]) -> Trajectory:
    try:
        poses = poses_from_quaternions(rows[:, 1:4], rows[:, 4:])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not np.isfinite(rows[:, 0]).all():
        raise ValueError(f"{path} must have finite stamps; it does not")
    return trajectory_from(rows[:, 0], poses)


def find_beside(path: Path, names: tuple[str, ...]) -> Path | None:
    """The first of some files that lies beside path or one folder up; None if there is none."""
    folders = (path.parent, path.parent.parent)
    return next((f / n for f in folders for n in names if (f / n).is_file()), None)


@dataclass(frozen=True)
class FoundPose:
    """The pose of one scan file.

    Args:
        world_from_sensor: (4, 4); None where the pose file covers the scan with no pose, and the
            scan is left out.
        notes: from which file, by which rule, and what was guessed.
    """

    world_from_sensor: NDArray[np.float64] | None
    notes: tuple[Note, ...]


def pose_beside(path: Path, poses_frame: str | None = None) -> FoundPose | None:
    """The pose of a scan file, from a pose file beside it or one folder up; None without one.

    KITTI lines: scan 000123 has line 123 (counted from 0); where the names are no such numbers,
    lines follow their natural order. TUM lines: by stamp where all names are stamps (in seconds,
    or whole microseconds or nanoseconds), else in natural order.

    Args:
        path: of the scan.
        poses_frame: whose poses the file holds, "camera" or "lidar"; None: not said.

    Raises:
        ValueError: the pose file is broken, or has no pose for the scan.
    """
    source = find_beside(path, POSE_FILES)
    if source is None:
        return None
    stamps = (_changed(path.parent), _changed(source), _changed(source.with_name("calib.txt")))
    pose = _pose_of_each(path.parent, path.suffix.lower(), source, stamps)[path.name]
    return FoundPose(pose, (Note(f"pose from {source.name}"),))


def _changed(path: Path) -> int:
    """Changes when the file or folder does; 0 where there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


@lru_cache(maxsize=4)
def _pose_of_each(
    folder: Path, suffix: str, source: Path, stamps: tuple[int, ...]
) -> dict[str, NDArray[np.float64]]:
    """(4, 4) world_from_sensor of each file by name; stamps keep the cache from getting old."""
    poses = read_poses(source)
    names = sorted(
        (f.name for f in folder.iterdir() if f.suffix.lower() == suffix and f.is_file()),
        key=natural_key,
    )
    stems = [name[: len(name) - len(suffix)] for name in names]
    if isinstance(poses, Trajectory):
        times = _stamps_of(stems)
        if times is not None:
            found, gaps = poses.at(times)
            if (gaps <= MAX_STAMP_GAP).all():
                return dict(zip(names, found, strict=True))
        poses = poses.poses
    elif suffix == ".bin" and source.with_name("calib.txt").is_file():
        poses = _laser_poses(poses, source.with_name("calib.txt"))
    numbers = [int(stem) for stem in stems if stem.isascii() and stem.isdigit()]
    if len(numbers) == len(names) and max(numbers) < len(poses):
        return {name: poses[number] for name, number in zip(names, numbers, strict=True)}
    if len(names) == len(poses):
        return dict(zip(names, poses, strict=True))
    raise ValueError(
        f"{source} must have a line for each scan, by number, stamp or order; "
        f"got {len(poses)} lines for {len(names)} scans, {names[0]} to {names[-1]}"
    )


def _stamps_of(stems: list[str]) -> NDArray[np.float64] | None:
    """(n,) names as seconds; None if one is no number."""
    try:
        times = np.array([float(stem) for stem in stems])
    except ValueError:
        return None
    if all(stem.isdigit() and len(stem) in (16, 19) for stem in stems):
        times = np.array([int(stem) * (1e-6 if len(stem) == 16 else 1e-9) for stem in stems])
    return times if np.isfinite(times).all() else None


def _laser_poses(poses: NDArray[np.float64], calib: Path) -> NDArray[np.float64]:
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
