"""Pose files as text: lines of KITTI, KITTI-360 and TUM, and the columns named in comments."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.records import read_table, text_encoding
from lardhm_torch.io.trajectories import (
    Trajectory,
    check_rigid,
    poses_from_quaternions,
    trajectory_from,
)

_MAX_LINES_BEFORE = 1000
_TUM = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_TRACK_COLUMNS = (4, 7, 8)  # time x y z, then nothing, roll pitch heading, or a quaternion
_STAMP_NAME = re.compile(
    r"(?:gps_?)?(time|stamp|timestamp|timestamps|t|sec|secs|seconds|unix\w*)(_?[nmu]?s)?"
)
_POSITION_NAME = re.compile(r"(?:t|p|p_\w+|pos|position|trans|translation)?[_.]?([xyz])")
_TURN_NAME = re.compile(r"(?:q|q_\w+|quat|quaternion|ori|orientation|rot|rotation)[_.]?([wxyz])")
_POSITION_WORDS = {
    **{"easting": "x", "northing": "y"},
    **dict.fromkeys(("height", "altitude", "elevation"), "z"),
}
_UNITS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3}


@dataclass(frozen=True)
class PoseFile:
    """The lines of a pose file, in its order.

    Args:
        poses: (L, 4, 4) world_from_sensor; NaN where a line holds no pose.
        stamps: (L,) of each line [s], NaN where it has none; None in KITTI's formats.
        numbers: (L,) which scan each line belongs to; None where lines are only counted.
        is_vehicle: the poses are KITTI-360's, of its GPS/IMU and not of a sensor.
        notes: what was found in the file.
    """

    poses: NDArray[np.float64]
    stamps: NDArray[np.float64] | None = None
    numbers: NDArray[np.int64] | None = None
    is_vehicle: bool = False
    notes: tuple[Note, ...] = field(default=())

    def trajectory(self) -> Trajectory:
        """The lines that hold a pose, in the order of time; needs stamps."""
        assert self.stamps is not None
        is_pose = np.isfinite(self.poses).all(axis=(1, 2)) & np.isfinite(self.stamps)
        return trajectory_from(self.stamps[is_pose], self.poses[is_pose])


def read_pose_file(path: Path) -> PoseFile:
    """The poses of a text file; the format follows from the count of numbers per line.

    | numbers | format | pose |
    |---|---|---|
    | 8 | TUM | stamp tx ty tz qx qy qz qw, or as a comment before them names the columns |
    | 12 | KITTI | upper 3 x 4 of world_from_sensor, row by row |
    | 13 | KITTI-360 | number of the scan, then as KITTI |
    | 16 | | as 12, with the last row 0 0 0 1 |

    Lines of NaN, and of a quaternion of zeros, are what trackers write when they are lost: such a
    line holds no pose.

    Raises:
        ValueError: the lines hold another number of numbers, or no poses.
    """
    before, columns, delimiter = _beginning(path)
    named = _named_columns(before, columns)
    if named is None and columns not in (8, 12, 13, 16):
        hint = " Lines of time x y z are for LAS files with GPS times." if columns in (4, 7) else ""
        raise ValueError(
            f"{path} must have 12 numbers a line (KITTI), 13 (KITTI-360) or 8 (TUM: stamp tx ty tz "
            f"qx qy qz qw); got {columns}.{hint}"
        )
    try:
        rows = read_table(path, len(before), list(range(columns)), delimiter=delimiter)
    except ValueError as error:
        raise ValueError(f"{path} must have {columns} numbers a line: {error}") from error
    if named is not None or columns == 8:
        return _tum(path, rows, before, named)
    return _kitti(path, rows)


def read_trajectory(path: Path) -> Trajectory:
    """The poses of a TUM file in the order of time.

    Raises:
        ValueError: as `read_pose_file`, or the lines have no stamps.
    """
    file = read_pose_file(path)
    if file.stamps is None:
        raise ValueError(f"{path} must have stamps: stamp tx ty tz qx qy qz qw a line (TUM)")
    return file.trajectory()


def read_track(path: Path) -> tuple[NDArray[np.float64] | None, int]:
    """(L, 4) stamp [s] x y z of lines of time x y z and what follows, and the numbers of a line.

    Lines have 4 numbers, 7 (roll, pitch and heading follow), 8 (TUM's), or a comment before them
    names the columns (such as GPS_TIME EASTING NORTHING HEIGHT). None for other files.

    Raises:
        ValueError: a word is no number, or no line is finite.
    """
    before, columns, delimiter = _beginning(path)
    named = _named_columns(before, columns, _TUM[:4])
    if named is None and columns not in _TRACK_COLUMNS:
        return None, columns
    wanted = [named[name] for name in _TUM[:4]] if named else [0, 1, 2, 3]
    try:
        rows = read_table(path, len(before), wanted, delimiter=delimiter)
    except ValueError as error:
        raise ValueError(f"{path} must have {columns} numbers a line: {error}") from error
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        raise ValueError(f"{path} must hold lines of time x y z; none is finite")
    return rows * [_seconds(rows[:, 0], before), 1, 1, 1], columns


def _beginning(path: Path) -> tuple[list[str], int, str | None]:
    """Lines before the first line of numbers, how many numbers it has, and their delimiter."""
    before: list[str] = []
    with open(path, encoding=text_encoding(path)) as file:
        for line in iter(lambda: file.readline(65_536), ""):
            text = line.partition("#")[0].strip()
            delimiter = next((mark for mark in ",;" if mark in text), None)
            words = text.rstrip(",;").split(delimiter)
            if words and _is_number(words[0]):
                return before, len(words), delimiter
            before.append(line.strip())
            if len(before) == _MAX_LINES_BEFORE:
                break
    return before, 0, None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _named_columns(
    before: list[str], columns: int, wanted: tuple[str, ...] = _TUM
) -> dict[str, int] | None:
    """Where each wanted number of a line is, by the last comment that names them all."""
    for comment in reversed(before):
        text = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", comment.lstrip("#/% \t").lower())
        names = [word.strip() for word in re.split(r"[,;]" if "," in text else r"\s+", text)]
        found: dict[str, int] = {}
        for column, name in enumerate(names[:columns]):
            if _STAMP_NAME.fullmatch(name.lstrip("#")) and "stamp" not in found:
                found["stamp"] = column
            elif name in _POSITION_WORDS:
                found.setdefault(_POSITION_WORDS[name], column)
            elif match := _POSITION_NAME.fullmatch(name):
                found.setdefault(match[1], column)
            elif match := _TURN_NAME.fullmatch(name):
                found.setdefault("q" + match[1], column)
        if found.keys() >= set(wanted):
            return found
    return None


def _tum(
    path: Path, rows: NDArray[np.float64], before: list[str], named: dict[str, int] | None
) -> PoseFile:
    if named is not None:
        rows = rows[:, [named[name] for name in _TUM]]
    is_pose = np.isfinite(rows).all(axis=1) & (np.linalg.norm(rows[:, 4:], axis=1) > 1e-6)
    if not is_pose.any():
        raise ValueError(
            f"{path} must hold poses: finite numbers, and quaternions x y z w that are not all 0; "
            "no line does"
        )
    poses = np.full((len(rows), 4, 4), np.nan)
    poses[is_pose] = poses_from_quaternions(rows[is_pose, 1:4], rows[is_pose, 4:])
    stamps = rows[:, 0] * _seconds(rows[is_pose, 0], before)
    notes = _count_missing(is_pose, path)
    if named is not None and named["qw"] < named["qx"]:
        notes += (Note(f"quaternions of {path.name} are w x y z, by its comment"),)
    elif named is None and abs(rows[is_pose][0, 4:]).tolist() == [1, 0, 0, 0]:
        cure = "a comment '# stamp tx ty tz qw qx qy qz' states that qw is first"
        text = f"the first quaternion of {path.name} is 1 0 0 0, read as x y z w: a half turn"
        notes += (Note(text, cure=cure, is_loss=True),)
    return PoseFile(poses, stamps, notes=notes)


def _seconds(stamps: NDArray[np.float64], before: list[str]) -> float:
    """The unit of stamps [s]: by the unit in a comment, else by the size of the numbers."""
    for comment in before:
        match = re.search(r"(?:time|stamp)\w*?[\s_]*[\[(]?(ns|us|µs|ms)\b", comment.lower())
        if match:
            return _UNITS[match[1]]
    largest = np.abs(stamps).max()
    sizes = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
    return next((unit for size, unit in sizes if largest > size), 1.0)


def _kitti(path: Path, rows: NDArray[np.float64]) -> PoseFile:
    numbers = None
    if rows.shape[1] == 13:
        if not (np.isfinite(rows[:, 0]).all() and (rows[:, 0] % 1 == 0).all()):
            raise ValueError(f"{path} must begin its lines of 13 numbers with the number of a scan")
        numbers, rows = rows[:, 0].astype(np.int64), rows[:, 1:]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, : rows.shape[1] // 4] = rows.reshape(len(rows), -1, 4)
    is_pose = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    if not is_pose.any():
        raise ValueError(f"{path} must hold finite poses; no line does")
    check_rigid(np.where(is_pose[:, None, None], poses, np.eye(4)), str(path))
    poses[~is_pose] = np.nan
    notes = _count_missing(is_pose, path)
    return PoseFile(poses, None, numbers, is_vehicle=numbers is not None, notes=notes)


def _count_missing(is_pose: NDArray[np.bool_], path: Path) -> tuple[Note, ...]:
    text = (
        f"{int((~is_pose).sum())} lines of {path.name} hold no pose (NaN or a quaternion of zeros)"
    )
    return () if is_pose.all() else (Note(text),)
