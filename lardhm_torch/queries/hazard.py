"""Hazard along lines: the rate at which obstacles occur, its integrals, and survival.

Obstacles occur along a path like the events of a Poisson process with rate
lambda(x) = max(log-odds(x), 0) / length [1/m]. The path is free with probability
exp(-integral of lambda). Free and unknown space have no hazard.

As long as the k nearest clusters are the same, the log-odds along a line are a sum of Gaussians, whose
integrals are error functions. The region with given k nearest centers is convex: if the neighbors at
both ends of an interval are equal, they are the same all along it. Lines are bisected until this
holds.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, num_neighbors, to_tensor
from lardhm_torch.native import nearest_centers

HAZARD_LENGTH = 0.1  # [m] default path length over which log-odds of 1 are one expected obstacle
SHORTEST = 1e-6  # [m] intervals are not bisected below this length
SEGMENTS_AT_ONCE = 1 << 16


class Intervals(NamedTuple):
    """I intervals of segments.

    ``segment`` (I,) index of the segment; ``first`` and ``last`` (I,) ends of the interval as
    fractions of the segment; the k nearest clusters (I, K) at both ends; and whether the log-odds
    are positive (I,) at both ends.
    """

    segment: Tensor
    first: Tensor
    last: Tensor
    neighbors_first: Tensor
    neighbors_last: Tensor
    positive_first: Tensor
    positive_last: Tensor


def hazard(model: OccupancyMap, points: TensorLike, *, length: float = HAZARD_LENGTH) -> Tensor:
    """Rate at which a point meets obstacles: max(log-odds, 0) / length.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        length: path length over which log-odds of 1 are one expected obstacle [m].

    Returns:
        (...) rates [1/m], differentiable.
    """
    log_odds = model.log_odds(to_tensor(points, "points", model.origin.device))
    return log_odds.clamp(min=0) / length


def swept_integral(
    model: OccupancyMap, starts: Tensor, ends: Tensor, radius: float, step: float
) -> Tensor:
    """Largest integral of the positive log-odds among the paths of a sphere's sample points.

    The samples are the center and, for a radius above 0, 3^D - 1 points on the surface.

    Args:
        model: a map held in memory.
        starts: (S, D) float64 world positions of the center [m].
        ends: (S, D) float64 world positions of the center [m].
        radius: of the sphere [m]; 0 for a point.
        step: longest interval that is tested only at its ends [m].

    Returns:
        (S,) integrals [m], differentiable.
    """
    offsets = _sphere_points(model.dim, radius).to(starts.device)
    starts = (starts[:, None] + offsets).reshape(-1, model.dim)
    ends = (ends[:, None] + offsets).reshape(-1, model.dim)
    integrals = [starts.new_zeros(0)]
    for start, end in zip(
        starts.split(SEGMENTS_AT_ONCE), ends.split(SEGMENTS_AT_ONCE), strict=True
    ):
        intervals = _positive_intervals(model, start.detach(), end.detach(), step)
        integrals.append(_integrate(model, start, end, intervals))
    return torch.cat(integrals).reshape(-1, len(offsets)).amax(dim=1)


def survival(expected: Tensor) -> Tensor:
    """(R, S) expected obstacles in consecutive steps -> (R, S) probability to reach each step."""
    return torch.exp(-(expected.cumsum(dim=1) - expected))


def occlusion(probability: Tensor) -> Tensor:
    """Expected obstacles in a cell with this probability of occupancy, for a line of sight.

    -log(2 (1 - p)) for p > 1/2: the fraction 2 (1 - p) of the rays passes the cell. Cells up to 1/2
    do not occlude, so that sensors see into unknown space.
    """
    return -(2 * (1 - probability)).log().clamp(max=0)


def _sphere_points(dim: int, radius: float) -> Tensor:
    """(J, D) center of a sphere and points spread over its surface; the center alone for 0."""
    if radius == 0:
        return torch.zeros(1, dim, dtype=torch.float64)
    corners = torch.tensor(list(itertools.product((0.0, -1.0, 1.0), repeat=dim)))
    lengths = torch.linalg.vector_norm(corners, dim=1, keepdim=True).clamp(min=1)
    return radius * (corners / lengths).double()


@torch.no_grad()
def _positive_intervals(
    model: OccupancyMap, starts: Tensor, ends: Tensor, step: float
) -> Intervals:
    """Intervals of (S, D) segments with positive log-odds, each with one set of neighbors."""
    paths = ends - starts
    lengths = torch.linalg.vector_norm(paths, dim=1)
    counts = (lengths / step).ceil().long()  # 0 for a segment of length 0
    segment = torch.repeat_interleave(counts)
    number = torch.arange(len(segment), device=starts.device)
    number = number - (counts.cumsum(0) - counts)[segment]
    first, last = (number / counts[segment]).double(), ((number + 1) / counts[segment]).double()

    def at(which: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        return _neighbors_and_sign(model, starts[which] + fraction[:, None] * paths[which])

    (near, positive), (near_last, positive_last) = at(segment, first), at(segment, last)
    open_ = Intervals(segment, first, last, near, near_last, positive, positive_last)
    done = [_select(open_, torch.zeros_like(positive))]
    while len(open_.segment):
        uniform = (open_.neighbors_first == open_.neighbors_last).all(dim=1)
        uniform &= open_.positive_first == open_.positive_last
        uniform |= (open_.last - open_.first) * lengths[open_.segment] < SHORTEST
        done.append(_select(open_, uniform & open_.positive_last))
        rest = _select(open_, ~uniform)
        middle = (rest.first + rest.last) / 2
        near, positive = at(rest.segment, middle)
        left = rest._replace(last=middle, neighbors_last=near, positive_last=positive)
        right = rest._replace(first=middle, neighbors_first=near, positive_first=positive)
        open_ = Intervals(*(torch.cat(pair) for pair in zip(left, right, strict=True)))
    return Intervals(*(torch.cat(parts) for parts in zip(*done, strict=True)))


def _neighbors_and_sign(model: OccupancyMap, points: Tensor) -> tuple[Tensor, Tensor]:
    """(N, K) nearest clusters of (N, D) points, and (N,) whether the log-odds are positive."""
    local = (points - model.origin).to(model.centers.dtype)
    nearest = nearest_centers(local, model.centers.detach(), num_neighbors(model))
    return nearest, model.log_odds(points) > 0


def _select(intervals: Intervals, mask: Tensor) -> Intervals:
    return Intervals(*(column[mask] for column in intervals))


def _integrate(model: OccupancyMap, starts: Tensor, ends: Tensor, intervals: Intervals) -> Tensor:
    """(S,) integral of the log-odds over the intervals of each segment [m].

    With z = inv(L) (a - c) and u = inv(L) (b - a), a kernel on the line from a to b is
    exp(-|z + s u|^2 / 2) for s from 0 to 1. Its integral over s is

        exp(-|z + m u|^2 / 2) sqrt(pi / 2) / |u| (erf(|u| (1 - m) / sqrt 2) + erf(|u| m / sqrt 2))

    with the maximum at m = -z u / |u|^2.
    """
    rows, near = intervals.segment, intervals.neighbors_last
    path = ends[rows] - starts[rows]
    start = starts[rows] + intervals.first[:, None] * path
    path = (intervals.last - intervals.first)[:, None] * path
    factors = model.scale_tril.double()
    eye = torch.eye(model.dim, dtype=torch.float64, device=factors.device)
    whiten = torch.linalg.solve_triangular(factors, eye.expand_as(factors), upper=False)[near]
    offsets = start[:, None] - (model.centers.double() + model.origin)[near]  # (I, K, D)
    z = (whiten @ offsets[..., None]).squeeze(-1)
    u = (whiten @ path[:, None, :, None]).squeeze(-1)
    squared = u.square().sum(dim=-1)
    middle = -(z * u).sum(dim=-1) / squared
    peak = torch.exp(-0.5 * (z + middle[..., None] * u).square().sum(dim=-1))
    scale = squared.sqrt() / math.sqrt(2)
    area = torch.erf(scale * (1 - middle)) + torch.erf(scale * middle)
    values = model.weights.double()[near] * peak * area * (math.sqrt(math.pi) / 2) / scale
    lengths = torch.linalg.vector_norm(path, dim=1)
    return starts.new_zeros(len(starts)).index_add(0, rows, values.sum(dim=1) * lengths)
