"""KITTI .bin scans (float32 x y z intensity, sensor frame) with their poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lardhm_torch.io.frames import moved
from lardhm_torch.io.poses import pose_beside
from lardhm_torch.io.readout import Readout

_POINT_BYTES = 16


def read_kitti(path: Path, poses_frame: str | None = None) -> Readout:
    """Points moved into the world by the scan's pose (`poses.pose_beside`); without one, as they are.

    The format has no header: a file cut between two points looks whole.

    Raises:
        ValueError: the file is no whole number of points, or the pose file has no pose for it.
    """
    size = path.stat().st_size
    if size == 0 or size % _POINT_BYTES:
        raise ValueError(
            f"points of {_POINT_BYTES} bytes (float32 x y z intensity) are needed; got {size} bytes"
        )
    ends = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    pose = pose_beside(path, poses_frame)
    readout = Readout(ends, origin_cure="Put its poses.txt beside it")
    return readout if pose is None else moved(readout, pose)
