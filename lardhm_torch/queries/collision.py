"""Collision probability along straight segments, and expected range of rays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, local_parts, reads_map, to_tensor
from lardhm_torch.queries.hazard import HAZARD_LENGTH, sphere_points, swept_integral
from lardhm_torch.queries.marching import Rays, expected_lengths
from lardhm_torch.queries.raycasting import surface_step, unit_rays


@dataclass(frozen=True, kw_only=True)
class Mover:
    """Robot shape and hazard scale.

    Attributes:
        radius: radius of a sphere [m]; 0 for a point.
        length: length of a path with log-odds of 1 on which one obstacle is expected [m]. Smaller
            values are more conservative.
        step: longest interval of a path that is tested only at its ends [m]; thinner obstacles can
            be missed. None: a quarter of `surface_step` for segments, all of it for rays.
    """

    radius: float = 0.0
    length: float = HAZARD_LENGTH
    step: float | None = None

    def __post_init__(self) -> None:
        if not (self.radius >= 0 and math.isfinite(self.radius)):
            raise ValueError(f"radius must be 0 m or more and finite; got {self.radius}")
        if not self.length > 0:
            raise ValueError(f"length must be > 0 m; got {self.length}")
        if self.step is not None and not self.step > 0:
            raise ValueError(f"step must be > 0 m; got {self.step}")


@reads_map
def segment_hazard(
    model: OccupancyMap, starts: TensorLike, ends: TensorLike, mover: Mover | None = None
) -> Tensor:
    """Expected number of obstacles that a mover meets along straight segments; differentiable.

    This is the integral of the `hazard` along each segment, computed numerically between sign changes
    of the log-odds (see the module `hazard`). Obstacles thinner than a step can be missed. For a
    sphere, the largest integral among the paths of its center and of 3^D - 1 surface points counts,
    which is a lower bound. `clearance` is conservative instead: if it is nowhere below the radius, the
    sphere meets no obstacle. Gradients treat the nearest clusters as fixed, as those of the map do.

    Args:
        model: the map.
        starts: (S, D) world positions [m].
        ends: (S, D) world positions [m].
        mover: what moves; None: a point.

    Returns:
        (S,) float64, 0 or more.

    Raises:
        ValueError: starts and ends are not both (S, D).
    """
    mover = mover or Mover()
    device = model.origin.device
    starts, ends = to_tensor(starts, "starts", device), to_tensor(ends, "ends", device)
    if starts.ndim != 2 or starts.shape != ends.shape or starts.shape[1] != model.dim:
        raise ValueError(
            f"starts and ends must be (S, {model.dim}) both; "
            f"got {tuple(starts.shape)} and {tuple(ends.shape)}"
        )
    result = starts.new_zeros(len(starts))
    boxes = starts.minimum(ends) - mover.radius, starts.maximum(ends) + mover.radius
    step = surface_step(model) / 4 if mover.step is None else mover.step
    for rows, part in local_parts(model, *boxes):
        integral = swept_integral(part, starts[rows], ends[rows], mover.radius, step)
        result = result.index_copy(0, rows, integral / mover.length)
    return result


@reads_map
def free_probability(
    model: OccupancyMap, starts: TensorLike, ends: TensorLike, mover: Mover | None = None
) -> Tensor:
    """Probability that a mover meets no obstacle along straight segments; differentiable.

    exp(-`segment_hazard`). Unknown space counts as free; query the probability if that matters.

    Args:
        model: the map.
        starts: (S, D) world positions [m].
        ends: (S, D) world positions [m].
        mover: what moves; None: a point.

    Returns:
        (S,) float64 in [0, 1].

    Raises:
        ValueError: starts and ends are not both (S, D).
    """
    return torch.exp(-segment_hazard(model, starts, ends, mover))


@reads_map
def expected_range(
    model: OccupancyMap,
    origins: TensorLike,
    directions: TensorLike,
    max_range: float,
    mover: Mover | None = None,
) -> Tensor:
    """Expected range of each ray; differentiable.

    E[min(range, max_range)] = integral of exp(-Lambda(t)) from 0 to max_range. Lambda(t) is the
    expected number of obstacles up to t (see `segment_hazard`), computed by the trapezoidal rule.
    Probabilities below 0.0001 count as 0.

    Args:
        model: the map.
        origins: (R, D), or (D,) for all rays, world frame [m].
        directions: (R, D) of any length but 0.
        max_range: length of the rays [m].
        mover: what moves; None: a point, in steps of `surface_step`.

    Returns:
        (R,) float64 [m].

    Raises:
        ValueError: as for `raycast`.
    """
    mover = mover or Mover()
    starts, headings = unit_rays(model, origins, directions, max_range, mover.step)
    ends = starts + max_range * headings
    ranges = starts.new_zeros(len(starts))
    step = min(surface_step(model) if mover.step is None else mover.step, max_range)
    body = sphere_points(model.dim, mover.radius).to(starts.device)
    lower, upper = starts.minimum(ends) - mover.radius, starts.maximum(ends) + mover.radius
    for rows, part in local_parts(model, lower.detach(), upper.detach()):
        rays = Rays(starts[rows], headings[rows], max_range, step, mover.length, body)
        ranges = ranges.index_copy(0, rows, expected_lengths(part, rays))
    return ranges.clamp(max=max_range)
