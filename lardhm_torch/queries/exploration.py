"""Exploration: frontiers of the known free space, and the information gain of a view."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike
from lardhm_torch.queries.grids import EVIDENCE, grid_axes, query_grid
from lardhm_torch.queries.hazard import occlusion, survival
from lardhm_torch.queries.raycasting import unit_rays

WALL_MARGIN = 0.3  # [m] around obstacles, where log-odds pass from free to occupied


class Frontiers(NamedTuple):
    """F frontier points.

    ``points`` (F, D) float64 world positions [m]; ``groups`` (F,) index of the connected group of
    each point, 0 for the largest group.
    """

    points: Tensor
    groups: Tensor


@torch.no_grad()
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
    point are ignored.

    Args:
        model: the map.
        lower: (D,) lower corner of the region, world frame [m].
        upper: (D,) upper corner [m].
        resolution: distance between neighboring points [m].
        wall_margin: width of the ignored layer around obstacles [m].

    Returns:
        points and groups; grid points that touch, also diagonally, are in one group.

    Raises:
        ValueError: as for `query_grid`; or wall_margin is negative.
    """
    from scipy.ndimage import binary_dilation

    if not wall_margin >= 0:
        raise ValueError(f"wall_margin must be 0 m or more; got {wall_margin}")
    probability = query_grid(model, lower, upper, resolution)
    log_odds = torch.logit(probability.double()).cpu().numpy()
    occupied, free = log_odds > EVIDENCE, log_odds < -EVIDENCE
    steps = round(wall_margin / resolution)
    if steps > 0:  # 0 iterations would mean: until nothing changes
        occupied = binary_dilation(occupied, _with_diagonals(occupied.ndim), iterations=steps)
    border = free & binary_dilation(~occupied & ~free)
    device = model.origin.device
    axes = grid_axes(lower, upper, resolution, device)
    indices = [torch.from_numpy(index).to(device) for index in border.nonzero()]
    points = torch.stack([axis[index] for axis, index in zip(axes, indices, strict=True)], dim=1)
    return Frontiers(points, torch.from_numpy(_group_ranks(border)).to(device))


@torch.no_grad()
def information_gain(
    model: OccupancyMap,
    origin: TensorLike,
    directions: TensorLike,
    max_range: float,
    resolution: float = 0.1,
) -> float:
    """Expected information gain of a view: the entropy of the cells that its rays see.

    Each ray is followed in steps of ``resolution``. A cell with probability p has the entropy
    H(p) = -p log2 p - (1 - p) log2(1 - p) bits and counts with the probability that the ray reaches
    it (`hazard.occlusion`: unknown cells do not occlude). A cell that several rays cross counts
    once, for the ray that sees it best.

    Args:
        model: the map.
        origin: (D,) position of the sensor, world frame [m].
        directions: (R, D) directions of its rays, of any length but 0.
        max_range: of the sensor [m].
        resolution: edge of a cell [m].

    Returns:
        Expected gain [bits]; 0 where everything in view is known.

    Raises:
        ValueError: as for `raycast`.
    """
    origins, headings = unit_rays(model, origin, directions, max_range, resolution)
    count = math.ceil(max_range / resolution)
    depths = (torch.arange(count, device=origins.device).double() + 0.5) * resolution
    points = origins[:, None] + depths[:, None] * headings[:, None]  # (R, S, D)
    p = model(points).double().clamp(1e-12, 1 - 1e-12)
    bits = -(p * p.log2() + (1 - p) * (1 - p).log2())
    gains = (survival(occlusion(p)) * bits).reshape(-1)
    cells = (points / resolution).floor().long().reshape(-1, model.dim)
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    best = gains.new_zeros(int(cell.max()) + 1 if len(cell) else 0)
    return float(best.scatter_reduce(0, cell, gains, "amax").sum())


def _with_diagonals(dim: int) -> np.ndarray:
    """(3, ..., 3) neighborhood of a grid point that includes the diagonal neighbors."""
    return np.ones((3,) * dim, dtype=bool)


def _group_ranks(mask: np.ndarray) -> np.ndarray:
    """(F,) rank of the connected group of each True point of a mask, 0 for the largest group."""
    from scipy.ndimage import label

    labels = label(mask, _with_diagonals(mask.ndim))[0][mask] - 1
    by_size = np.argsort(-np.bincount(labels), kind="stable")
    return np.argsort(by_size, kind="stable")[labels]
