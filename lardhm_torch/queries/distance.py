"""Signed distance to the nearest surface of a map, with gradient."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.maps import OccupancyMap, TensorLike, local_parts, reads_map, to_tensor
from lardhm_torch.queries.faces import Faces, surface_faces
from lardhm_torch.queries.grids import EVIDENCE, cluster_boxes

CHUNK_PAIRS = 1 << 20  # pairs of a point and a face at a time
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
    """Distance to the nearest surface, negative behind it; differentiable in the points.

    The surface consists of flat `faces` where the hits lie. The distance is negative where the
    nearest face is seen from behind and the map does not hold the point to be free (log-odds below
    -1): inside of obstacles, and in the unknown space behind a wall that was seen from one side
    only. A face seen obliquely from behind, from farther beside than below it, counts as seen from
    its front.

    Faces lie one standard deviation of the hits in front of their mean, because the nearest of noisy
    hits is in front of the surface. With ``to_mean`` the distance is greater by that: without bias
    where the noise is that of the sensor.

    Unlike `clearance`, this is an estimate, not a bound. The gradient has length 1, and is 0 where
    nothing is nearer than ``max_distance``.

    Args:
        model: the map.
        points: (..., D) world positions [m].
        max_distance: result where no surface is nearer [m]; a finite one saves time.
        to_mean: to the mean of the hits instead of to the nearest of them.

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
    """Distance to the nearest surface, on either side of it: the size of `signed_distance`.

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
    result, nearest = _Distance.apply(points - model.origin, faces, max_distance)
    behind = (result.detach() < 0).nonzero().squeeze(1)
    if len(behind):
        with torch.no_grad():
            is_free = model.log_odds(points.detach()[behind]) < -EVIDENCE
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


def to_nearest(points: Tensor, faces: Faces, max_distance: float) -> Tensor:
    """(N,) signed distances of (N, D) points in the map's frame to the nearest face or plate.

    Args:
        points: (N, D) float64 positions [m].
        faces: all in one frame.
        max_distance: result where none is nearer [m].
    """
    return _Distance.apply(points, faces, max_distance)[0]


class _Distance(torch.autograd.Function):
    """Signed distances of (N, D) float64 points in the map's frame, and their nearest faces."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, faces: Faces, max_distance: float
    ) -> tuple[Tensor, Tensor]:
        wanted = ctx.needs_input_grad[0]
        if native.has_tree(faces.tree):
            values, gradients, nearest = native.nearest_face(points, faces, max_distance, wanted)
            ctx.save_for_backward(points, gradients, nearest)
        else:
            nearest = nearest_faces(points, faces, max_distance)
            values = face_distances(points, faces, nearest, max_distance)
            ctx.save_for_backward(points, None, nearest)
        ctx.faces, ctx.max_distance = faces, max_distance
        ctx.mark_non_differentiable(nearest)
        return values, nearest

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Any) -> Any:
        points, gradients, nearest = ctx.saved_tensors
        if gradients is not None and not torch.is_grad_enabled():
            return grad[:, None] * gradients, None, None
        with torch.enable_grad():
            inputs = points if points.requires_grad else points.detach().requires_grad_()
            values = face_distances(inputs, ctx.faces, nearest, ctx.max_distance)
            (slope,) = torch.autograd.grad(values, inputs, grad, create_graph=grad.requires_grad)
        return slope, None, None


def nearest_faces(points: Tensor, faces: Faces, max_distance: float) -> Tensor:
    """(N,) nearest face of each (N, D) point, -1 where none is nearer than ``max_distance``."""
    if native.has_tree(faces.tree):
        return native.nearest_face(points, faces, max_distance, False)[2]
    return plain_nearest(points, faces, max_distance)


@torch.no_grad()
def plain_nearest(points: Tensor, faces: Faces, max_distance: float) -> Tensor:
    """The definition of `nearest_faces`: the first of the smallest distances to all faces."""
    count = len(faces.centers)
    result = torch.full((len(points),), -1, dtype=torch.long, device=points.device)
    for rows in _chunks(points, count):
        some = points[rows]
        every = torch.arange(count, device=points.device).expand(len(some), -1)
        values = _to_faces(some[:, None], faces, every)
        values = values if len(faces.thickness) else values.abs()
        least = values.nan_to_num(torch.inf).min(dim=1)
        result[rows] = torch.where(least.values < max_distance, least.indices, -1)
    return result


def _chunks(points: Tensor, count: int) -> Iterator[Tensor]:
    if count:
        yield from torch.arange(len(points), device=points.device).split(
            max(1, CHUNK_PAIRS // count)
        )


def face_distances(points: Tensor, faces: Faces, nearest: Tensor, max_distance: float) -> Tensor:
    """(N,) signed distances of (N, D) points to one face each; ``max_distance`` for face -1."""
    nothing = (points * 0).sum(dim=1)  # NaN where a point is not finite
    found = (nearest >= 0).nonzero().squeeze(1)
    result = nothing + max_distance if math.isfinite(max_distance) else nothing + torch.inf
    if len(found) == 0:
        return result
    return result.index_copy(0, found, _to_faces(points[found], faces, nearest[found]))


def _to_faces(points: Tensor, faces: Faces, which: Tensor) -> Tensor:
    """(...) signed distances of (..., D) points, broadcast, to (...) faces or plates [m].

    With the height z over a face and the distance rho beside its rounded rectangle, the distance is
    sqrt(z^2 + rho^2). It is negative where the point lies below the face by more than rho. For a
    plate, z is the height over either side; inside, the distance is max(z, rho), both negative.
    """
    height, side = height_and_side(points, faces, which)
    is_plate = len(faces.thickness) > 0
    if is_plate:
        height = height.abs() - faces.thickness[which]
    is_off = (side > 0) & (height > 0) if is_plate else side > 0
    away = torch.where(is_off, height.square() + side.square(), 1.0).sqrt()
    if is_plate:
        return torch.where(is_off, away, torch.maximum(height, side))
    return torch.where(is_off, torch.where(-height > side, -away, away), height)


def height_and_side(points: Tensor, faces: Faces, which: Tensor) -> tuple[Tensor, Tensor]:
    """(...) heights of (..., D) points over (...) faces, and signed distances beside them [m]."""
    u = torch.einsum("...d,...de->...e", points - faces.centers[which], faces.axes[which])
    if u.shape[-1] == 1:
        return u[..., 0], torch.full_like(u[..., 0], -torch.inf)
    half = faces.half[which]
    radius = half.amin(dim=-1)
    beyond = (u[..., 1:].abs() - (half - radius[..., None])).clamp(min=0)
    squares = beyond.square().sum(dim=-1)
    length = torch.where(squares > 0, torch.where(squares > 0, squares, 1.0).sqrt(), 0.0)
    return u[..., 0], length - radius
