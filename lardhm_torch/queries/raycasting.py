"""Ray casting: distance to the first obstacle along each ray.

This is the definition, in plain torch: it evaluates every step of every ray. The native library gives
the same ranges, but skips cells of an octree that cannot contain an obstacle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.maps import (
    OccupancyMap,
    TensorLike,
    local_parts,
    native_ranges,
    reads_map,
    stored_thickness_counts,
    to_tensor,
)
from lardhm_torch.queries.grids import BLOCK_POINTS, LOG_ODDS_MARGIN, SURFACES, threshold_log_odds

BINS_PER_OCTAVE = 16  # of the histogram of thicknesses: neighboring bins differ by 4 %
BISECTIONS = 16  # reduce a step of 5 cm to less than 1 µm


class March(NamedTuple):
    """How a ray is followed: step and largest range [m], log-odds of the threshold, log-odds above
    which a step is clearly occupied, and whether to continue to the ridge."""

    step: float
    max_range: float
    level: float
    clear_level: float
    to_ridge: bool


@torch.no_grad()
@reads_map
def raycast(
    model: OccupancyMap,
    origins: TensorLike,
    directions: TensorLike,
    max_range: float,
    threshold: float = 0.5,
    step: float | None = None,
    *,
    surface: str = "peak",
) -> Tensor:
    """Distance along each ray to the first obstacle.

    The ray is sampled every ``step`` until the log-odds are clearly above the threshold, that is by
    1. Without this margin, small positive log-odds in unmeasured space would stop rays. Then

    - ``surface="peak"`` continues to the ridge: the largest log-odds before they fall by 1 again.
      The hits lie there, so this is the range that a sensor would measure.
    - ``surface="crossing"`` goes back to where the log-odds last crossed the threshold, found by
      bisection. Free space is learned only up to some centimeters before the hits, so this lies
      about 10 cm in front of the surface, which is conservative for a robot. A ray that starts
      clearly above the threshold has range 0. A ray that starts less clearly above it, and never
      falls below, ends where the log-odds become clearly occupied.

    Args:
        model: the map.
        origins: (R, D), or (D,) for all rays, world frame [m].
        directions: (R, D) of any length but 0.
        max_range: length of the rays [m].
        threshold: probability of occupancy that counts as an obstacle, between 0 and 1.
        step: distance between samples [m]; thinner obstacles can be missed. None: `surface_step`.
        surface: "peak" or "crossing".

    Returns:
        (R,) float64 distances [m], infinite where no obstacle lies within max_range.

    Raises:
        ValueError: shapes do not match, a direction is zero or not finite, or another argument is
            outside its range.
    """
    if surface not in SURFACES:
        raise ValueError(f"surface must be one of {', '.join(SURFACES)}; got {surface!r}")
    starts, headings = unit_rays(model, origins, directions, max_range, step)
    level = threshold_log_odds(threshold)
    step = min(surface_step(model) if step is None else step, max_range)
    march = March(step, max_range, level, level + LOG_ODDS_MARGIN, surface == "peak")
    ranges = starts.new_full((len(starts),), torch.inf)
    ends = starts + max_range * headings
    for rows, part in local_parts(model, starts.minimum(ends), starts.maximum(ends)):
        native = native_ranges(part, starts[rows], headings[rows], march)
        ranges[rows] = (
            _raycast(part, starts[rows], headings[rows], march) if native is None else native
        )
    return ranges


def unit_rays(
    model: OccupancyMap,
    origins: TensorLike,
    directions: TensorLike,
    max_range: float,
    step: float | None,
) -> tuple[Tensor, Tensor]:
    """Check the arguments of a ray query and normalize the rays.

    Returns:
        (R, D) origins and (R, D) directions of length 1, float64, on the device of the map.

    Raises:
        ValueError: see `raycast`.
    """
    device = model.origin.device
    origins = to_tensor(origins, "origins", device)
    directions = to_tensor(directions, "directions", device)
    if directions.ndim != 2 or directions.shape[1] != model.dim:
        raise ValueError(f"directions must be (R, {model.dim}); got {tuple(directions.shape)}")
    if tuple(origins.shape) not in (tuple(directions.shape), (model.dim,)):
        raise ValueError(
            f"origins must be {tuple(directions.shape)} like the directions, or one ({model.dim},); "
            f"got {tuple(origins.shape)}"
        )
    lengths = torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    if not ((lengths > 0) & lengths.isfinite()).all():
        raise ValueError("directions must be finite and not zero; got one that is not")
    if not (max_range > 0 and math.isfinite(max_range)):
        raise ValueError(f"max_range must be > 0 m and finite; got {max_range}")
    if step is not None and not step > 0:
        raise ValueError(f"step must be > 0 m; got {step}")
    return origins.expand_as(directions), directions / lengths


def _raycast(model: OccupancyMap, origins: Tensor, directions: Tensor, march: March) -> Tensor:
    """(R,) ranges [m]: log-odds on all steps of some rays at a time, then the first obstacle."""
    count = math.ceil(march.max_range / march.step - 1e-9)
    steps = torch.arange(count + 1, dtype=torch.float64, device=origins.device)
    depths = (steps * march.step).clamp(max=march.max_range)  # (S,)
    find = _ridge_depths if march.to_ridge else _crossing_depths
    ranges = [origins.new_zeros(0)]
    size = max(1, BLOCK_POINTS // len(depths))
    for start, heading in zip(origins.split(size), directions.split(size), strict=True):
        log_odds = _log_odds_at(model, start, heading, depths.expand(len(start), -1))  # (R, S)
        clear = log_odds > march.clear_level
        result = start.new_full((len(start),), torch.inf)
        hit = clear.any(dim=1)
        first = clear[hit].to(torch.uint8).argmax(dim=1)  # the first step that is clearly occupied
        result[hit] = find(model, (start[hit], heading[hit]), log_odds[hit], first, march)
        ranges.append(result)
    return torch.cat(ranges)


def _log_odds_at(
    model: OccupancyMap, origins: Tensor, directions: Tensor, depths: Tensor
) -> Tensor:
    """(R, S) float64 log-odds at (R, S) depths of the rays [m]."""
    return model.log_odds(origins[:, None] + depths[..., None] * directions[:, None]).double()


def _crossing_depths(
    model: OccupancyMap,
    rays: tuple[Tensor, Tensor],
    log_odds: Tensor,
    first: Tensor,
    march: March,
) -> Tensor:
    """(R,) depths of the last crossing of the threshold before the (R,) first clear steps [m].

    If the log-odds never were below the threshold, the crossing of the clear level is sought.
    """
    steps = torch.arange(log_odds.shape[1], device=first.device)
    below = (log_odds <= march.level) & (steps < first[:, None])
    last = torch.where(below, steps, -1).amax(dim=1)
    high = (first.double() * march.step).clamp(max=march.max_range)
    low = torch.where(last < 0, (high - march.step).clamp(min=0), last.double() * march.step)
    target = torch.where(last < 0, march.clear_level, march.level)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        above = _log_odds_at(model, *rays, middle[:, None]).squeeze(1) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return high


def _ridge_depths(
    model: OccupancyMap,
    rays: tuple[Tensor, Tensor],
    log_odds: Tensor,
    first: Tensor,
    march: March,
) -> Tensor:
    """(R,) depths of the first peak of the log-odds at or behind the (R,) first clear steps [m].

    The step with the peak is refined twice by a parabola through three points.
    """
    steps = torch.arange(log_odds.shape[1], device=first.device)
    peak = first_peak(log_odds.masked_fill(steps < first[:, None], -torch.inf))
    depths, width = (peak.double() * march.step).clamp(max=march.max_range), march.step
    offsets = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64, device=depths.device)
    for _ in range(2):
        around = (depths[:, None] + width * offsets).clamp(0.0, march.max_range)
        shift = parabola_vertex(_log_odds_at(model, *rays, around))
        depths = (depths + width * shift).clamp(0.0, march.max_range)
        width /= 4
    return depths


def first_peak(log_odds: Tensor) -> Tensor:
    """(N, S) log-odds along N lines -> (N,) index of the largest before a fall of `LOG_ODDS_MARGIN`."""
    highest = log_odds.cummax(dim=1)
    fallen = log_odds < highest.values - LOG_ODDS_MARGIN
    last = torch.full_like(fallen[:, 0], log_odds.shape[1] - 1, dtype=torch.long)
    end = torch.where(fallen.any(dim=1), fallen.to(torch.uint8).argmax(dim=1), last)
    return highest.indices.gather(1, end[:, None]).squeeze(1)


def parabola_vertex(values: Tensor) -> Tensor:
    """(N, 3) values at -1, 0 and 1 -> (N,) position of the maximum of the parabola, in [-1, 1].

    0 where the parabola has no maximum.
    """
    before, here, after = values.unbind(dim=1)
    curvature = before - 2 * here + after
    return torch.where(curvature < 0, 0.5 * (before - after) / curvature, 0.0).clamp(-1.0, 1.0)


def thickness_counts(model: OccupancyMap) -> dict[int, int]:
    """Histogram of the thickness of the occupied clusters.

    The thickness t of a cluster is the smallest standard deviation of its kernel; it is counted in
    bin floor(`BINS_PER_OCTAVE` log2(t / 1 m)). Histograms of parts of a map add up to that of the
    whole.
    """
    factors = model.scale_tril[model.weights > 0].detach().double()
    thickness = torch.linalg.svdvals(factors)[:, -1].clamp(min=1e-30)
    bins, counts = (BINS_PER_OCTAVE * thickness.log2()).floor().long().unique(return_counts=True)
    return dict(zip(bins.tolist(), counts.tolist(), strict=True))


def surface_step(model: OccupancyMap) -> float:
    """Default step of ray casting: median thickness of the occupied clusters [m], within 2 %.

    It is the middle of the median's bin in `thickness_counts`, so that a tiled map has exactly the
    step of the merged map. It is at most about a third of the thickness of a wall. Infinite if the
    map has no cluster of positive weight, and so no surface to miss.
    """
    stored = stored_thickness_counts(model)
    counts = thickness_counts(model) if stored is None else stored
    if not counts:
        return math.inf
    rank = (sum(counts.values()) - 1) // 2
    for number in sorted(counts):
        rank -= counts[number]
        if rank < 0:
            break
    return float(2 ** ((number + 0.5) / BINS_PER_OCTAVE))
