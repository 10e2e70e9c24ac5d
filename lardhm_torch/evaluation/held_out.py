"""Evaluate a map on held-out rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.evaluation.calibration import reliability
from lardhm_torch.evaluation.scores import both_classes, occupancy_metrics
from lardhm_torch.scans import Scans

MIN_RANGE, MAX_RANGE = 0.3, 60.0  # [m] other rays are neither training nor test rays
NEAR_START, NEAR_END = 0.6, 0.2  # [m] before the hit, between which near points lie
FREE_KINDS = ("unif", "near", "paper")
PAPER_FRACTION = 0.95  # of a ray, on which the free test points of the paper lie
QUERY_POINTS = 1 << 20  # points queried at a time


class HeldOut(NamedTuple):
    """Test points of R rays, each (R, D) float64 in the world frame [m]; or values at these points.

    ``hits`` are occupied. The others are free: ``unif`` uniform from the sensor to 0.2 m before the
    hit, ``near`` between 0.6 m and 0.2 m before it, ``paper`` uniform over the first 95 % of the
    ray, as in the paper.
    """

    hits: Tensor
    unif: Tensor
    near: Tensor
    paper: Tensor


def protocol_rays(scans: Scans, max_rays: int | None = None, seed: int = 0) -> Scans:
    """The rays used for training and testing: first returns with 0.3 m < range < 60 m.

    Args:
        scans: range scans.
        max_rays: draw a random subset of this size if there are more; None: keep all.
        seed: random seed of the subset.

    Returns:
        the selected rays, in their order.
    """
    ranges = scans.ranges
    usable = (ranges > MIN_RANGE) & (ranges < MAX_RANGE) & scans.is_return
    scans = scans.select(usable & (scans.target_index == 1))
    if max_rays is None or len(scans) <= max_rays:
        return scans
    rng = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(scans), generator=rng)[:max_rays].sort().values
    return scans.select(chosen.to(scans.ends.device))


def held_out_points(scans: Scans, seed: int = 0) -> HeldOut:
    """Test points of every usable ray: its hit and three free points before it.

    Args:
        scans: range scans.
        seed: random seed of the free points.

    Raises:
        ValueError: no ray is usable (see `protocol_rays`).
    """
    rays = protocol_rays(scans)
    if len(rays) == 0:
        raise ValueError(
            f"scans must hold at least one ray that hit, with {MIN_RANGE} m < range < "
            f"{MAX_RANGE:g} m; got none of {len(scans)}"
        )
    ranges, origins = rays.ranges[:, None], rays.ray_origins
    directions = (rays.ends - origins) / ranges
    rng = torch.Generator(device=ranges.device).manual_seed(seed)

    def uniform(start: Tensor, end: Tensor) -> Tensor:
        fraction = torch.rand(ranges.shape, generator=rng, device=ranges.device, dtype=ranges.dtype)
        return origins + (start + fraction * (end - start)) * directions

    zero, margin = torch.zeros_like(ranges), ranges - NEAR_END
    return HeldOut(
        hits=rays.ends,
        unif=uniform(zero, margin),
        near=uniform((ranges - NEAR_START).clamp(min=0), margin),
        paper=uniform(zero, PAPER_FRACTION * ranges),
    )


@torch.no_grad()
def answer_held_out(
    model: Callable[[Tensor], Tensor | np.ndarray], scans: Scans, seed: int = 0
) -> HeldOut:
    """Probabilities of a map at the test points of held-out rays.

    Args:
        model: a map, a baseline, or any function (N, D) world positions -> (N,) probability of
            occupancy, as a tensor or an array.
        scans: rays that were not used for training.
        seed: random seed of the test points.

    Returns:
        (R,) probabilities for each kind of test point.

    Raises:
        ValueError: no ray is usable, or the model does not return one probability per point.
    """

    def query(positions: Tensor) -> Tensor:
        chunks = [torch.as_tensor(model(chunk)) for chunk in positions.split(QUERY_POINTS)]
        if sum(len(chunk) for chunk in chunks) != len(positions):
            raise ValueError(
                f"model must return ({len(positions)},), one probability per point; "
                f"got {[tuple(chunk.shape) for chunk in chunks]}"
            )
        return torch.cat(chunks)

    return HeldOut(*map(query, held_out_points(scans, seed)))


def score_held_out(probabilities: HeldOut) -> dict[str, dict[str, float]]:
    """Scores for each kind of free point: unif, near, paper."""
    return {
        kind: occupancy_metrics(probabilities.hits, getattr(probabilities, kind))
        for kind in FREE_KINDS
    }


def reliability_held_out(probabilities: HeldOut) -> dict[str, Tensor]:
    """Reliability diagram for each kind of free point; both classes have the same mass."""
    return {
        kind: reliability(*both_classes(probabilities.hits, getattr(probabilities, kind)))
        for kind in FREE_KINDS
    }


def evaluate(
    model: Callable[[Tensor], Tensor | np.ndarray], scans: Scans, seed: int = 0
) -> dict[str, dict[str, float]]:
    """Evaluate a map on held-out rays.

    Args:
        model: a map, a baseline, or any function (N, D) world positions [m] -> (N,) probability of
            occupancy, as a tensor or an array.
        scans: rays that were not used for training. Rays shorter than 0.3 m or longer than 60 m,
            later returns and no-returns are ignored.
        seed: random seed of the test points.

    Returns:
        a dictionary of scores (see `occupancy_metrics`) for each kind of free point: "unif", "near"
        and "paper" (see `HeldOut`).

    Raises:
        ValueError: no ray is usable, or the model does not return one probability per point.
    """
    return score_held_out(answer_held_out(model, scans, seed))
