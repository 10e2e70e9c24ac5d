"""Binary scans without a header (KITTI .bin: float32 x y z intensity, sensor frame), with poses."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.bin_layouts import KITTI, find_layout
from lardhm_torch.io.channel_columns import finite_values
from lardhm_torch.io.frames import moved
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import first_file, folders_of
from lardhm_torch.io.poses import pose_beside
from lardhm_torch.io.readout import Readout, without_zeros


def read_kitti(path: Path, poses_frame: str | None = None) -> Readout:
    """Points moved into the world by the scan's pose (`poses.pose_beside`); without one, as they are.

    The format has no header: a file cut between two points looks whole. Four float32 columns are
    expected. Other layouts (nuScenes: five columns, named .pcd.bin) are recognized by their values.
    The fourth column is the intensity, the fifth of nuScenes the ring. Classes are those of a
    SemanticKITTI file beside it or in ../labels: the lower 16 bits of ``000000.label``, of which 0
    (unlabeled) is missing.

    Raises:
        ValueError: the file is no whole number of points, the pose file has no pose for it, or its
            labels are not one per point.
    """
    with open(path, "rb", buffering=0) as file:
        content = np.frombuffer(file.read(), np.uint8)
    if bytes(content[:3]) == b"CCB":
        raise ValueError("it is a .bin file of CloudCompare. Save it as .e57, .las or .ply there")
    kind, columns = find_layout(content, _is_nuscenes(path))
    table = content.view(kind).reshape(-1, columns)
    ends = table.astype(np.float64)[:, :3]  # fastest in this order
    channels = _channels_of(path, table)
    readout = Readout(ends, origin_cure="Put its poses.txt beside it", channels=channels)
    readout = without_zeros(readout)
    if (kind, columns) != KITTI:
        name = f"{columns} columns of float{8 * np.dtype(kind).itemsize}"
        cure = "" if _is_nuscenes(path) else "convert the file to .npz or .pcd to be sure"
        readout = readout.noting(Note(f"{name} instead of KITTI's four of float32", cure=cure))
    pose = pose_beside(path, poses_frame)
    return readout if pose is None else moved(readout, pose)


def _channels_of(path: Path, table: NDArray) -> dict[str, NDArray]:
    """Intensity and ring of the columns, classes of the label file."""
    channels: dict[str, NDArray] = {}
    if table.shape[1] in (4, 5):
        channels["intensity"] = finite_values(table[:, 3])
    if table.shape[1] == 5 and _is_nuscenes(path):
        channels["ring"] = finite_values(table[:, 4])
    folder, above = folders_of(path)
    source = first_file((folder, os.path.join(above, "labels")), (f"{path.stem}.label",))
    if source is None:
        return channels
    labels = np.fromfile(source, np.uint8)
    if len(labels) != 4 * len(table):
        raise ValueError(
            f"{source} must hold {len(table)} labels of 4 bytes, one per point; "
            f"got {len(labels)} bytes"
        )
    classes = (labels.view("<u4") & 0xFFFF).astype(np.int64)
    channels["class"] = np.where(classes == 0, -1, classes)
    return channels


def _is_nuscenes(path: Path) -> bool:
    """Whether the name is one of nuScenes, whose scans have five columns."""
    return path.name.lower().endswith(".pcd.bin")
