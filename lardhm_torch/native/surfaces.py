"""Operators of the native library for surfaces: cubes of a lattice, marching, gradients, ridges.

All of them are for maps with `NativeMap` tensors; the definitions are in `lardhm_torch.surfaces`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch.features import Kernel


class NativeMap(NamedTuple):
    """A map that the native library supports: tensors without gradient, index of the centers."""

    centers: Tensor
    raw_scale_tril: Tensor
    weights: Tensor
    kernel: Kernel
    center_index: Tensor
    origin: Tensor

    def to_map_frame(self, points: Tensor) -> Tensor:
        """(..., D) float64 world positions [m] -> map frame, in the dtype of the map."""
        return (points - self.origin).to(self.centers.dtype)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What operators take after their own arguments."""
        return (self.centers, self.raw_scale_tril, self.weights, *self.kernel, self.center_index)


def cube_log_odds(model: NativeMap, axes: list[Tensor], firsts: Tensor, edge: int) -> Tensor:
    """Log-odds at cubes of ``edge``^D points of a lattice.

    Args:
        model: the map.
        axes: D lists of finite world coordinates, float64 [m].
        firsts: (B, D) int64, place on the axes of the first point of each cube.
        edge: points along an edge.

    Returns:
        (B, edge, ..., edge).
    """
    shape = [len(axis) for axis in axes]
    local = [axis - shift for axis, shift in zip(axes, model.origin, strict=True)]
    coordinates = torch.cat(local).to(model.centers.dtype)
    return torch.ops.lardhm.cube_log_odds(coordinates, shape, firsts, edge, *model.arguments)


def point_gradients(model: NativeMap, points: Tensor) -> Tensor:
    """Gradients of the log-odds by (N, D) float64 world positions, float64 [1/m]."""
    local = model.to_map_frame(points)
    given = (torch.ones_like(local[:, 0]), local, *model.arguments)
    return torch.ops.lardhm.occupancy_backward(*given, False, 1)[0].double()


def ridge_positions(
    model: NativeMap, points: Tensor, strides: Tensor, steps: int, fall: float
) -> Tensor:
    """As `ridge.ridge_positions`.

    Args:
        model: the map.
        points: (V, D) world positions, float64 [m].
        strides: (V, D) float64 [m], against which the lines run.
        steps: along each line.
        fall: of the log-odds, after which a peak counts.
    """
    local = points - model.origin
    return torch.ops.lardhm.ridge_positions(local, strides, steps, fall, *model.arguments)


def mean_with_neighbors(values: Tensor, faces: Tensor) -> Tensor:
    """As `ridge.plain_mean_with_neighbors`, for (V, C) float64 and (F, 3) int64."""
    return torch.ops.lardhm.mean_with_neighbors(values, faces)


def march_blocks(
    values: Tensor, level: float, cells: Tensor, table: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """As `marching.plain_march`."""
    return torch.ops.lardhm.march_blocks(values, level, cells, table)


def register() -> None:
    """Shapes for `torch.compile` and `torch.export`."""
    library = torch.library

    @library.register_fake("lardhm::cube_log_odds")
    def _(axes: Tensor, shape: list[int], firsts: Tensor, edge: int, *_: Any) -> Tensor:
        return axes.new_empty(firsts.shape[0], *[edge] * len(shape))

    @library.register_fake("lardhm::ridge_positions")
    def _(points: Tensor, *_: Any) -> Tensor:
        return points.new_empty(points.shape[0])

    @library.register_fake("lardhm::mean_with_neighbors")
    def _(values: Tensor, faces: Tensor) -> Tensor:
        return torch.empty_like(values)

    @library.register_fake("lardhm::march_blocks")
    def _(values: Tensor, *_: Any) -> tuple[Tensor, ...]:
        vertices, faces = (library.get_ctx().new_dynamic_size() for _ in range(2))
        edges = values.new_empty(vertices, dtype=torch.long)
        return edges, values.new_empty(vertices), values.new_empty(faces, 3, dtype=torch.int32)
