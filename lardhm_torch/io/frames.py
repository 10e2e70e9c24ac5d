"""Points of formats that do not say which frame they are in, placed by a pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lardhm_torch.io.notes import Note
from lardhm_torch.io.poses import FoundPose, pose_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.trajectories import move_points

_WITHOUT_FRAME = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".las", ".laz")


def placed(readout: Readout, file: Path, frame: str, poses_frame: str | None = None) -> Readout:
    """Points and origin by the file's pose: that of a pose file, or, in the sensor's frame, its own.

    Raises:
        ValueError: the format says its frame itself, or there is no pose for points of the sensor
            frame.
    """
    if file.suffix.lower() not in _WITHOUT_FRAME:
        raise ValueError(
            f'frame="{frame}" is for {" ".join(_WITHOUT_FRAME)}: other formats say it themselves'
        )
    pose = pose_beside(file, poses_frame)
    if frame == "world":
        if pose is None or not readout.needs_origin:
            return readout.noting(Note("points in the world frame, as given (frame)"))
        return seen_from(readout, pose)
    if pose is None and readout.world_from_sensor is not None:
        pose = FoundPose(readout.world_from_sensor, (Note("pose from the file itself"),))
    if pose is None or readout.dim != 3:
        raise ValueError(
            'frame="sensor" needs a pose for 3-D points: a file poses.txt beside the scans '
            f"(or VIEWPOINT in PCD); got none for points of {readout.dim} coordinates"
        )
    return moved(readout, pose)


def moved(readout: Readout, pose: FoundPose) -> Readout:
    """Points of the sensor frame moved into the world; no scan where the pose is missing."""
    if pose.world_from_sensor is None:
        return _left_out(readout, pose)
    return replace(
        readout,
        ends=move_points(pose.world_from_sensor, readout.ends),
        origins=np.tile(pose.world_from_sensor[:3, 3], (readout.num_scans, 1)),
        origin_is_placeholder=False,
    ).noting(*pose.notes, Note("points in the sensor frame, moved by the pose"))


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
