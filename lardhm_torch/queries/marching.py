"""Ray marching of many rays together, some steps at a time, until almost no ray gets farther."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.maps import OccupancyMap, native_map, native_ranges
from lardhm_torch.queries.hazard import NEGLIGIBLE, reached
from lardhm_torch.queries.raycasting import March

NO_HAZARD = 1e-3  # log-odds that are passed over on the way to an obstacle
STEPS_AT_ONCE = 8
RAYS_AT_ONCE = 1 << 15


class Rays(NamedTuple):
    """R rays: (R, D) float64 origins and unit directions, how they are followed [m], the length of the
    hazard [m], and (J, D) points of what moves along them [m], the worst of which counts."""

    origins: Tensor
    directions: Tensor
    max_range: float
    step: float
    length: float
    body: Tensor


class Steps(NamedTuple):
    """S steps of some rays.

    (A,) rows of the rays; (A,) expected length [m] of what was passed over before these steps; and
    of the steps (A, S) widths [m] (0 beyond the largest range) and (A, S) probabilities to get
    through.
    """

    rows: Tensor
    skipped: Tensor
    widths: Tensor
    reached: Tensor


def expected_lengths(model: OccupancyMap, rays: Rays) -> Tensor:
    """(R,) expected lengths of rays that end with the hazard of the next step [m]; differentiable.

    Without gradients, and for a point, the native library computes the same from one pass.

    Args:
        model: a map held in memory.
        rays: the rays.
    """
    asked = (rays.origins, rays.directions, model.weights, model.centers, model.scale_tril)
    follows = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in asked)
    found = None if follows or len(rays.body) > 1 else native_map(model)
    if found is not None:
        count = math.ceil(rays.max_range / rays.step - 1e-9)
        rule = (rays.max_range / count, rays.max_range, rays.length, NO_HAZARD, NEGLIGIBLE)
        local = (rays.origins - found.origin, rays.directions)
        return native.expected_ranges(local, rule, found[:3], found.kernel, found.center_index)
    lengths = rays.origins.new_zeros(len(rays.origins))
    for steps in march(model, rays):
        gone = steps.skipped + (steps.reached * steps.widths).sum(dim=1)
        lengths = lengths.index_add(0, steps.rows, gone)
    return lengths


def march(model: OccupancyMap, rays: Rays) -> Iterator[Steps]:
    """All steps of all rays that are reached with a probability above `NEGLIGIBLE`.

    Steps without a hazard are passed over if the native library can tell where the next one is.

    Args:
        model: a map held in memory.
        rays: the rays.
    """
    for rows in torch.arange(len(rays.origins), device=rays.origins.device).split(RAYS_AT_ONCE):
        yield from _march_together(model, rays, rows)


def _march_together(model: OccupancyMap, rays: Rays, rows: Tensor) -> Iterator[Steps]:
    count = math.ceil(rays.max_range / rays.step - 1e-9)
    width = rays.max_range / count
    number = torch.zeros_like(rows)  # of the next step of each ray
    met = rays.origins.new_zeros(len(rows), len(rays.body))  # expected obstacles so far
    edges = torch.arange(STEPS_AT_ONCE + 1, device=rows.device)
    while len(rows):
        before = met.amax(dim=1)
        there = _next_hazard(model, rays, rows, number, width).clamp(max=count)
        still = reached(torch.zeros_like(before)[:, None], before).squeeze(1)
        skipped = still * (there - number) * width
        number = there
        steps = number[:, None] + edges[:-1]
        widths = torch.where(steps < count, width, 0.0).to(met)
        origins, directions = (part[rows][:, None, None] for part in rays[:2])
        places = (number[:, None] + edges)[..., None, None] * width  # (A, S + 1, 1, 1)
        points = (origins + rays.body) + places * directions  # (A, S + 1, J, D)
        rate = model.log_odds(points).double().clamp(min=0) / rays.length
        hazard = (rate[:, :-1] + rate[:, 1:]) / 2 * widths[..., None]
        total = (met[:, None] + hazard.cumsum(dim=1)).amax(dim=2)  # of the worst path, (A, S)
        expected = total.diff(dim=1, prepend=before[:, None])
        yield Steps(rows, skipped, widths, reached(expected, before))
        met = met + hazard.sum(dim=1)
        number = number + STEPS_AT_ONCE
        goes_on = met.detach().amax(dim=1) < -math.log(NEGLIGIBLE)
        left = (goes_on & (number < count)).nonzero().squeeze(1)
        rows, number, met = rows[left], number[left], met[left]


@torch.no_grad()
def _next_hazard(
    model: OccupancyMap, rays: Rays, rows: Tensor, number: Tensor, width: float
) -> Tensor:
    """(A,) first step of each ray, from a given one on, that may hold a hazard."""
    directions = rays.directions[rows].detach()
    starts = rays.origins[rows].detach() + (number * width)[:, None] * directions
    if len(rays.body) > 1:
        return number
    left = rays.max_range - int(number.min()) * width
    rule = March(width, max(left, width), NO_HAZARD, NO_HAZARD, False)
    ranges = native_ranges(model, starts, directions, rule)
    if ranges is None:
        return number
    last = math.ceil(rays.max_range / width)
    return number + (ranges / width).clamp(max=last).floor().long().sub(1).clamp(min=0)
