"""Points of formats that do not state their frame, placed by a pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lardhm_torch.io.no_returns import seen_beams, with_free_beams
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import POSE_FILES
from lardhm_torch.io.poses import FoundPose, find_beside, pose_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.trajectories import move_points

_WITHOUT_FRAME = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".las", ".laz", ".pts")
_WITH_POSES = (".e57", ".ptx")
_LEAST_ROTATION = 1e-6


def placed(
    readout: Readout, file: Path, frame: str | None, poses_frame: str | None = None
) -> Readout:
    """Points and origin by the file's pose: that of a pose file, or, in the sensor's frame, its own.

    Without a frame, points are left where they are, unless the file's own pose has a rotation.

    Raises:
        ValueError: the format states its frame, or there is no pose for points in the sensor frame.
    """
    if frame is None:
        return _as_written(readout, file)
    if file.suffix.lower() not in _WITHOUT_FRAME and not _lacks_pose(readout, file):
        raise ValueError(
            f'frame="{frame}" is for {" ".join(_WITHOUT_FRAME)}: other formats state their frame, '
            "unless a single scan of .e57 or .ptx has no pose"
        )
    pose = pose_beside(file, poses_frame)
    if frame == "world":
        if pose is None or not readout.needs_origin:
            note = Note("points in the world frame, as given (frame)")
            return seen_beams(readout).noting(note)
        return seen_beams(seen_from(readout, pose))
    if pose is None and readout.world_from_sensor is not None:
        pose = FoundPose(readout.world_from_sensor, (Note("pose from the file itself"),))
    if pose is None or readout.dim != 3:
        raise ValueError(
            'frame="sensor" needs a pose for 3-D points: a file poses.txt beside the scans '
            f"(or VIEWPOINT in PCD); got none for points of {readout.dim} coordinates"
        )
    return moved(readout, pose)


def _lacks_pose(readout: Readout, file: Path) -> bool:
    """Whether a file of a format with poses has a single scan, and its pose is none."""
    has_poses = file.suffix.lower() in _WITH_POSES
    return has_poses and readout.needs_origin and readout.num_scans == 1


def _as_written(readout: Readout, file: Path) -> Readout:
    """Points whose frame is not stated: world frame, unless the pose of the file rotates."""
    pose = readout.world_from_sensor
    if pose is None:
        return seen_beams(readout)
    if np.abs(pose[:3, :3] - np.eye(3)).max() > _LEAST_ROTATION:
        raise ValueError(
            "its pose (VIEWPOINT) has a rotation, so the points may be in the sensor frame. Choose: "
            'frame="sensor" transforms them by the pose, frame="world" leaves them and takes the '
            "position alone; --frame on the command line"
        )
    readout = seen_beams(readout)
    beside = find_beside(file, POSE_FILES)
    unused = "" if beside is None else f", and {beside.name} beside it is not used"
    return readout.noting(
        Note(
            f"points assumed to be in the world frame{unused}",
            cure='frame="world" confirms it, frame="sensor" transforms them by the pose; --frame',
        )
    )


def moved(readout: Readout, pose: FoundPose) -> Readout:
    """Points of the sensor frame moved into the world; no scan where the pose is missing."""
    if pose.world_from_sensor is None:
        return _left_out(readout, pose)
    readout = with_free_beams(readout, np.zeros(readout.dim))
    return replace(
        readout,
        ends=move_points(pose.world_from_sensor, readout.ends),
        origins=np.full((readout.num_scans, 3), pose.world_from_sensor[:3, 3]),
        origin_is_placeholder=False,
        notes=(
            *readout.notes,
            *pose.notes,
            Note("points in the sensor frame, transformed by the pose"),
        ),
    )


def seen_from(readout: Readout, pose: FoundPose) -> Readout:
    """Points that already are in the world frame, seen from the position of a pose."""
    if pose.world_from_sensor is None:
        return _left_out(readout, pose)
    return replace(
        readout,
        origins=np.tile(pose.world_from_sensor[: readout.dim, 3], (readout.num_scans, 1)),
        origin_is_placeholder=False,
    ).noting(*pose.notes, Note("points in the world frame, as given (frame)"))


def _left_out(readout: Readout, pose: FoundPose) -> Readout:
    """A readout without a scan, which says why."""
    empty = np.empty((0, readout.dim))
    return Readout(empty, origins=empty, notes=(*readout.notes, *pose.notes))
