"""The pose of each scan file, from a pose file beside the scans."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.calibration import (
    CALIBRATION_FILES,
    camera_from_lidar,
    find_calibration,
    vehicle_from_lidar,
)
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import POSE_FILES, first_file, folders_of, natural_key
from lardhm_torch.io.pose_files import PoseFile, read_pose_file
from lardhm_torch.io.trajectories import MAX_STAMP_GAP

_STAMP_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}  # since 1970: s, ms, us, ns
_LEAST_PATH = 5.0  # [m] shorter ones do not show which way a sensor faces


@dataclass(frozen=True)
class FoundPose:
    """The pose of one scan file.

    Args:
        world_from_sensor: (4, 4); None where the pose file has no pose for the scan, which is
            left out.
        notes: from which file, by which rule, and what was guessed.
    """

    world_from_sensor: NDArray[np.float64] | None
    notes: tuple[Note, ...]


@dataclass(frozen=True)
class _Matched:
    """Poses of the scans of a folder, by file name; NaN where there is none.

    Warnings are for the whole folder: the first scan has them, notes_of_others has none.
    """

    poses: dict[str, NDArray[np.float64]]
    notes: tuple[Note, ...]
    notes_of_others: tuple[Note, ...]


def find_beside(path: Path, names: tuple[str, ...]) -> Path | None:
    """The first of some files that lies beside path or one folder up; None if there is none."""
    beside = first_file(folders_of(path), names)
    return None if beside is None else Path(beside)


def pose_beside(path: Path, poses_frame: str | None = None) -> FoundPose | None:
    """The pose of a scan file, from a pose file beside it or one folder up; None without one.

    KITTI lines: scan 000123 has line 123 (counted from 0), or the line that begins with its number
    where lines do. TUM lines: by stamp where all names are stamps (seconds with a point, or 10, 13,
    16 or 19 digits since 1970), else by number as KITTI lines. Where names are no such numbers,
    and there are as many lines as scans, lines follow the natural order of the names.

    Poses are the lidar's, except for KITTI lines beside a calib.txt: those are the camera's, as in
    the published ones, and Tr moves them: world_from_lidar = inv(Tr) pose Tr, the world being the
    laser's frame at line 0.

    Args:
        path: of the scan.
        poses_frame: whose poses the file holds, "camera" or "lidar"; None: not said.

    Raises:
        ValueError: the pose file is broken, fits no scan, or needs a calibration that is not there.
    """
    places = folders_of(path)
    source = first_file(places, POSE_FILES)
    if source is None:
        return None
    if poses_frame not in (None, "camera", "lidar"):
        raise ValueError(
            f'poses_frame must be "camera" or "lidar" beside {source}; got {poses_frame!r}'
        )
    folders = tuple(map(_changed, dict.fromkeys((*places, folders_of(source)[1]))))
    files = (source, *_calibrations(places[0], source, folders))
    stamps = (*folders, *map(_changed, files))
    suffix = path.suffix.lower()
    matched = _pose_of_each(places[0], suffix, source, poses_frame, stamps)
    pose = matched.poses[path.name]
    is_first = path.name == next(iter(matched.poses))
    notes = matched.notes if is_first else matched.notes_of_others
    if math.isfinite(pose.sum()):
        return FoundPose(pose, notes)
    lost = Note(f"scans left out: {os.path.basename(source)} has no pose for them", 1, is_loss=True)
    return FoundPose(None, (lost, *notes))


def _changed(path: str) -> tuple[str, int]:
    """Changes when the file or folder does."""
    return path, os.stat(path).st_mtime_ns


@lru_cache(maxsize=4)
def _calibrations(folder: str, source: str, stamps: tuple[tuple[str, int], ...]) -> tuple[str, ...]:
    scan = Path(folder) / "scan"
    found = [find_calibration(name, Path(source), scan) for name in CALIBRATION_FILES]
    return tuple(str(file) for file in found if file is not None)


@lru_cache(maxsize=4)
def _pose_of_each(
    folder: str,
    suffix: str,
    pose_file: str,
    poses_frame: str | None,
    stamps: tuple[tuple[str, int], ...],
) -> _Matched:
    """The pose of each file by its name; stamps keep the cache from getting old."""
    source = Path(pose_file)
    files = (f for f in Path(folder).iterdir() if f.suffix.lower() == suffix and f.is_file())
    names = sorted((f.name for f in files), key=natural_key)
    file = read_pose_file(source)
    file, frame_notes = _of_lidar(file, source, Path(folder) / names[0], poses_frame)
    stems = [name[: len(name) - len(suffix)] for name in names]
    poses, rule = _matched(file, source, stems)
    if not np.isfinite(poses).all(axis=(1, 2)).any():
        raise ValueError(
            f"{source} must have a pose for a scan; it has none for {names[0]} to {names[-1]}"
            f"{_times_of(file, stems)}"
        )
    notes = (Note(f"poses from {source.name}"), *file.notes, *rule, *frame_notes)
    silent = tuple(replace(note, is_loss=False) for note in notes)
    return _Matched(dict(zip(names, poses, strict=True)), notes, silent)


def _matched(
    file: PoseFile, source: Path, stems: list[str]
) -> tuple[NDArray[np.float64], tuple[Note, ...]]:
    """(n, 4, 4) poses of scans by the names of their files, and the rule that gave them."""
    times = None if file.stamps is None else _stamps_of(stems)
    if times is not None:
        poses, gaps = file.trajectory().at(times)
        poses[gaps > MAX_STAMP_GAP] = np.nan
        return poses, (Note("poses by the stamps in the names"),)
    is_number = all(stem.isascii() and stem.isdigit() for stem in stems)
    numbers = np.array([int(stem) for stem in stems]) if is_number else np.empty(0, dtype=int)
    if file.numbers is not None:
        if not is_number:
            raise ValueError(
                f"{source} begins its lines with numbers of scans; names must be numbers; "
                f"got {stems[0]}"
            )
        line_of = {number: line for line, number in enumerate(file.numbers.tolist())}
        with_none = np.concatenate([file.poses, np.full((1, 4, 4), np.nan)])
        return with_none[[line_of.get(n, -1) for n in numbers]], (Note("poses by scan number"),)
    if is_number and numbers.max() < len(file.poses):
        return file.poses[numbers], (_by_line(file),)
    if len(stems) == len(file.poses):
        _check_order(file, source, stems, numbers)
        cure = "scans named by line number (from 0) or by stamp confirm it"
        return file.poses, (Note("poses by the order of the names", cure=cure),)
    raise ValueError(
        f"{source} must have a line for each scan, by number, stamp or order; "
        f"got {len(file.poses)} lines for {len(stems)} scans, {stems[0]} to {stems[-1]}"
        f"{_times_of(file, stems)}"
    )


def _by_line(file: PoseFile) -> Note:
    """The note for lines that were found by number."""
    steps = np.empty(0) if file.stamps is None else np.diff(file.stamps[np.isfinite(file.stamps)])
    if len(steps) > 1 and steps.max() > 2.5 * np.median(steps) and steps.min() > 0:
        cure = "scans named by stamp avoid it"
        return Note("poses by line number (from 0), though stamps have a gap", cure=cure)
    return Note("poses by line number (from 0)")


def _check_order(
    file: PoseFile, source: Path, stems: list[str], numbers: NDArray[np.int64]
) -> None:
    """Raise a ValueError where numbers in the names and stamps of the lines do not go together."""
    if file.stamps is None or len(numbers) < 3:
        return
    steps, seconds = np.diff(numbers), np.diff(file.stamps)
    if not (steps > 0).all() or not (np.isfinite(seconds) & (seconds > 0)).all():
        return
    pace = seconds / steps
    if pace.max() > 1.5 * pace.min():
        slow = int(np.argmax(abs(np.log(pace / np.median(pace)))))
        raise ValueError(
            f"{source} has as many lines as there are scans, but not of the same times: "
            f"{stems[slow]} and {stems[slow + 1]} would be {seconds[slow]:.3g} s apart, others "
            f"{np.median(pace):.3g} s a number. Name the scans by their stamps"
        )


def _times_of(file: PoseFile, stems: Sequence[str]) -> str:
    """The stamps of lines and scans for a message; empty where there are none."""
    if file.stamps is None:
        return ""
    stamps = file.trajectory().stamps
    times = _stamps_of(list(stems))
    of_scans = "" if times is None else f" for scans of {times.min():.3f} to {times.max():.3f} s"
    return f". Its stamps are {stamps[0]:.3f} to {stamps[-1]:.3f} s{of_scans}"


def _stamps_of(stems: list[str]) -> NDArray[np.float64] | None:
    """(n,) names as seconds; None if one is no stamp: a number that only counts scans is none."""
    lengths = {len(stem) for stem in stems}
    if all(stem.isascii() and stem.isdigit() for stem in stems):
        if len(lengths) > 1 or lengths.isdisjoint(_STAMP_DIGITS) or stems[0][0] == "0":
            return None
        unit = _STAMP_DIGITS[lengths.pop()]
        return np.array([int(stem) * unit for stem in stems])
    try:
        times = np.array([float(stem) for stem in stems])
    except ValueError:
        return None
    return times if np.isfinite(times).all() else None


def _of_lidar(
    file: PoseFile, source: Path, scan: Path, poses_frame: str | None
) -> tuple[PoseFile, tuple[Note, ...]]:
    """The poses as those of the lidar, by the calibration beside them."""
    if poses_frame == "lidar":
        return file, (Note("poses of the lidar, as given"),)
    if file.is_vehicle:
        return _of_vehicle(file, source, scan, poses_frame)
    found = [find_calibration(name, source, scan) for name in CALIBRATION_FILES[:2]]
    calibs = [calib for calib in found if calib is not None]
    tr = next((tr for tr in map(camera_from_lidar, calibs) if tr is not None), None)
    if poses_frame == "camera" or (calibs and file.stamps is None):
        if tr is None:
            where = calibs[0] if calibs else source.with_name("calib.txt")
            raise ValueError(
                f"{source} holds poses of the camera; {where} must give the pose of the lidar, in "
                'a line Tr: of 12 numbers. If they are the lidar\'s: poses_frame="lidar", '
                "--poses-frame lidar on the command line"
            )
        moved = np.linalg.inv(tr) @ file.poses @ tr
        return PoseFile(moved, file.stamps, file.numbers), _camera_notes(file, tr, poses_frame)
    cure = "poses_frame='lidar' confirms it, poses_frame='camera' uses Tr of calib.txt"
    note = Note("poses assumed to be the lidar's", cure=cure, is_loss=_rises(file.poses))
    return file, (note,)


def _camera_notes(
    file: PoseFile, camera_from_lidar: NDArray[np.float64], poses_frame: str | None
) -> tuple[Note, ...]:
    """The notes for poses assumed to be the camera's, which not all programs write."""
    if poses_frame == "camera":
        return (Note("poses of the camera, as given, transformed to the lidar by Tr"),)
    moves = _moves_along(file.poses)
    as_lidar = np.abs(moves)
    as_camera = np.abs(camera_from_lidar[:3, :3].T @ moves)
    is_doubtful = as_lidar[0] > 0.7 and as_camera[0] < 0.7
    text = "poses assumed to be the camera's, as KITTI publishes them, and transformed to the lidar by Tr"
    if is_doubtful:
        text += "; they would move it sideways or up"
    cure = "poses_frame='camera' confirms it, poses_frame='lidar' if they are the lidar's"
    return (Note(text, cure=cure, is_loss=bool(is_doubtful)),)


def _moves_along(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) mean direction of motion in the sensor's own frame; shorter the more it varies."""
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    steps = np.diff(poses[:, :3, 3], axis=0)
    length = np.linalg.norm(steps, axis=1).sum()
    if length < _LEAST_PATH:
        return np.zeros(3)
    return np.einsum("nji,nj->i", poses[:-1, :3, :3], steps) / length


def _rises(poses: NDArray[np.float64]) -> bool:
    """Whether poses move along their z axis, as those of a camera do that looks ahead."""
    return bool(abs(_moves_along(poses)[2]) > 0.7)


def _of_vehicle(
    file: PoseFile, source: Path, scan: Path, poses_frame: str | None
) -> tuple[PoseFile, tuple[Note, ...]]:
    """KITTI-360: poses of the vehicle's GPS/IMU, numbered."""
    mount = None if poses_frame == "camera" else vehicle_from_lidar(source, scan)
    if mount is None:
        raise ValueError(
            f"{source} begins its lines with the number of the scan, as KITTI-360 does, whose poses "
            "are the vehicle's: put calib_cam_to_velo.txt and calib_cam_to_pose.txt beside it. If "
            'they are the lidar\'s: poses_frame="lidar", --poses-frame lidar on the command line'
        )
    cure = "poses_frame='lidar' if they are the lidar's"
    note = Note("poses assumed to be the vehicle's, as KITTI-360 publishes them", cure=cure)
    return PoseFile(file.poses @ mount, None, file.numbers), (note,)
