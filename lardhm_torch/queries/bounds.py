"""Where a map can be occupied at all: bounds on its log-odds over whole cells, not just at points.

At most k clusters answer for a point, and those of negative weight only lower its log-odds. So the
log-odds of every point of a cell are at most the sum, over the clusters of positive weight, of
their largest value in the cell. Rays skip the cells, and meshes the blocks, where that is too
little.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

Pairs = tuple[Tensor, Tensor]  # (P,) cluster and (P, D) cell

REFINEMENT = 4  # children of a coarse cell along each axis
SLACK = 1e-3  # share and log-odds added to a bound: float32 rounding of the map's own log-odds
CHUNK_PAIRS = 1 << 21  # pairs of a cluster and a cell at a time


class Cells(NamedTuple):
    """A lattice of cells: lower corner (D,) float64 [m], edge [m], and number of cells per axis."""

    corner: Tensor
    edge: float
    shape: tuple[int, ...]


def cover_cells(lower: Tensor, upper: Tensor, edge: float, most: int) -> Cells:
    """Cells over a box, of the given edge, or of a larger one that makes at most ``most``."""
    size = (upper - lower).clamp(min=1e-9)
    while math.prod(shape := tuple(int(n) for n in (size / edge).ceil().clamp(min=1))) > most:
        edge *= 1.1
    return Cells(lower, edge, shape)


@torch.no_grad()
def log_odds_ceiling(
    model: Any, cells: Cells, target: float, sign: float = 1.0, margin: float = 0.0
) -> Tensor:
    """A number that ``sign`` times the log-odds exceed nowhere in a cell.

    A point of the cell is within r of the cell's center, where r is the largest distance to a
    corner, all distances taken in the cluster's own metric |inv(L) x|. So the cluster's kernel is
    at most exp(-max(d - r, 0)^2 / 2) there, with d the distance of the cell's center. Clusters
    that stay small in a cell are left out, and k times what they can reach is added for them.

    First for cells `REFINEMENT` times as large; where these stay below ``target`` their bound
    serves all their children.

    Args:
        model: a map.
        cells: lattice, world frame.
        target: > 0, above which bounds matter.
        sign: 1 for a bound from above; -1 for one from below: log-odds >= -result.
        margin: the bounds hold this far around a cell, too [m].

    Returns:
        (n1, ..., nD) bounds, float64.
    """
    kernels = _kernels(model, target, sign)
    kernels = kernels._replace(
        centers=kernels.centers - cells.corner.to(kernels.centers), reach=kernels.reach + margin
    )
    rest = 0.25 * target + SLACK  # of the k clusters that were not followed
    coarse_shape = tuple(-(-n // REFINEMENT) for n in cells.shape)
    pairs = list(_box_pairs(kernels, cells.edge * REFINEMENT, coarse_shape))
    coarse = _sum_in_cells(kernels, pairs, cells.edge * REFINEMENT, coarse_shape, margin)
    coarse = coarse * (1 + SLACK) + rest
    active = coarse >= target
    children = tuple(n * REFINEMENT for n in coarse_shape)
    fine = _sum_in_cells(
        kernels, _child_pairs(pairs, active, coarse_shape), cells.edge, children, margin
    ).reshape(children)
    fine = fine * (1 + SLACK) + rest
    for axis in range(model.dim):
        coarse = coarse.reshape(coarse_shape) if axis == 0 else coarse
        coarse = coarse.repeat_interleave(REFINEMENT, dim=axis)
    result = torch.minimum(coarse, torch.where(coarse >= target, fine, torch.inf))
    return result[tuple(slice(n) for n in cells.shape)]


@torch.no_grad()
def ceiling_box(model: Any, target: float, sign: float = 1.0) -> tuple[Tensor, Tensor] | None:
    """Corners (D,) of a box outside of which ``sign`` times the log-odds stay below the target.

    World frame, float64 [m]; None where they do so everywhere.
    """
    kernels = _kernels(model, target, sign)
    if len(kernels.weights) == 0:
        return None
    lower, upper = kernels.centers - kernels.reach, kernels.centers + kernels.reach
    return lower.amin(dim=0), upper.amax(dim=0)


class _Kernels(NamedTuple):
    """The S clusters that speak: weights (S,), centers (S, D) [m], inverse factors (S, D, D) [1/m],
    and half edges (S, D) of the boxes beyond which they are silent [m].
    """

    weights: Tensor
    centers: Tensor
    whiten: Tensor
    reach: Tensor


def _kernels(model: Any, target: float, sign: float) -> _Kernels:
    tail = 0.25 * target / max(1, getattr(model, "num_neighbors", len(model.weights)))
    weights = sign * model.weights.detach().double()
    speaking = (weights > tail).nonzero().squeeze(1)
    weights, factors = weights[speaking], model.scale_tril.detach().double()[speaking]
    centers = model.centers.detach().double()[speaking] + model.origin
    eye = torch.eye(model.dim, dtype=torch.float64, device=weights.device)
    whiten = torch.linalg.solve_triangular(factors, eye.expand_as(factors), upper=False)
    stds = torch.linalg.vector_norm(factors, dim=2)
    return _Kernels(weights, centers, whiten, (2 * (weights / tail).log()).sqrt()[:, None] * stds)


def _box_pairs(kernels: _Kernels, edge: float, shape: tuple[int, ...]) -> Iterator[Pairs]:
    """All cells that each cluster's box touches, in chunks: (P,) cluster and (P, D) cell."""
    last = torch.tensor(shape, device=kernels.weights.device) - 1
    first = ((kernels.centers - kernels.reach) / edge).floor().long().clamp(min=0)
    until = ((kernels.centers + kernels.reach) / edge).floor().long().minimum(last)
    spans = (until - first + 1).clamp(min=0)
    counts = spans.prod(dim=1)
    order = (counts > 0).nonzero().squeeze(1)
    chunk_of = (counts[order].cumsum(0) - 1) // CHUNK_PAIRS
    for clusters in order.split(torch.bincount(chunk_of).tolist() if len(order) else []):
        owner = torch.repeat_interleave(clusters, counts[clusters])
        starts = counts[clusters].cumsum(0) - counts[clusters]
        rest = torch.arange(len(owner), device=owner.device)
        rest = rest - torch.repeat_interleave(starts, counts[clusters])
        columns = []
        for axis in reversed(range(len(shape))):
            columns.append(first[owner, axis] + rest % spans[owner, axis])
            rest = rest // spans[owner, axis]
        yield owner, torch.stack(columns[::-1], dim=1)


def _child_pairs(pairs: list[Pairs], active: Tensor, shape: tuple[int, ...]) -> Iterator[Pairs]:
    """The same for the children of active coarse cells."""
    dim = len(shape)
    steps = torch.tensor(
        list(itertools.product(range(REFINEMENT), repeat=dim)), device=active.device
    )
    for owners, cells in pairs:
        kept = active[_place(cells, shape)]
        size = max(1, CHUNK_PAIRS // len(steps))
        for owner, cell in zip(owners[kept].split(size), cells[kept].split(size), strict=True):
            children = (cell[:, None] * REFINEMENT + steps).reshape(-1, dim)
            yield owner.repeat_interleave(len(steps)), children


def _sum_in_cells(
    kernels: _Kernels, pairs: Iterable[Pairs], edge: float, shape: tuple[int, ...], margin: float
) -> Tensor:
    """(cells,) sum of the largest values that the clusters can have in each cell."""
    dim, device = len(shape), kernels.weights.device
    far = 0.5 * edge + margin
    corners = itertools.product((far, -far), repeat=dim - 1)
    half = torch.tensor([[far, *rest] for rest in corners], device=device).double()
    radius = torch.linalg.vector_norm(kernels.whiten @ half.T, dim=1).amax(dim=1)
    total = half.new_zeros(math.prod(shape))
    for owner, cell in pairs:
        offsets = (cell + 0.5) * edge - kernels.centers[owner]
        whitened = (kernels.whiten[owner] @ offsets[:, :, None]).squeeze(2)
        nearest = (torch.linalg.vector_norm(whitened, dim=1) - radius[owner]).clamp(min=0)
        value = kernels.weights[owner] * torch.exp(-0.5 * nearest.square())
        total.index_add_(0, _place(cell, shape), value)
    return total


def _place(cell: Tensor, shape: tuple[int, ...]) -> Tensor:
    """(P, D) cells -> (P,) place in the flattened lattice."""
    place = cell[:, 0]
    for axis in range(1, len(shape)):
        place = place * shape[axis] + cell[:, axis]
    return place
