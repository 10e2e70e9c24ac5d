"""Is a straight way free? Integrals of the map's log-odds along lines.

Obstacles are met at a rate, the hazard lambda(x) = max(log-odds(x), 0) / length [1/m], as in a Poisson
process: the way from a to b is free with probability exp(-integral of lambda from a to b). Where the
map says "free" or "unknown" nothing is met; ask `exploring` what is unknown.

Log-odds along a line are smooth, for neighbors fade out before they are replaced: Gauss-Legendre
quadrature of a few points a step is as good as exact, between the places where they change sign.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from numpy.polynomial.legendre import leggauss
from torch import Tensor

from lardhm_torch.querying import local_parts
from lardhm_torch.rays import check_rays, unit_rays
from lardhm_torch.surface import surface_step

HAZARD_LENGTH = 0.1  # [m] over which log-odds count once
SHORTEST = 1e-6  # [m] so sharp are the places found where log-odds are 0
NODES = 5  # of the quadrature, an interval
SEGMENTS_AT_ONCE = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Mover:
    """What goes along a way, and how cautiously."""

    radius: float = 0.0  # [m] of a sphere; 0 for a point
    length: float = HAZARD_LENGTH  # [m] over which log-odds count once; smaller is more cautious
    step: float | None = None  # [m] longest interval looked at as a whole; an obstacle thinner than
    # this can be missed. None: half that of `raycast`

    def __post_init__(self) -> None:
        if not (self.radius >= 0 and math.isfinite(self.radius)):
            raise ValueError(f"radius must be 0 m or more and finite; got {self.radius}")
        if not self.length > 0:
            raise ValueError(f"length must be > 0 m; got {self.length}")
        if self.step is not None and not self.step > 0:
            raise ValueError(f"step must be > 0 m; got {self.step}")


class _Intervals(NamedTuple):
    """I pieces of segments: their number (I,), first and last share of the way (I,), and whether
    log-odds are above 0 at both ends (I,)."""

    segment: Tensor
    first: Tensor
    last: Tensor
    above_first: Tensor
    above_last: Tensor


def hazard(model: Any, points: Tensor, *, length: float = HAZARD_LENGTH) -> Tensor:
    """(..., D) world positions [m] -> (...) rate at which a point meets obstacles there [1/m]."""
    return model.log_odds(points).clamp(min=0) / length


def segment_hazard(model: Any, starts: Tensor, ends: Tensor, mover: Mover | None = None) -> Tensor:
    """Number of obstacles that a mover expects to meet on straight ways; differentiable.

    The integral of the `hazard` along each way, by `NODES` points an interval of at most a step.
    Obstacles thinner than a step can be missed. A sphere sweeps the ways of all
    its points, and the worst of them counts; it is looked for among the center and 3^D - 1 points
    spread over the surface, so the result is a bound from below. `bounding.clearance`
    is one from the other side: where it is nowhere below the radius, the sphere meets nothing.

    Args:
        model: the map.
        starts: (S, D) world positions [m].
        ends: (S, D) world positions [m].
        mover: what goes there; left out: a point.

    Returns:
        (S,) float64, 0 or more.

    Raises:
        ValueError: starts and ends are not (S, D) both.
    """
    if starts.ndim != 2 or starts.shape != ends.shape or starts.shape[1] != model.dim:
        raise ValueError(
            f"starts and ends must be (S, {model.dim}) both; "
            f"got {tuple(starts.shape)} and {tuple(ends.shape)}"
        )
    mover = mover or Mover()
    starts, ends = (x.to(model.origin.device, torch.float64) for x in (starts, ends))
    result = starts.new_zeros(len(starts))
    boxes = starts.minimum(ends) - mover.radius, starts.maximum(ends) + mover.radius
    step = surface_step(model) / 2 if mover.step is None else mover.step
    for rows, part in local_parts(model, *boxes):
        met = _segment_hazard(part, starts[rows], ends[rows], mover.radius, step)
        result = result.index_copy(0, rows, met / mover.length)
    return result


def _segment_hazard(model: Any, starts: Tensor, ends: Tensor, radius: float, step: float) -> Tensor:
    """(S,) the largest integral of log-odds above 0 over the ways of a ball's points [m]."""
    offsets = _ball(model.dim, radius).to(starts.device)
    starts = (starts[:, None] + offsets).reshape(-1, model.dim)
    ends = (ends[:, None] + offsets).reshape(-1, model.dim)
    parts = [starts.new_zeros(0)]
    for start, end in zip(
        starts.split(SEGMENTS_AT_ONCE), ends.split(SEGMENTS_AT_ONCE), strict=True
    ):
        pieces = _cut(model, start.detach(), end.detach(), step)
        parts.append(_integrate(model, start, end, pieces))
    return torch.cat(parts).reshape(-1, len(offsets)).amax(dim=1)


def free_probability(
    model: Any, starts: Tensor, ends: Tensor, mover: Mover | None = None
) -> Tensor:
    """(S,) probability that nothing is met on the way from (S, D) starts to (S, D) ends.

    exp(-`segment_hazard`), with its arguments and errors.
    """
    return torch.exp(-segment_hazard(model, starts, ends, mover))


def expected_range(
    model: Any,
    origins: Tensor,
    directions: Tensor,
    max_range: float,
    mover: Mover | None = None,
) -> Tensor:
    """How far each ray gets on average; differentiable.

    E[min(range, max_range)] = integral of exp(-Lambda(t)) from 0 to max_range, where Lambda(t) is
    the integral of the hazard up to t: exact at the ends of steps, and taken as linear within them.

    Args:
        model: the map.
        origins: (R, D) or (D,) starts, world frame [m].
        directions: (R, D) of any length but 0.
        max_range: [m].
        mover: what goes there; left out: a point, in steps as of `raycast`.

    Returns:
        (R,) float64 [m].

    Raises:
        ValueError: as for `raycast`.
    """
    mover = mover or Mover()
    check_rays(model, origins, directions, max_range, mover.step)
    origins, directions = unit_rays(model, origins, directions)
    result, ends = origins.new_zeros(len(origins)), origins + max_range * directions
    mover = replace(mover, step=surface_step(model) if mover.step is None else mover.step)
    for rows, part in local_parts(model, origins.minimum(ends), origins.maximum(ends)):
        far = _expected_range(part, origins[rows], directions[rows], max_range, mover)
        result = result.index_copy(0, rows, far)
    return result


def _expected_range(
    model: Any, origins: Tensor, directions: Tensor, max_range: float, mover: Mover
) -> Tensor:
    count = math.ceil(max_range / (mover.step or max_range))
    edges = torch.linspace(0, max_range, count + 1, dtype=torch.float64, device=origins.device)
    points = origins[:, None] + edges[:, None] * directions[:, None]  # (R, count + 1, D)
    starts, ends = (part.reshape(-1, model.dim) for part in (points[:, :-1], points[:, 1:]))
    met = segment_hazard(model, starts, ends, mover).reshape(-1, count)
    survived = torch.exp(-(met.cumsum(dim=1) - met))
    small = met < 1e-4
    share = torch.where(small, 1 - met / 2, -torch.expm1(-met) / torch.where(small, 1.0, met))
    return (survived * share).sum(dim=1) * (max_range / count)


def _ball(dim: int, radius: float) -> Tensor:
    """(J, D) the center and points spread over the surface of a ball; the center alone for 0."""
    if radius == 0:
        return torch.zeros(1, dim, dtype=torch.float64)
    corners = torch.tensor(list(itertools.product((0.0, -1.0, 1.0), repeat=dim)))
    lengths = torch.linalg.vector_norm(corners, dim=1, keepdim=True).clamp(min=1)
    return radius * (corners / lengths).double()


@torch.no_grad()
def _cut(model: Any, starts: Tensor, ends: Tensor, step: float) -> _Intervals:
    """The intervals with log-odds above 0, none longer than a step."""
    ways = ends - starts
    meters = torch.linalg.vector_norm(ways, dim=1)
    counts = (meters / step).ceil().long()  # none for a way of length 0
    segment = torch.repeat_interleave(counts)
    number = torch.arange(len(segment), device=starts.device)
    number = number - (counts.cumsum(0) - counts)[segment]
    first, last = number / counts[segment], (number + 1) / counts[segment]

    def above(which: Tensor, share: Tensor) -> Tensor:
        return model.log_odds(starts[which] + share[:, None].double() * ways[which]) > 0

    ends_above = above(segment, first.double()), above(segment, last.double())
    pieces = _Intervals(segment, first.double(), last.double(), *ends_above)
    done = [_select(pieces, torch.zeros_like(pieces.above_last))]
    while len(pieces.segment):
        whole = pieces.above_first == pieces.above_last
        whole |= (pieces.last - pieces.first) * meters[pieces.segment] < SHORTEST
        done.append(_select(pieces, whole & pieces.above_last))
        rest = _select(pieces, ~whole)
        middle = (rest.first + rest.last) / 2
        at_middle = above(rest.segment, middle)
        left = rest._replace(last=middle, above_last=at_middle)
        right = rest._replace(first=middle, above_first=at_middle)
        pieces = _Intervals(*(torch.cat(pair) for pair in zip(left, right, strict=True)))
    return _Intervals(*(torch.cat(parts) for parts in zip(*done, strict=True)))


def _select(pieces: _Intervals, mask: Tensor) -> _Intervals:
    return _Intervals(*(column[mask] for column in pieces))


def _integrate(model: Any, starts: Tensor, ends: Tensor, pieces: _Intervals) -> Tensor:
    """(S,) integral of the log-odds over all intervals of each segment [m]."""
    rows = pieces.segment
    way = ends[rows] - starts[rows]
    start = starts[rows] + pieces.first[:, None] * way
    way = (pieces.last - pieces.first)[:, None] * way
    nodes, shares = (torch.from_numpy(x).to(starts.device) for x in leggauss(NODES))
    points = start[:, None] + (0.5 + 0.5 * nodes[:, None]) * way[:, None]  # (I, NODES, D)
    values = (model.log_odds(points).double() * shares).sum(dim=1) / 2
    meters = torch.linalg.vector_norm(way, dim=1)
    return starts.new_zeros(len(starts)).index_add(0, rows, values * meters)
