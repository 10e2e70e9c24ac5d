"""Binary scans without a header (KITTI .bin: float32 x y z intensity, sensor frame), with poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.frames import moved
from lardhm_torch.io.notes import Note
from lardhm_torch.io.poses import pose_beside
from lardhm_torch.io.readout import Readout, without_zeros

_LAYOUTS = [("<f4", columns) for columns in (4, 3, 5, 6, 7, 8)]
_LAYOUTS += [("<f8", columns) for columns in (3, 4, 5, 6)]
_PROBED_BYTES = 3360 * 8  # a whole number of points in every layout
_CLEARLY = 0.3  # in mean log variance: what another layout must be better by
_WILD_EXPONENTS = 2.0  # standard deviation of the powers of ten of coordinates
_LEAST_POINTS = 30  # fewer tell nothing about the layout


def read_kitti(path: Path, poses_frame: str | None = None) -> Readout:
    """Points moved into the world by the scan's pose (`poses.pose_beside`); without one, as they are.

    The format has no header: a file cut between two points looks whole. Four float32 columns are
    expected. Other layouts (nuScenes: five columns, named .pcd.bin) are recognized by their values.

    Raises:
        ValueError: the file is no whole number of points, or the pose file has no pose for it.
    """
    content = np.fromfile(path, np.uint8)
    if bytes(content[:3]) == b"CCB":
        raise ValueError("it is a .bin file of CloudCompare. Save it as .e57, .las or .ply there")
    kind, columns = _layout(content, _is_nuscenes(path))
    ends = content.view(kind).reshape(-1, columns)[:, :3].astype(np.float64)
    readout = without_zeros(Readout(ends, origin_cure="Put its poses.txt beside it"))
    if (kind, columns) != _LAYOUTS[0]:
        name = f"{columns} columns of float{8 * np.dtype(kind).itemsize}"
        cure = "" if _is_nuscenes(path) else "convert the file to .npz or .pcd to be sure"
        readout = readout.noting(Note(f"{name} instead of KITTI's four of float32", cure=cure))
    pose = pose_beside(path, poses_frame)
    return readout if pose is None else moved(readout, pose)


def _is_nuscenes(path: Path) -> bool:
    """Whether the name is one of nuScenes, whose scans have five columns."""
    return path.name.lower().endswith(".pcd.bin")


def _layout(content: NDArray[np.uint8], is_nuscenes: bool) -> tuple[str, int]:
    """Type and number of columns of a file.

    With the right number of columns each column holds one quantity, and varies least: any other
    number mixes coordinates with intensities. The measure is the mean logarithm of the variances.
    """
    scores = {
        layout: _mean_log_variance(content[:_PROBED_BYTES], *layout)
        for layout in _LAYOUTS
        if len(content) and len(content) % (np.dtype(layout[0]).itemsize * layout[1]) == 0
    }
    kitti = scores.get(_LAYOUTS[0], np.inf)
    least = min(scores.values(), default=np.inf)
    # Points of three columns also fit six: of what fits alike, the first is meant.
    best = next((lay for lay in scores if scores[lay] <= least + _CLEARLY / 2), _LAYOUTS[0])
    if is_nuscenes and ("<f4", 5) in scores and scores["<f4", 5] < scores[best] + _CLEARLY:
        return "<f4", 5
    enough = len(content) >= _LEAST_POINTS * 16
    makes_sense = not enough or np.isfinite(least)
    if _LAYOUTS[0] in scores and makes_sense and (not enough or kitti <= least + _CLEARLY / 3):
        return _LAYOUTS[0]
    if not scores or not enough or not makes_sense or not least + _CLEARLY < kitti:
        raise ValueError(
            "points of 16 bytes (float32 x y z intensity) are needed; "
            f"got {len(content)} bytes of another layout. Convert the file to .npz, .pcd or .csv"
        )
    return best


def _mean_log_variance(content: NDArray[np.uint8], kind: str, columns: int) -> float:
    """How much the columns vary under a layout; infinite where its numbers make no sense.

    Read with the wrong size, floats have wild exponents: coordinates span few powers of ten.
    """
    values = content.view(kind).reshape(-1, columns).astype(np.float64)
    usable = values[np.isfinite(values).all(axis=1)]
    if not len(usable) or len(usable) < 0.5 * len(values):
        return np.inf
    sizes = np.abs(usable[:, :3])
    exponents = np.log10(sizes[sizes > 0])
    if len(exponents) and exponents.std() > _WILD_EXPONENTS:
        return np.inf
    return float(np.log(usable.var(axis=0) + 1e-6).mean())
