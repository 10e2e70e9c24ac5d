"""Exploration: the information gain of a view."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.maps import OccupancyMap, TensorLike, local_parts, reads_map
from lardhm_torch.queries.hazard import NEGLIGIBLE, reached
from lardhm_torch.queries.raycasting import unit_rays

CELL = 0.1  # [m] of which an unknown one is worth 1 bit
SIGHT_LENGTH = 0.03  # [m] of the hazard for light: a wall lets less than 1 % of it through
KNOWN = 0.98  # probability of measured space; its entropy is no gain
SAME_DIRECTION = 1e-6  # edge of the cubes in which unit vectors count once
STEPS_AT_ONCE = 8
NEIGHBORS = 8  # rays that tell how densely rays lie


@torch.no_grad()
@reads_map
def information_gain(
    model: OccupancyMap,
    origin: TensorLike,
    directions: TensorLike,
    max_range: float,
    resolution: float = 0.1,
) -> float:
    """Expected information gain of a view: the entropy of the space that its rays observe.

    Space is measured in cells of `CELL` = 0.1 m; an unknown cell that is certainly observed gains
    1 bit. In general, a ray gains in each cell along it

        g(p) = (H(p) - H(0.98)) / (1 - H(0.98)), at least 0, H(p) = -p log2 p - (1 - p) log2(1 - p)

    times the probability that it gets there. H(0.98) is the entropy that remains in measured space.
    A ray is blocked at the `hazard` rate with a length of `SIGHT_LENGTH`. Unknown space has no hazard,
    so rays pass through it. Where neighboring rays are closer than a cell, each gains in proportion
    to its part of the cell; rays in the same direction count once.

    Args:
        model: the map.
        origin: (D,) position of the sensor, world frame [m].
        directions: (R, D) directions of its rays, of any length but 0.
        max_range: of the sensor [m].
        resolution: longest step along a ray [m], at most half a cell; the gain hardly depends on it.

    Returns:
        Expected gain [bits]; 0 where everything in view is known.

    Raises:
        ValueError: as for `raycast`.
    """
    origins, headings = unit_rays(model, origin, directions, max_range, resolution)
    distinct = _first_of_each(_direction_keys(headings, SAME_DIRECTION))[0]
    origins, headings = origins[distinct], headings[distinct]
    ends = origins + max_range * headings
    step = min(resolution, CELL / 2)
    spread = ray_spread(headings)
    gains = [
        _gain(part, View(origins[rows], headings[rows], spread[rows]), max_range, step)
        for rows, part in local_parts(model, origins.minimum(ends), origins.maximum(ends))
    ]
    return float(sum(gains))


class View(NamedTuple):
    """R rays: (R, D) origins [m] and unit directions, and their (R,) `ray_spread` [rad]."""

    origins: Tensor
    headings: Tensor
    spread: Tensor


def _gain(model: OccupancyMap, view: View, max_range: float, step: float) -> Tensor:
    """Gain of a view in a map held in memory [bits].

    Depths are divided into shells, each twice as deep as the one before. In a shell, one ray stands
    for all in a bundle that is as wide as a cell in the middle of the shell, the geometric mean of its
    depths. Bundles of a shell lie within those of the one before, whose hazard they take over.
    """
    total, near = view.spread.new_zeros(()), 0.0
    power = model.dim - 1
    shells = max(1, math.ceil(math.log2(max_range)))
    met = view.spread.new_zeros(1)  # expected obstacles by bundle
    bundle_before = torch.zeros_like(view.spread, dtype=torch.long)  # of each ray
    for shell in range(shells):
        far = max_range / 2 ** (shells - 1 - shell)
        first, bundle = _first_of_each(_direction_keys(view.headings, math.sqrt(2) * CELL / far))
        members = torch.bincount(bundle)
        parts = torch.zeros_like(view.spread[first]).index_add(0, bundle, view.spread**power)
        before = met[bundle_before[first]]
        count = math.ceil((far - near) / step - 1e-9)
        width = (far - near) / count
        rows = (before < -math.log(NEGLIGIBLE)).nonzero().squeeze(1)
        for start in range(0, count, STEPS_AT_ONCE):
            numbers = torch.arange(start, min(count, start + STEPS_AT_ONCE), device=rows.device)
            depths = near + (numbers + 0.5) * width
            origins, headings = (t[first[rows], None] for t in view[:2])
            log_odds = model.log_odds(origins + depths[:, None] * headings)
            hazard = log_odds.double().clamp(min=0) * (width / SIGHT_LENGTH)
            crossed = parts[rows, None] * (depths / CELL) ** power  # cells, as wide as the bundle
            crossed = torch.minimum(crossed, members[rows, None].to(crossed))
            bits = crossed * (width / CELL) * _entropy_above_known(log_odds)
            total = total + (reached(hazard, before[rows]) * bits).sum()
            before = before.index_add(0, rows, hazard.sum(dim=1))
            rows = rows[before[rows] < -math.log(NEGLIGIBLE)]
            if len(rows) == 0:
                break
        met, bundle_before, near = before, bundle, far
    return total


def _direction_keys(headings: Tensor, edge: float) -> Tensor:
    """(R,) number of the cube of this edge that each of (R, D) unit vectors lies in."""
    most = math.ceil(1 / edge) + 1
    keys = torch.zeros_like(headings[:, 0], dtype=torch.long)
    for axis in (headings / edge).floor().long().unbind(dim=1):
        keys = keys * (2 * most) + axis + most
    return keys


def _first_of_each(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Row of the first of each key, and the number of each row's key."""
    distinct, number = keys.unique(return_inverse=True)
    rows = torch.arange(len(keys), device=keys.device)
    first = torch.full_like(distinct, len(keys)).scatter_reduce(0, number, rows, "amin")
    return first, number


def _entropy_above_known(log_odds: Tensor) -> Tensor:
    """Log-odds -> entropy [bit] above that of measured space, 1 where unknown, 0 where known."""
    known = _entropy(log_odds.new_tensor(math.log(KNOWN / (1 - KNOWN))))
    return ((_entropy(log_odds) - known) / (1 - known)).clamp(min=0)


def _entropy(log_odds: Tensor) -> Tensor:
    """Log-odds l -> entropy (log(1 + e^-|l|) + |l| / (1 + e^|l|)) / log 2 [bit]."""
    size = log_odds.abs()
    return (torch.log1p(torch.exp(-size)) + size * torch.sigmoid(-size)) / math.log(2)


def ray_spread(headings: Tensor) -> Tensor:
    """(R,) width [rad] of the part of all directions that each of (R, D) distinct unit vectors stands
    for, from its nearest ones; infinite for a single ray.

    In a cone that reaches to the k-th neighbor there are k rays.
    """
    count, dim = headings.shape
    neighbors = min(NEIGHBORS, count - 1)
    if neighbors < 1 or dim == 1:
        return headings.new_full((count,), torch.inf)
    chords = _farthest_neighbor(headings.cpu(), neighbors + 1).to(headings)
    cone = math.pi * chords**2 if dim == 3 else 2 * chords
    return (cone / neighbors) ** (1 / (dim - 1))


def _farthest_neighbor(points: Tensor, count: int) -> Tensor:
    """(N,) distance of the last of the nearest ``count`` of (N, D) points, each being its own first."""
    if native.supports(points):
        rows = native.nearest_centers(points, points, count)
        return torch.linalg.vector_norm(points[rows] - points[:, None], dim=2).amax(dim=1)
    from scipy.spatial import cKDTree

    return torch.from_numpy(cKDTree(points).query(points, k=count)[0][:, -1])
