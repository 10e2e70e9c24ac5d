"""Frontiers: free space next to unknown space, in connected groups."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, reads_map
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN, grid_axes, lattice_values

WALL_MARGIN = 0.3  # [m] around obstacles, where log-odds pass from free to occupied
POINTS_AT_ONCE = 1 << 22


class Frontiers(NamedTuple):
    """F frontier points.

    ``points`` (F, D) float64 world positions [m]; ``groups`` (F,) index of the connected group of
    each point, 0 for the largest group.
    """

    points: Tensor
    groups: Tensor


@torch.no_grad()
@reads_map
def frontiers(
    model: OccupancyMap,
    lower: TensorLike,
    upper: TensorLike,
    resolution: float = 0.1,
    wall_margin: float = WALL_MARGIN,
) -> Frontiers:
    """Free grid points next to unknown space, in connected groups.

    Points with log-odds below -1 are free, above 1 occupied, and unknown otherwise. Log-odds pass
    through 0 between free space and a wall, so unknown points within ``wall_margin`` of an occupied
    point are ignored. The grid is queried in slabs, so it need not fit in memory.

    Args:
        model: the map.
        lower: (D,) lower corner of the region, world frame [m].
        upper: (D,) upper corner [m].
        resolution: distance between neighboring points [m].
        wall_margin: width of the ignored layer around obstacles [m].

    Returns:
        points and groups; neighboring grid points, also diagonal ones, are in one group.

    Raises:
        ValueError: as for `grid`; the corners do not have the dimension of the map; or wall_margin is
            negative.
    """
    if not wall_margin >= 0:
        raise ValueError(f"wall_margin must be 0 m or more; got {wall_margin}")
    device = model.origin.device
    axes = grid_axes(lower, upper, resolution, device)
    if len(axes) != model.dim:
        raise ValueError(f"lower and upper must have {model.dim} coordinates; got {len(axes)}")
    layers = round(wall_margin / resolution)
    shape = [len(axis) for axis in axes]
    rows = max(1, POINTS_AT_ONCE // math.prod(shape[1:]))
    parts = [np.empty((0, len(axes)), dtype=np.int64)]
    for first in range(0, shape[0], rows):
        last = min(shape[0], first + rows)
        begin, end = max(0, first - layers - 1), min(shape[0], last + layers + 1)
        slab = lattice_values(model, [axes[0][begin:end], *axes[1:]], probability=False)
        is_border = _borders(slab.cpu().numpy(), layers)[first - begin : last - begin]
        parts.append(np.argwhere(is_border) + np.eye(len(axes), dtype=np.int64)[0] * first)
    places = np.concatenate(parts)
    indices = torch.from_numpy(places).to(device)
    points = torch.stack([axis[i] for axis, i in zip(axes, indices.unbind(1), strict=True)], dim=1)
    return Frontiers(points, torch.from_numpy(_group_ranks(places, shape)).to(device))


def _borders(log_odds: np.ndarray, layers: int) -> np.ndarray:
    """Free points beside an unknown one that is farther than some layers from the occupied points."""
    from scipy.ndimage import binary_dilation, maximum_filter

    occupied, free = log_odds > LOG_ODDS_MARGIN, log_odds < -LOG_ODDS_MARGIN
    if layers > 0:
        occupied = maximum_filter(occupied, 2 * layers + 1, mode="constant")
    return free & binary_dilation(~occupied & ~free)


def _group_ranks(places: np.ndarray, shape: list[int]) -> np.ndarray:
    """(F,) rank of the connected group of each of (F, D) sorted grid points, 0 for the largest."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(places)
    strides = np.array([math.prod(n + 2 for n in shape[d + 1 :]) for d in range(len(shape))])
    keys = (places + 1) @ strides  # ascending; the border of the grid has none
    pairs = [np.empty((2, 0), dtype=np.int64)]
    for offset in itertools.product((-1, 0, 1), repeat=len(shape)):
        wanted = keys + np.array(offset) @ strides
        found = np.searchsorted(keys, wanted).clip(max=max(count - 1, 0))
        rows = (keys[found] == wanted).nonzero()[0] if count else found
        pairs.append(np.stack([rows, found[rows]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    by_size = np.argsort(-np.bincount(labels), kind="stable")
    return np.argsort(by_size, kind="stable")[labels]
