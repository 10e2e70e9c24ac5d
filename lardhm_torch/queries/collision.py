"""Is a straight way free? Integrals of the map's log-odds along lines, in closed form.

Obstacles are met at a rate, the hazard lambda(x) = max(log-odds(x), 0) / length [1/m], as in a Poisson
process: the way from a to b is free with probability exp(-integral of lambda from a to b). Where the
map says "free" or "unknown" nothing is met; ask `exploring` what is unknown.

Where the k nearest clusters stay the same, log-odds along a line are a sum of Gaussians of the way,
each with an error function as its integral. The places with the same k nearest are convex, so equal
neighbors at both ends of an interval mean equal neighbors all along it: the line is cut until that
is so.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch.native import nearest_centers
from lardhm_torch.queries.bounds import CHUNK_PAIRS
from lardhm_torch.queries.grids import EVIDENCE, local_parts
from lardhm_torch.queries.raycasting import check_rays, surface_step, unit_rays

HAZARD_LENGTH = 0.1  # [m] over which log-odds count once
SHORTEST = (
    1e-6  # [m] no interval is cut below this: what is left out is no more than the jump times it
)
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
    """I pieces of segments: their number (I,), first and last share of the way (I,), and at both
    ends the k nearest clusters (I, K) and whether log-odds are above 0 (I,)."""

    segment: Tensor
    first: Tensor
    last: Tensor
    near_first: Tensor
    near_last: Tensor
    above_first: Tensor
    above_last: Tensor


def hazard(model: Any, points: Tensor, *, length: float = HAZARD_LENGTH) -> Tensor:
    """(..., D) world positions [m] -> (...) rate at which a point meets obstacles there [1/m]."""
    return model.log_odds(points).clamp(min=0) / length


def segment_hazard(model: Any, starts: Tensor, ends: Tensor, mover: Mover | None = None) -> Tensor:
    """Number of obstacles that a mover expects to meet on straight ways; differentiable.

    The integral of the `hazard` along each way. With z = inv(L) (a - c) and u = inv(L) (b - a) a
    kernel on the way from a to b is exp(-|z + s u|^2 / 2), s from 0 to 1, and its integral over s is

        exp(-|z + m u|^2 / 2) sqrt(pi / 2) / |u| (erf(|u| (1 - m) / sqrt 2) + erf(|u| m / sqrt 2))

    with its middle at m = -z u / |u|^2. Gradients take the neighbors as they are, like those of the map.

    For a point this is exact, but for obstacles thinner than a step. A sphere sweeps the ways of all
    its points, and the worst of them counts; it is looked for among the center and 3^D - 1 points
    spread over the surface, each exact, so the result is a bound from below. `bounding.clearance`
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
    """Probability that straight segments are free of collisions: exp(-`segment_hazard`).

    Args:
        model: a map.
        starts: (S, D) world positions [m].
        ends: (S, D) world positions [m].
        mover: robot shape and hazard scale; None: a point.

    Returns:
        (S,) probabilities, differentiable.

    Raises:
        ValueError: see `segment_hazard`.
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


def _nearest(model: Any, points: Tensor) -> tuple[Tensor, Tensor]:
    """(N, K) clusters that answer for (N, D) points, and (N,) whether log-odds are above 0."""
    local = (points - model.origin).to(model.centers.dtype)
    k = getattr(model, "num_neighbors", len(model.centers))
    return nearest_centers(local, model.centers.detach(), k), model.log_odds(points) > 0


@torch.no_grad()
def _cut(model: Any, starts: Tensor, ends: Tensor, step: float) -> _Intervals:
    """The intervals with log-odds above 0, each with one set of neighbors."""
    ways = ends - starts
    meters = torch.linalg.vector_norm(ways, dim=1)
    counts = (meters / step).ceil().long()  # none for a way of length 0
    segment = torch.repeat_interleave(counts)
    number = torch.arange(len(segment), device=starts.device)
    number = number - (counts.cumsum(0) - counts)[segment]
    first, last = number / counts[segment], (number + 1) / counts[segment]

    def at(which: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        return _nearest(model, starts[which] + share[:, None].double() * ways[which])

    (near, above), (near_last, above_last) = at(segment, first.double()), at(segment, last.double())
    pieces = _Intervals(segment, first.double(), last.double(), near, near_last, above, above_last)
    done = [_select(pieces, torch.zeros_like(above))]
    while len(pieces.segment):
        whole = (pieces.near_first == pieces.near_last).all(dim=1)
        whole &= pieces.above_first == pieces.above_last
        whole |= (pieces.last - pieces.first) * meters[pieces.segment] < SHORTEST
        done.append(_select(pieces, whole & pieces.above_last))
        rest = _select(pieces, ~whole)
        middle = (rest.first + rest.last) / 2
        near, above = at(rest.segment, middle)
        left = rest._replace(last=middle, near_last=near, above_last=above)
        right = rest._replace(first=middle, near_first=near, above_first=above)
        pieces = _Intervals(*(torch.cat(pair) for pair in zip(left, right, strict=True)))
    return _Intervals(*(torch.cat(parts) for parts in zip(*done, strict=True)))


def _select(pieces: _Intervals, mask: Tensor) -> _Intervals:
    return _Intervals(*(column[mask] for column in pieces))


def _integrate(model: Any, starts: Tensor, ends: Tensor, pieces: _Intervals) -> Tensor:
    """(S,) integral of the log-odds over all intervals of each segment [m]."""
    rows, near = pieces.segment, pieces.near_last
    way = ends[rows] - starts[rows]
    start = starts[rows] + pieces.first[:, None] * way
    way = (pieces.last - pieces.first)[:, None] * way
    factors = model.scale_tril.double()
    eye = torch.eye(model.dim, dtype=torch.float64, device=factors.device)
    whiten = torch.linalg.solve_triangular(factors, eye.expand_as(factors), upper=False)[near]
    offsets = start[:, None] - (model.centers.double() + model.origin)[near]  # (I, K, D)
    z = (whiten @ offsets[..., None]).squeeze(-1)
    u = (whiten @ way[:, None, :, None]).squeeze(-1)
    squared = u.square().sum(dim=-1)
    middle = -(z * u).sum(dim=-1) / squared
    peak = torch.exp(-0.5 * (z + middle[..., None] * u).square().sum(dim=-1))
    scale = squared.sqrt() / math.sqrt(2)
    bell = torch.erf(scale * (1 - middle)) + torch.erf(scale * middle)
    values = model.weights.double()[near] * peak * bell * (math.sqrt(math.pi) / 2) / scale
    meters = torch.linalg.vector_norm(way, dim=1)
    return starts.new_zeros(len(starts)).index_add(0, rows, values.sum(dim=1) * meters)


def clearance(model: Any, points: Tensor, threshold: float = 0.5) -> Tensor:
    """At least so far is every point from obstacles; differentiable, for planning.

    A place is clearly occupied where log-odds exceed the threshold's by `EVIDENCE`, as for
    `raycast`. As at most k clusters answer, one of them must reach the k-th part of that there, so
    the place lies in the ellipsoid |inv(L) (x - c)| <= E of a cluster of positive weight, with
    E = sqrt(2 log(k w / log-odds)). No point is nearer to an ellipsoid than either
    (|inv(L) (x - c)| - E) times the smallest standard deviation, or |x - c| - E times the largest.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        threshold: probability of occupancy that counts as an obstacle, between 0 and 1.

    Returns:
        (...) float64 [m]: no larger than the distance to the nearest obstacle, and changing by no
        more than the way gone; negative where one may be, infinite where the map knows of none.

    Raises:
        ValueError: threshold is not between 1 / (1 + e) = 0.27 and 1.
    """
    if not 1 / (1 + math.e) < threshold < 1:
        raise ValueError(f"threshold must be between 0.27 and 1; got {threshold}")
    target = math.log(threshold / (1 - threshold)) + EVIDENCE
    neighbors = getattr(model, "num_neighbors", len(model.weights))
    chosen = (model.weights * neighbors > target).nonzero().squeeze(1)
    flat = points.reshape(-1, model.dim).to(model.centers.device, torch.float64)
    if len(chosen) == 0:
        return torch.full_like(flat[:, 0], torch.inf).reshape(points.shape[:-1])
    extent = (2 * (neighbors * model.weights[chosen].double() / target).log()).sqrt()
    factors = model.scale_tril[chosen].double()
    centers = model.centers[chosen].double() + model.origin
    stds = torch.linalg.svdvals(factors)
    eye = torch.eye(model.dim, dtype=torch.float64, device=flat.device)
    whiten = torch.linalg.solve_triangular(factors, eye.expand_as(factors), upper=False)
    parts = [flat.new_zeros(0)]
    for chunk in flat.split(max(1, CHUNK_PAIRS // len(chosen))):
        offsets = chunk[:, None] - centers
        whitened = torch.einsum("mij,nmj->nmi", whiten, offsets)
        across = (torch.linalg.vector_norm(whitened, dim=2) - extent) * stds[:, -1]
        along = torch.linalg.vector_norm(offsets, dim=2) - extent * stds[:, 0]
        parts.append(torch.maximum(across, along).amin(dim=1))
    return torch.cat(parts).reshape(points.shape[:-1])
