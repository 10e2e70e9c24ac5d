"""A synthetic street of any length, and a laser scanner that drives along it."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import Scans

HEIGHT = 1.7  # [m] of the sensor above the ground
WIDTH = 8.0  # [m] from the middle of the street to the houses
SPACING = 12.0  # [m] between parked cars
CAR = (4.5, 1.8, 1.5)  # [m]
MAX_RANGE = 40.0  # [m]
NOISE = 0.02  # [m] standard deviation of a range


def street_scan(
    place: float, num_rays: int, seed: int, box: tuple[Tensor, Tensor] | None = None
) -> Scans:
    """Scan of a scanner at x = ``place`` in the middle of the street.

    Args:
        place: how far it has driven [m].
        num_rays: evenly random over all directions up to 25 degrees above and below the horizon.
        seed: of directions and noise.
        box: (3,) lower and (3,) upper corner of one more obstacle [m].
    """
    rng = torch.Generator().manual_seed(seed)
    turn = 2 * torch.pi * torch.rand(num_rays, generator=rng, dtype=torch.float64)
    tilt = (torch.rand(num_rays, generator=rng, dtype=torch.float64) - 0.5) * torch.pi * 50 / 180
    flat = tilt.cos()
    directions = torch.stack([flat * turn.cos(), flat * turn.sin(), tilt.sin()], dim=1)
    origin = torch.tensor([place, 0.0, HEIGHT], dtype=torch.float64)
    ground = torch.where(directions[:, 2] < 0, -HEIGHT / directions[:, 2], torch.inf)
    houses = WIDTH / directions[:, 1].abs()
    ranges = torch.minimum(ground, houses)
    corners = [_car_corners(place)] if box is None else [_car_corners(place), box]
    for lower, upper in corners:
        ranges = torch.minimum(ranges, _box_ranges(origin, directions, lower, upper))
    hit = ranges < MAX_RANGE
    ranges = ranges + NOISE * torch.randn(num_rays, generator=rng, dtype=torch.float64)
    ends = origin + ranges.clamp(max=MAX_RANGE)[:, None] * directions
    return Scans(origin[None], ends, is_return=hit)


def _car_corners(place: float) -> tuple[Tensor, Tensor]:
    """(C, 3) lower and upper corners of the cars within sight."""
    first = int((place - MAX_RANGE) // SPACING)
    x = SPACING * torch.arange(first, first + int(2 * MAX_RANGE / SPACING) + 2).double()
    lower = torch.stack([x, torch.full_like(x, 4.0), torch.zeros_like(x)], dim=1)
    return lower, lower + torch.tensor(CAR, dtype=torch.float64)


def _box_ranges(origin: Tensor, directions: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """(R,) distance to the first of some boxes; infinite where a ray meets none."""
    lower, upper = lower.reshape(-1, 3), upper.reshape(-1, 3)
    first = (lower - origin)[None] / directions[:, None]  # (R, C, 3)
    second = (upper - origin)[None] / directions[:, None]
    enter = torch.minimum(first, second).amax(dim=2)
    leave = torch.maximum(first, second).amin(dim=2)
    met = (enter <= leave) & (enter > 0)
    return torch.where(met, enter, torch.inf).amin(dim=1)
