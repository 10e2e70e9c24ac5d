"""Distances and collision probabilities of spheres, capsules, and robots made of spheres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, reads_map, to_tensor
from lardhm_torch.queries.distance import signed_distance

# Standard deviation of the distance, beside or as a part of the noise of the hits. Chosen on the
# simulated room with seeds 1 to 3 (log-loss and calibration); reports use other seeds.
ERROR, NOISE_FACTOR = 0.01, 0.75  # [m], 1
CAPSULE_STEP = 0.02  # [m] longest distance between places on a capsule's axis that are compared
REFINEMENTS = 2  # of the nearest of them, each to an eighth of the distance
CHUNK_POINTS = 1 << 20


@dataclass(frozen=True, eq=False)
class Body:
    """A robot modeled as S spheres in its own frame.

    Attributes:
        centers: (S, D) centers of the spheres [m].
        radii: (S,) radii of the spheres [m].
    """

    centers: Tensor
    radii: Tensor

    def __post_init__(self) -> None:
        centers, radii = to_tensor(self.centers, "centers"), to_tensor(self.radii, "radii")
        if centers.ndim != 2 or radii.shape != centers.shape[:1] or len(radii) == 0:
            raise ValueError(
                "centers and radii must be (S, D) and (S,), at least one sphere; "
                f"got {tuple(centers.shape)} and {tuple(radii.shape)}"
            )
        if not bool(((radii >= 0) & radii.isfinite()).all()):
            raise ValueError(f"radii must be 0 m or more and finite; got {radii.tolist()}")
        object.__setattr__(self, "centers", centers)
        object.__setattr__(self, "radii", radii)

    def placed(self, poses: TensorLike) -> Tensor:
        """(..., D + 1, D + 1) poses ``world_from_body`` -> (..., S, D) centers in the world [m].

        Raises:
            ValueError: poses have another shape, or their last row is not (0, ..., 0, 1).
        """
        poses = to_tensor(poses, "poses", self.centers.device)
        dim = self.centers.shape[1]
        if poses.ndim < 2 or poses.shape[-2:] != (dim + 1, dim + 1):
            raise ValueError(f"poses must be (..., {dim + 1}, {dim + 1}); got {tuple(poses.shape)}")
        last = poses.new_tensor([0.0] * dim + [1.0])
        if not bool((poses[..., dim, :].detach() == last).all()):
            raise ValueError(f"poses must have the last row {last.tolist()}; got others")
        rotations, places = poses[..., :dim, :dim], poses[..., :dim, dim]
        return torch.einsum("...de,se->...sd", rotations, self.centers) + places[..., None, :]


@reads_map
def body_distance(
    model: OccupancyMap, body: Body, poses: TensorLike, max_distance: float = math.inf
) -> Tensor:
    """Distance from a body to the nearest surface; differentiable with respect to poses and body.

    This is the smallest difference between the `signed_distance` of a sphere's center and its radius.

    Args:
        model: the map.
        body: the robot.
        poses: (..., D + 1, D + 1) ``world_from_body``; their rotations are not checked.
        max_distance: upper bound on the distance of a sphere's center [m], see `signed_distance`.

    Returns:
        (...) float64 distances [m], negative in a collision.

    Raises:
        ValueError: poses have another shape, or max_distance is not > 0.
    """
    distance = signed_distance(model, body.placed(poses), max_distance)
    return (distance - body.radii.to(distance.device)).amin(dim=-1)


@reads_map
def capsule_distance(
    model: OccupancyMap, starts: TensorLike, ends: TensorLike, radii: TensorLike | float = 0.0
) -> Tensor:
    """Distance from capsules to the nearest surface; differentiable with respect to their ends.

    A capsule is the volume that a sphere sweeps along a segment. The smallest `signed_distance` along
    the segment is searched at points `CAPSULE_STEP` apart, and then refined near the best point. The
    result is too large by at most half a step.

    Args:
        model: the map.
        starts: (..., D) centers of one end, world frame [m].
        ends: (..., D) centers of the other end [m].
        radii: radii of the capsules [m], a number or (...).

    Returns:
        (...) float64 distances [m], negative in a collision.

    Raises:
        ValueError: starts and ends are not both (..., D).
    """
    device = model.origin.device
    starts, ends = to_tensor(starts, "starts", device), to_tensor(ends, "ends", device)
    if starts.shape != ends.shape or starts.ndim == 0 or starts.shape[-1] != model.dim:
        raise ValueError(
            f"starts and ends must be (..., {model.dim}) both; "
            f"got {tuple(starts.shape)} and {tuple(ends.shape)}"
        )
    radii = torch.as_tensor(radii, dtype=torch.float64, device=device)
    first, last = (end.reshape(-1, model.dim) for end in (starts, ends))
    where = _nearest_fraction(model, first.detach(), last.detach())
    nearest = first + where[:, None] * (last - first)
    return signed_distance(model, nearest).reshape(starts.shape[:-1]) - radii


@torch.no_grad()
def _nearest_fraction(model: OccupancyMap, starts: Tensor, ends: Tensor) -> Tensor:
    """(C,) fraction of each segment at which the signed distance is least."""
    if len(starts) == 0:
        return starts.new_zeros(0)
    longest = float(torch.linalg.vector_norm(ends - starts, dim=1).max())
    count = max(1, math.ceil(longest / CAPSULE_STEP))
    fractions = torch.linspace(0, 1, count + 1, dtype=torch.float64, device=starts.device)
    best = starts.new_zeros(len(starts))
    for rows in torch.arange(len(starts), device=starts.device).split(
        max(1, CHUNK_POINTS // len(fractions))
    ):
        best[rows] = _least_of(model, starts[rows], ends[rows], fractions.expand(len(rows), -1))
    around = torch.linspace(-1, 1, 17, dtype=torch.float64, device=starts.device)
    width = 1 / count
    for _ in range(REFINEMENTS):
        nearby = (best[:, None] + width * around).clamp(0, 1)
        best, width = _least_of(model, starts, ends, nearby), width / 8
    return best


def _least_of(model: OccupancyMap, starts: Tensor, ends: Tensor, fractions: Tensor) -> Tensor:
    """(C,) the one of (C, S) fractions of each segment at which the signed distance is least."""
    points = starts[:, None] + fractions[..., None] * (ends - starts)[:, None]
    least = signed_distance(model, points).argmin(dim=1, keepdim=True)
    return fractions.gather(1, least).squeeze(1)


@reads_map
def collision_probability(
    model: OccupancyMap, points: TensorLike, radii: TensorLike | float
) -> Tensor:
    """Probability that the nearest surface is nearer than a radius; differentiable.

    P(distance < r) = Phi((r - m) / s). Phi is the normal distribution function, m is the
    `signed_distance` to the mean of the hits, and s = sqrt((0.75 noise)^2 + (0.01 m)^2), where noise
    is the standard deviation of the hits of the nearest face. Surfaces that were never observed are
    not accounted for.

    Args:
        model: the map.
        points: (..., D) centers of spheres, world frame [m].
        radii: radii of the spheres [m], a number or (...).

    Returns:
        (...) float64 probabilities; 0 where the map has no surface.

    Raises:
        ValueError: points are not (..., D).
    """
    points = to_tensor(points, "points", model.origin.device)
    radii = torch.as_tensor(radii, dtype=torch.float64, device=points.device)
    mean = signed_distance(model, points, to_mean=True)
    nearest = signed_distance(model, points.detach())
    noise = torch.where(nearest.isfinite(), mean.detach() - nearest, 0.0)
    return torch.special.ndtr((radii - mean) / ((NOISE_FACTOR * noise).square() + ERROR**2).sqrt())


@reads_map
def body_collision_probability(model: OccupancyMap, body: Body, poses: TensorLike) -> Tensor:
    """Probability that a body touches a surface: the largest probability of its spheres.

    Args:
        model: the map.
        body: the robot.
        poses: (..., D + 1, D + 1) ``world_from_body``.

    Returns:
        (...) float64 probabilities. This is a lower bound, because any of the spheres may collide.

    Raises:
        ValueError: poses have another shape.
    """
    return collision_probability(model, body.placed(poses), body.radii).amax(dim=-1)
