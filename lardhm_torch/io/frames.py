"""Points of formats that do not say which frame they are in, placed by a pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lardhm_torch.io.poses import pose_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.trajectories import move_points

_WITHOUT_FRAME = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".las", ".laz")


def placed(readout: Readout, file: Path, frame: str) -> Readout:
    """Points and origin by the file's pose: that of a pose file, or, in the sensor's frame, its own."""
    if file.suffix.lower() not in _WITHOUT_FRAME:
        raise ValueError(
            f'frame="{frame}" is for {" ".join(_WITHOUT_FRAME)}: other formats say it themselves'
        )
    pose = pose_beside(file)
    if frame == "world":
        if pose is None or not readout.needs_origin:
            return readout
        origin = pose[: readout.dim, 3]
        return replace(
            readout,
            origins=np.tile(origin, (readout.num_scans, 1)),
            origin_is_placeholder=False,
        )
    if pose is None:
        pose = readout.world_from_sensor
    if pose is None or readout.dim != 3:
        raise ValueError(
            'frame="sensor" needs a pose for 3-D points: a file poses.txt beside the scans '
            f"(or VIEWPOINT in PCD); got none for points of {readout.dim} coordinates"
        )
    return replace(
        readout,
        ends=move_points(pose, readout.ends),
        origins=np.tile(pose[:3, 3], (readout.num_scans, 1)),
        origin_is_placeholder=False,
    )
