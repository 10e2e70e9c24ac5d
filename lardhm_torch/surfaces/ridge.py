"""Move a surface from a level set of the log-odds to the ridge behind it, where the hits lie.

Free space is learned only up to some centimeters before each hit, so the level set at probability
1/2 lies in front of the hits. Across a surface, the log-odds are largest at the hits themselves.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, native_map
from lardhm_torch.native import available
from lardhm_torch.native import surfaces as native
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN
from lardhm_torch.queries.raycasting import first_peak, parabola_vertex
from lardhm_torch.surfaces.following import Sheet

MAX_DEPTH = 4.0  # standard deviations behind a vertex within which its ridge is sought
STEPS = 16  # into which this depth is divided
CHUNK_VERTICES = 1 << 15  # vertices evaluated at a time


@torch.no_grad()
def ridge_depths(
    model: OccupancyMap, vertices: Tensor, normals: Tensor, thickness: Tensor
) -> Tensor:
    """Depth of the first peak of the log-odds behind each vertex.

    Args:
        model: the map.
        vertices: (V, D) world positions [m].
        normals: (V, D) of length 1, into free space.
        thickness: (V,) standard deviation of the surface across itself [m].

    Returns:
        (V,) depths against the normals [m]; NaN if the peak is at either end of the `MAX_DEPTH`
        standard deviations searched.
    """
    strides = thickness.double() * (MAX_DEPTH / STEPS)
    return strides * ridge_positions(model, vertices, normals * strides[:, None])


def ridge_positions(model: OccupancyMap, points: Tensor, strides: Tensor) -> Tensor:
    """(V, D) points [m] and strides [m] -> (V,) strides back to the first peak of the log-odds.

    NaN if the peak is at either end of the `STEPS` strides.
    """
    tensors = native_map(model)
    if tensors is not None:
        return native.ridge_positions(tensors, points, strides, STEPS, LOG_ODDS_MARGIN)
    numbers = torch.arange(STEPS + 1, device=points.device)[:, None, None]
    chunks = zip(points.split(CHUNK_VERTICES), strides.split(CHUNK_VERTICES), strict=True)
    positions = [
        _peak_position(model.log_odds(start - numbers * step).double().T) for start, step in chunks
    ]
    return torch.cat([points.new_zeros(0), *positions])


def _peak_position(log_odds: Tensor) -> Tensor:
    """(V, S) log-odds at equal steps -> (V,) position of the first peak in steps; NaN at an end.

    A parabola through three steps gives the position between steps.
    """
    last = log_odds.shape[1] - 1
    peak = first_peak(log_odds)
    around = peak.clamp(1, last - 1)[:, None] + torch.arange(-1, 2, device=peak.device)
    position = peak + parabola_vertex(log_odds.gather(1, around))
    return torch.where((peak > 0) & (peak < last), position, torch.nan)


def sheet_on_ridge(model: OccupancyMap, sheet: Sheet, resolution: float) -> Sheet:
    """Move the vertices of a surface against their normals to the ridge of the log-odds.

    The ridge is sought within four standard deviations of the nearest occupied cluster (its
    smallest). Normals are averaged over neighbors first. Each vertex moves by the mean of its own
    depth and those of its neighbors. A face is removed if a corner and its neighbors have no ridge,
    or if the depths of its corners differ by more than a cell: they belong to different surfaces.
    A face that turned over on the way is removed, too.

    Args:
        model: the map.
        sheet: part of a level set of its log-odds.
        resolution: edge of the cells that the surface was made with [m].
    """
    vertices, faces, normals, thickness, _ = sheet
    normals = mean_with_neighbors(normals, faces)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)  # 0 where the log-odds are constant
    normals = (normals / lengths.clip(min=1e-12)).astype(np.float32)
    columns = (torch.from_numpy(c).to(model.origin.device) for c in (vertices, normals, thickness))
    depths = ridge_depths(model, *columns).cpu().numpy()
    depths = mean_with_neighbors(depths[:, None], faces)
    moved = vertices - np.nan_to_num(depths) * normals
    corners = depths[:, 0][faces]
    kept = corners.max(axis=1) - corners.min(axis=1) <= resolution  # a NaN compares as False
    kept[kept] = ~turned_over(moved, faces[kept], normals)
    return Sheet(moved, faces[kept], normals, thickness)


def turned_over(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(F,) whether a face looks against the normals of its vertices."""
    near_zero = torch.from_numpy((vertices - vertices[:1]).astype(np.float32))
    corners = torch.from_numpy(faces.astype(np.int64)).T
    a, b, c = (near_zero.index_select(0, corner) for corner in corners)
    across = torch.linalg.cross(b - a, c - a)
    own = torch.from_numpy(normals.astype(np.float32))
    looks = torch.zeros(len(faces))
    for corner in corners:
        looks += (across * own.index_select(0, corner)).sum(dim=1)
    return (looks <= 0).numpy()


def mean_with_neighbors(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mean of each vertex's value and those at the other corners of its faces, face by face.

    Args:
        values: (V, C), rows with NaN are ignored.
        faces: (F, 3) vertices of each face.

    Returns:
        (V, C), NaN where neither the vertex nor any neighbor has a value.
    """
    if not available():
        return plain_mean_with_neighbors(values, faces)
    arrays = (torch.from_numpy(a) for a in (values.astype(np.float64), faces.astype(np.int64)))
    return native.mean_with_neighbors(*arrays).numpy()


def plain_mean_with_neighbors(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """`mean_with_neighbors` in NumPy."""
    known = (~np.isnan(values).any(axis=1)).astype(np.float64)
    columns = np.column_stack([known, np.where(known[:, None] > 0, values, 0.0)]).T
    sums = columns.copy()
    for corner in range(3):
        first, second = faces[:, corner - 1], faces[:, corner - 2]
        for total, own in zip(sums, columns, strict=True):
            weights = own[first] + own[second]
            total += np.bincount(faces[:, corner], weights, minlength=len(values))
    with np.errstate(invalid="ignore"):
        return (sums[1:] / sums[0]).T
