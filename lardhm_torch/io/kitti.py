"""Binary scans without a header (KITTI .bin: float32 x y z intensity, sensor frame), with poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lardhm_torch.io.bin_layouts import KITTI, find_layout
from lardhm_torch.io.frames import moved
from lardhm_torch.io.notes import Note
from lardhm_torch.io.poses import pose_beside
from lardhm_torch.io.readout import Readout, without_zeros


def read_kitti(path: Path, poses_frame: str | None = None) -> Readout:
    """Points moved into the world by the scan's pose (`poses.pose_beside`); without one, as they are.

    The format has no header: a file cut between two points looks whole. Four float32 columns are
    expected. Other layouts (nuScenes: five columns, named .pcd.bin) are recognized by their values.

    Raises:
        ValueError: the file is no whole number of points, or the pose file has no pose for it.
    """
    with open(path, "rb", buffering=0) as file:
        content = np.frombuffer(file.read(), np.uint8)
    if bytes(content[:3]) == b"CCB":
        raise ValueError("it is a .bin file of CloudCompare. Save it as .e57, .las or .ply there")
    kind, columns = find_layout(content, _is_nuscenes(path))
    ends = (
        content.view(kind).reshape(-1, columns).astype(np.float64)[:, :3]
    )  # fastest in this order
    readout = without_zeros(Readout(ends, origin_cure="Put its poses.txt beside it"))
    if (kind, columns) != KITTI:
        name = f"{columns} columns of float{8 * np.dtype(kind).itemsize}"
        cure = "" if _is_nuscenes(path) else "convert the file to .npz or .pcd to be sure"
        readout = readout.noting(Note(f"{name} instead of KITTI's four of float32", cure=cure))
    pose = pose_beside(path, poses_frame)
    return readout if pose is None else moved(readout, pose)


def _is_nuscenes(path: Path) -> bool:
    """Whether the name is one of nuScenes, whose scans have five columns."""
    return path.name.lower().endswith(".pcd.bin")
