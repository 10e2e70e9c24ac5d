"""The nearest of many flat faces or plates, and the distance to it, with gradient."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import native

CHUNK_PAIRS = 1 << 20  # pairs of a point and a face at a time


@dataclass(frozen=True, eq=False)
class Faces:
    """F rectangles with rounded corners; the rounding's radius is the shortest half edge.

    Attributes:
        centers: (F, D) float64, map frame [m].
        axes: (F, D, D) float64 orthonormal columns: the normal, into free space, then the edges.
        half: (F, D - 1) float64 half edges [m].
        thickness: (F,) float64 half thickness of plates [m]; (0,) for faces, which have a front.
        noise: (F,) float64 standard deviation of the hits across a face [m]; (0,) for plates.
        tree: of the native search; empty where it is not available.
    """

    centers: Tensor
    axes: Tensor
    half: Tensor
    thickness: Tensor
    noise: Tensor
    tree: Tensor


def plates_of(centers: Tensor, axes: Tensor, half: Tensor, thickness: Tensor) -> Faces:
    """Plates, which have a thickness, with a tree to search them."""
    given = (centers, axes, half, thickness)
    return Faces(*given, thickness[:0], native.face_tree(*given))


def to_nearest(points: Tensor, faces: Faces, max_distance: float) -> tuple[Tensor, Tensor]:
    """Signed distances of (N, D) points in the map's frame to the nearest face or plate.

    Args:
        points: (N, D) float64 positions [m].
        faces: all in one frame.
        max_distance: result where none is nearer [m].

    Returns:
        (N,) distances, differentiable in the points, and (N,) nearest faces, -1 for none.
    """
    return _FaceDistance.apply(points, faces, max_distance)


class _FaceDistance(torch.autograd.Function):
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
