"""Where to look next: the border of what is known, and what a view would tell."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch.queries.grids import EVIDENCE, grid_axes, query_grid
from lardhm_torch.queries.raycasting import check_rays, unit_rays

WALL_MARGIN = 0.3  # [m] around obstacles, where the map passes from free to occupied


class Frontiers(NamedTuple):
    """Free places beside the unknown: (F, D) float64 world positions [m], and (F,) the number of
    the connected group of each, 0 for the largest."""

    points: Tensor
    groups: Tensor


@torch.no_grad()
def frontiers(
    model: Any, lower: Any, upper: Any, resolution: float = 0.1, wall_margin: float = WALL_MARGIN
) -> Frontiers:
    """The free lattice points with an unknown neighbor: where a robot can go and see new things.

    Free and occupied are the points whose log-odds are below -1 and above 1; between is unknown.
    On the way from free space into a wall log-odds pass through 0, so unknown points within
    ``wall_margin`` of an occupied one do not count.

    Args:
        model: the map.
        lower: D coordinates of the corner of the part to look at, world frame [m].
        upper: D coordinates of the far corner [m].
        resolution: distance of lattice points [m].
        wall_margin: [m].

    Returns:
        points and groups; groups are connected through lattice neighbors, diagonal ones too.

    Raises:
        ValueError: as for `query_grid`; or wall_margin is negative.
    """
    if not wall_margin >= 0:
        raise ValueError(f"wall_margin must be 0 m or more; got {wall_margin}")
    probability = query_grid(model, lower, upper, resolution)
    log_odds = torch.logit(probability.double())
    occupied, free = log_odds > EVIDENCE, log_odds < -EVIDENCE
    steps = round(wall_margin / resolution)
    unknown = ~occupied & ~free & ~_grow(occupied, steps, diagonal=True)
    border = free & _grow(unknown, 1, diagonal=False)
    axes = grid_axes(lower, upper, resolution, model.origin.device)
    place = border.nonzero()
    points = torch.stack([axis[i] for axis, i in zip(axes, place.T, strict=True)], dim=1)
    return Frontiers(points, _groups(border)[border])


@torch.no_grad()
def information_gain(
    model: Any,
    origin: Tensor,
    directions: Tensor,
    max_range: float,
    resolution: float = 0.1,
) -> float:
    """What a sensor at a place would tell, in bits: the entropy of the cells that it would see.

    Each ray is followed in steps of ``resolution``; a cell of that size is seen with the
    probability that the ray is still free there (cells up to 1/2 do not stop it, one of p > 1/2 lets
    the share 2 (1 - p) through), and holds H(p) = -p log2 p - (1 - p) log2(1 - p)
    bits. A cell that several rays cross counts once, for the best of them.

    Args:
        model: the map.
        origin: (D,) where the sensor would stand, world frame [m].
        directions: (R, D) of its rays, of any length but 0.
        max_range: of the sensor [m].
        resolution: edge of a cell [m].

    Returns:
        Expected gain [bits]; 0 where all in view is known.

    Raises:
        ValueError: as for `raycast`.
    """
    check_rays(model, origin, directions, max_range, resolution)
    origins, directions = unit_rays(model, origin, directions)
    count = math.ceil(max_range / resolution)
    depths = (torch.arange(count, device=origins.device).double() + 0.5) * resolution
    points = origins[:, None] + depths[:, None] * directions[:, None]  # (R, S, D)
    p = model(points).double().clamp(1e-12, 1 - 1e-12)
    bits = -(p * p.log2() + (1 - p) * (1 - p).log2())
    blocked = -(2 * (1 - p)).log().clamp(max=0)  # unknown space is looked through
    visible = torch.exp(-(blocked.cumsum(dim=1) - blocked))
    cells = (points / resolution).floor().long().reshape(-1, model.dim)
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    gain = (visible * bits).reshape(-1)
    best = gain.new_zeros(int(cell.max()) + 1 if len(cell) else 0)
    return float(best.scatter_reduce(0, cell, gain, "amax").sum())


def _grow(mask: Tensor, steps: int, *, diagonal: bool) -> Tensor:
    """The mask and all within a number of lattice steps; diagonal steps too, if asked for."""
    for _ in range(steps):
        grown = mask.clone()
        for axis in range(mask.ndim):
            source = grown if diagonal else mask
            wider = grown.clone()
            count = mask.shape[axis] - 1
            wider.narrow(axis, 0, count).logical_or_(source.narrow(axis, 1, count))
            wider.narrow(axis, 1, count).logical_or_(source.narrow(axis, 0, count))
            grown = wider
        mask = grown
    return mask


def _groups(mask: Tensor) -> Tensor:
    """(...) number of the connected group of every cell of a mask, the largest first."""
    count = mask.numel()
    label = torch.where(mask, torch.arange(count, device=mask.device).reshape(mask.shape), count)
    while True:
        spread = label
        for axis in range(
            mask.ndim
        ):  # one axis after the other: diagonal neighbors are reached, too
            wider = spread.clone()
            inner = mask.shape[axis] - 1
            near = spread.narrow(axis, 0, inner).minimum(spread.narrow(axis, 1, inner))
            for start in (0, 1):
                part = wider.narrow(axis, start, inner)
                part.copy_(part.minimum(near))
            spread = wider
        spread = torch.where(mask, spread, count)
        if torch.equal(spread, label):
            break
        label = spread
    names, number, sizes = label[mask].unique(return_inverse=True, return_counts=True)
    rank = torch.empty_like(sizes)
    rank[sizes.argsort(descending=True, stable=True)] = torch.arange(len(names), device=mask.device)
    result = torch.full_like(label, -1)
    result[mask] = rank[number]
    return result
