"""Signed distance to the nearest surface of a map, with gradient."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, local_parts, reads_map, to_tensor
from lardhm_torch.queries.faces import surface_faces
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN, cluster_boxes
from lardhm_torch.queries.nearest_face import to_nearest

MARGIN = 1.0  # [m] around a box: clusters of the faces in it
FIRST_REACH = 4.0  # [m] how far a tiled map looks first


@reads_map
def signed_distance(
    model: OccupancyMap,
    points: TensorLike,
    max_distance: float = math.inf,
    *,
    to_mean: bool = False,
) -> Tensor:
    """Distance to the nearest surface, negative behind it; differentiable with respect to the points.

    The surface consists of flat `faces` where the hits lie, and of kept hits far from all faces. The
    distance is negative for points behind the nearest face that the map does not predict as free
    (log-odds below -1): inside obstacles, and in the unknown space behind a wall that was observed
    from one side only. A point that is farther to the side of a face than behind it counts as in
    front of it.

    Faces lie one standard deviation of the hits in front of their mean, because the nearest of the
    noisy hits is in front of the surface. With ``to_mean`` this standard deviation is added, which
    makes the distance unbiased if the spread of the hits is due to the noise of the sensor.

    Unlike `clearance`, this is an estimate, not a bound. The gradient has length 1, and is 0 where
    nothing is nearer than ``max_distance``.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        max_distance: result where no surface is nearer [m]; a finite value saves time.
        to_mean: return the distance to the mean of the hits instead of that to the nearest of them.

    Returns:
        (...) distances in the dtype of the points, float64 for arrays and lists [m]; NaN for a
        point that is not finite.

    Raises:
        ValueError: points are not (..., D), or max_distance is not > 0.
    """
    if not max_distance > 0:
        raise ValueError(f"max_distance must be > 0 m; got {max_distance}")
    dtype = torch.float64
    if isinstance(points, Tensor) and points.is_floating_point():
        dtype = points.dtype
    points = to_tensor(points, "points", model.origin.device)
    if points.ndim == 0 or points.shape[-1] != model.dim:
        raise ValueError(f"points must be (..., {model.dim}); got {tuple(points.shape)}")
    flat = points.reshape(-1, model.dim)
    ask = _in_parts if hasattr(model, "local_parts") else _distances
    return ask(model, flat, max_distance, to_mean).reshape(points.shape[:-1]).to(dtype)


@reads_map
def surface_distance(
    model: OccupancyMap, points: TensorLike, max_distance: float = math.inf
) -> Tensor:
    """Unsigned distance to the nearest surface: the absolute value of `signed_distance`.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        max_distance: result where no surface is nearer [m].

    Returns:
        (...) distances, 0 or more [m].
    """
    return signed_distance(model, points, max_distance).abs()


def _distances(model: OccupancyMap, points: Tensor, max_distance: float, to_mean: bool) -> Tensor:
    """(N,) signed distances of (N, D) float64 world positions."""
    faces = surface_faces(model)
    result, nearest = to_nearest(points - model.origin, faces, max_distance)
    behind = (result.detach() < 0).nonzero().squeeze(1)
    if len(behind):
        with torch.no_grad():
            is_free = model.log_odds(points.detach()[behind]) < -LOG_ODDS_MARGIN
        result = result * torch.ones_like(result).index_fill_(0, behind[is_free], -1.0)
    if to_mean and len(faces.noise):
        result = result + torch.where(nearest >= 0, faces.noise[nearest.clamp(min=0)], 0.0)
    return result


def _in_parts(model: OccupancyMap, points: Tensor, max_distance: float, to_mean: bool) -> Tensor:
    """The same for a tiled map, which looks farther and farther for what is not near."""
    result = points.new_full((len(points),), max_distance)
    result = result + 0 * points.detach().sum(dim=1)  # NaN where a point is not finite
    left = points.detach().isfinite().all(dim=1).nonzero().squeeze(1)
    ends = _far_ends(model)
    if ends is None:
        return result
    reach = FIRST_REACH
    while len(left):
        most = min(reach, max_distance)
        some = points[left]
        lower, upper = (some.detach() + side * (most + MARGIN) for side in (-1, 1))
        lower, upper = (
            lower.maximum(ends[0]).minimum(ends[1]),
            upper.minimum(ends[1]).maximum(ends[0]),
        )
        found = some.new_full((len(left),), torch.inf)
        for rows, part in local_parts(model, lower, upper):
            found = found.index_copy(0, rows, _distances(part, some[rows], most, to_mean))
        near = found.detach().abs() < most
        result = result.index_copy(0, left[near], found[near])
        covered = ((lower <= ends[0]) & (upper >= ends[1])).all(dim=1)
        left = left[~near & ~covered & (most < max_distance)]
        reach *= 2
    return result


def _far_ends(model: OccupancyMap) -> tuple[Tensor, Tensor] | None:
    """Corners of a box around all surfaces of a map; None if it has none."""
    lower, upper = cluster_boxes(model, sign=1)
    return (lower.amin(dim=0), upper.amax(dim=0)) if len(lower) else None
