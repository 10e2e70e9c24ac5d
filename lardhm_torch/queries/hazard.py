"""Hazard along lines: the rate at which obstacles occur, its integrals, and survival.

Obstacles occur along a path like the events of a Poisson process with rate
lambda(x) = max(log-odds(x), 0) / length [1/m]. The path is free with probability
exp(-integral of lambda). Free and unknown space have no hazard. The integral for a sphere is the
largest among the paths of its center and of points spread over its surface.

The log-odds along a line are smooth, because neighbors fade out before others replace them. They are
integrated between sign changes, which are found by bisection, by Gauss-Legendre quadrature with a
few nodes per step. Its weights are positive, so the result is never negative.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from numpy.polynomial.legendre import leggauss
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, to_tensor

HAZARD_LENGTH = 0.1  # [m] default path length over which log-odds of 1 are one expected obstacle
SHORTEST = 1e-6  # [m] intervals are not bisected below this length
NODES = 8  # of the quadrature, per interval
NEGLIGIBLE = 1e-4  # probability to get somewhere below which nothing is expected of it
SEGMENTS_AT_ONCE = 1 << 16


class Intervals(NamedTuple):
    """I intervals of segments.

    ``segment`` (I,) index of the segment; ``first`` and ``last`` (I,) ends of the interval as
    fractions of the segment; and whether the log-odds are positive (I,) at both ends.
    """

    segment: Tensor
    first: Tensor
    last: Tensor
    positive_first: Tensor
    positive_last: Tensor


def hazard(model: OccupancyMap, points: TensorLike, *, length: float = HAZARD_LENGTH) -> Tensor:
    """Rate at which a point meets obstacles: max(log-odds, 0) / length.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        length: length of a path with log-odds of 1 on which one obstacle is expected [m].

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
    offsets = sphere_points(model.dim, radius).to(starts.device)
    starts = (starts[:, None] + offsets).reshape(-1, model.dim)
    ends = (ends[:, None] + offsets).reshape(-1, model.dim)
    integrals = [starts.new_zeros(0)]
    for start, end in zip(
        starts.split(SEGMENTS_AT_ONCE), ends.split(SEGMENTS_AT_ONCE), strict=True
    ):
        intervals = _positive_intervals(model, start.detach(), end.detach(), step)
        integrals.append(_integrate(model, start, end, intervals))
    return torch.cat(integrals).reshape(-1, len(offsets)).amax(dim=1)


def reached(expected: Tensor, before: Tensor) -> Tensor:
    """(R, S) expected obstacles in consecutive steps -> (R, S) probability to get through each.

    It is the mean over the step, where the hazard is taken as constant. Probabilities below
    `NEGLIGIBLE` become 0, and all others are stretched to [0, 1]: a march may end there.

    Args:
        expected: (R, S) 0 or more.
        before: (R,) expected obstacles before the first of the steps.
    """
    at_start = torch.exp(-(before[:, None] + expected.cumsum(dim=1) - expected))
    small = expected < 1e-4
    divisor = torch.where(small, 1.0, expected)  # (1 - exp(-h)) / h
    within = torch.where(small, 1 - expected / 2, -torch.expm1(-expected) / divisor)
    return ((at_start * within - NEGLIGIBLE) / (1 - NEGLIGIBLE)).clamp(min=0)


def sphere_points(dim: int, radius: float) -> Tensor:
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
    """Intervals of (S, D) segments with positive log-odds, none longer than a step."""
    paths = ends - starts
    lengths = torch.linalg.vector_norm(paths, dim=1)
    counts = (lengths / step).ceil().long()  # 0 for a segment of length 0
    segment = torch.repeat_interleave(counts)
    number = torch.arange(len(segment), device=starts.device)
    number = number - (counts.cumsum(0) - counts)[segment]
    first, last = (number / counts[segment]).double(), ((number + 1) / counts[segment]).double()

    def positive(which: Tensor, fraction: Tensor) -> Tensor:
        return model.log_odds(starts[which] + fraction[:, None] * paths[which]) > 0

    signs = positive(segment, first), positive(segment, last)
    open_ = Intervals(segment, first, last, *signs)
    done = [_select(open_, torch.zeros_like(signs[0]))]
    while len(open_.segment):
        uniform = open_.positive_first == open_.positive_last
        uniform |= (open_.last - open_.first) * lengths[open_.segment] < SHORTEST
        done.append(_select(open_, uniform & open_.positive_last))
        rest = _select(open_, ~uniform)
        middle = (rest.first + rest.last) / 2
        sign = positive(rest.segment, middle)
        left = rest._replace(last=middle, positive_last=sign)
        right = rest._replace(first=middle, positive_first=sign)
        open_ = Intervals(*(torch.cat(pair) for pair in zip(left, right, strict=True)))
    return Intervals(*(torch.cat(parts) for parts in zip(*done, strict=True)))


def _select(intervals: Intervals, mask: Tensor) -> Intervals:
    return Intervals(*(column[mask] for column in intervals))


def _integrate(model: OccupancyMap, starts: Tensor, ends: Tensor, intervals: Intervals) -> Tensor:
    """(S,) integral of the log-odds over the intervals of each segment [m]."""
    rows = intervals.segment
    path = ends[rows] - starts[rows]
    start = starts[rows] + intervals.first[:, None] * path
    path = (intervals.last - intervals.first)[:, None] * path
    nodes, shares = (torch.from_numpy(x).to(starts.device) for x in leggauss(NODES))
    points = start[:, None] + (0.5 + 0.5 * nodes[:, None]) * path[:, None]  # (I, NODES, D)
    means = (model.log_odds(points).double().clamp(min=0) * shares).sum(dim=1) / 2
    lengths = torch.linalg.vector_norm(path, dim=1)
    return starts.new_zeros(len(starts)).index_add(0, rows, means * lengths)
