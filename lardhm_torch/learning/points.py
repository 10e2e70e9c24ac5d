"""Preparation of points for a map: validation, conversion to the map frame, Morton order."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.maps import TensorLike, to_tensor
from lardhm_torch.sampling import UNKNOWN, spread_rows

CHECK_CHUNK = 1 << 18  # number of labels checked at a time, to limit memory
OUTLIER_FACTOR = (
    100.0  # outlier threshold, as a multiple of the spread of the middle 98 % of points
)
OUTLIER_SAMPLE = 1 << 12  # number of points used to estimate the spread
FRAME_CHUNK = 1 << 14  # number of points converted at a time; a chunk fits into the CPU cache


class TrainingPoints(NamedTuple):
    """(N, D) points in the map frame [m], (N,) labels, and (D,) float64 origin of that frame [m]."""

    points: Tensor
    labels: Tensor
    origin: Tensor


def training_points(
    points: TensorLike,
    labels: TensorLike,
    like: Tensor,
    origin: Tensor | None = None,
    *,
    keep_unknown: bool = False,
) -> TrainingPoints:
    """Validate samples and convert them to the frame and dtype of a map.

    Args:
        points: (N, D) world positions [m], at least one.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        like: (M, D) tensor of the map that defines dimension, dtype and device.
        origin: (D,) float64, the map's origin [m]. None: use the mean of the points, rounded to
            whole meters, and sort the points in Morton order.
        keep_unknown: keep unknown points if ``origin`` is given; otherwise they are kept anyway.

    Raises:
        ValueError: the samples are invalid, see `check_samples`.
    """
    points, labels = check_samples(
        points, labels, like.shape[1], like.device, keep_unknown=keep_unknown or origin is None
    )
    labels = labels.to(like.dtype)
    if origin is not None:
        return TrainingPoints(to_map_frame(points, origin, like.dtype), labels, origin)
    points, labels = _drop_outliers(points, labels)
    origin = points.mean(dim=0, dtype=torch.float64).round()
    local = to_map_frame(points, origin, like.dtype)
    local, labels = in_morton_order(local, labels)
    return TrainingPoints(local, labels, origin)


def _drop_outliers(points: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Remove outliers. Warn if there are outliers, or if no point is occupied."""
    kept = inliers(points)
    if not bool(kept.all()):
        warnings.warn(
            f"left out {int((~kept).sum())} of {len(points)} points that are far from all others; "
            f"the first is {points[~kept][0].tolist()}",
            stacklevel=4,
        )
        points, labels = points[kept], labels[kept]
    if not bool((labels > UNKNOWN).any()):
        warnings.warn(
            f"none of {len(points)} points is occupied, so the map has free space only. Hits "
            "beyond max_range of SamplingConfig count as no-return",
            stacklevel=4,
        )
    return points, labels


def inliers(points: Tensor, among: Tensor | None = None) -> Tensor:
    """(N,) mask that is False for outliers, which would degrade the Morton order of all other points.

    A point is an outlier if, along any axis, it is farther from the median than `OUTLIER_FACTOR`
    times the spread of the middle 98 % of the points.

    Args:
        points: (N, D) positions [m], finite.
        among: (P, D) all positions, of which the points are some; None: the points.
    """
    among = points if among is None else among
    if len(points) == 0:
        return torch.ones(0, dtype=torch.bool, device=points.device)
    subset = among[:: max(1, len(among) // OUTLIER_SAMPLE)].double()
    low, middle, high = subset.quantile(subset.new_tensor([0.01, 0.5, 0.99]), dim=0)
    limit = OUTLIER_FACTOR * (high - low).max()
    if not bool(limit > 0):
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    low, high = (middle - limit).to(points), (middle + limit).to(points)
    ends = [column.aminmax() for column in points.T]  # twice as fast as all columns at once
    inside = [(end.min >= low[axis]) & (end.max <= high[axis]) for axis, end in enumerate(ends)]
    if bool(torch.stack(inside).all()):  # the common case
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    return ((points >= low) & (points <= high)).all(dim=1)


def check_samples(
    points: TensorLike,
    labels: TensorLike,
    dim: int,
    device: torch.device,
    *,
    keep_unknown: bool = False,
) -> tuple[Tensor, Tensor]:
    """Validate samples and convert them to (N, D) points and (N,) labels on a device.

    Unknown points (label 1/2) are dropped unless ``keep_unknown`` is True.

    Raises:
        ValueError: wrong shapes, no points, NaN or infinite points, labels not 0, 1/2 or 1, or
            all points are unknown.
    """
    points, labels = (
        as_tensor(values, name, device).detach()
        for name, values in (("points", points), ("labels", labels))
    )
    if points.ndim != 2 or points.shape[1] != dim:
        raise ValueError(f"points must be (N, {dim}); got {tuple(points.shape)}")
    if labels.shape != points.shape[:1]:
        raise ValueError(
            f"labels must be ({len(points)},), one per point; got {tuple(labels.shape)}"
        )
    if len(points) == 0:
        raise ValueError("points must hold at least one point; got 0")
    # The sum needs no extra memory, and is non-finite if any coordinate is non-finite.
    bad = points.new_zeros(0) if bool(points.sum().isfinite()) else ~points.isfinite().all(dim=1)
    if bool(bad.any()):
        raise ValueError(
            f"points must be finite; got {int(bad.sum())} rows with NaN or infinity, "
            f"the first at row {int(bad.nonzero()[0])}. Drop them: points[points.isfinite().all(1)]"
        )
    invalid = next((c for c in labels.split(CHECK_CHUNK) if not _are_labels(c)), None)
    if invalid is not None:
        wrong = (invalid != 0) & (invalid != 1) & (invalid != UNKNOWN)
        value = invalid[wrong][0].item()
        cure = " From {-1, +1}: labels = (labels + 1) / 2." if value == -1 else ""
        raise ValueError(f"labels must be 0 or 1; got {value}. 1/2 means unknown.{cure}")
    known = labels != UNKNOWN
    if keep_unknown or bool(known.all()):
        return points, labels
    if not bool(known.any()):
        raise ValueError("labels must hold 0 or 1; all are 1/2 (unknown)")
    return points[known], labels[known]


def _are_labels(values: Tensor) -> bool:
    """Whether all values are 0, 1/2 or 1: the zeros of y (2 y - 1) (y - 1)."""
    if values.dtype == torch.bool:
        return True
    return bool((values * (2 * values - 1) * (values - 1) == 0).all())


def in_morton_order(points: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
    """Sort (N, D) points and their (N, ...) columns in Morton order.

    Points that are close in space are then close in memory, which speeds up all later steps.
    """
    order = morton_order(points)
    return tuple(column.index_select(0, order) for column in (points, *columns))


def at_most(rows: Tensor, limit: int, rng: torch.Generator) -> Tensor:
    """(N, ...) rows, or a stratified random subset of ``limit`` of them."""
    return rows[spread_rows(len(rows), limit, rng)] if len(rows) > limit else rows


def blurred_hits(points: Tensor, labels: Tensor, noise: float, rng: torch.Generator) -> Tensor:
    """(N, D) positions of which the occupied ones are moved at random, so that surfaces get thicker.

    Weights that are trained there make the map as unsure of a surface as the scans disagree.

    Args:
        points: (N, D) positions [m].
        labels: (N,) 1 occupied, others free or unknown.
        noise: standard deviation along each axis [m]; 0: the points are returned as they are.
        rng: random generator, not used without noise.
    """
    if noise == 0:
        return points
    rows = (labels > UNKNOWN).nonzero().squeeze(1)
    shape = (len(rows), points.shape[1])
    moves = noise * torch.randn(shape, generator=rng, device=rng.device, dtype=torch.float64)
    return points.index_add(0, rows, moves.to(points))


def check_noise(noise: float) -> None:
    """Raise a ValueError if the standard deviation of hits is not a length."""
    if not 0 <= noise < float("inf"):
        raise ValueError(f"hit_noise must be 0 or more, in meters; got {noise}")


def morton_order(points: Tensor) -> Tensor:
    """(N, D) positions -> (N,) int64 indices that sort them by their Morton codes."""
    if native.supports(points):
        return torch.ops.lardhm.z_order(points)
    bits = min(10, 62 // points.shape[1])
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    edge = (upper - lower).max().clamp(min=torch.finfo(points.dtype).tiny)
    cells = ((points - lower) / edge * (2**bits - 1)).long()
    code = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for bit in range(bits):
        for axis in range(points.shape[1]):
            code |= ((cells[:, axis] >> bit) & 1) << (bit * points.shape[1] + axis)
    return code.argsort(stable=True)


def count_cells(points: Tensor, edge: float) -> int:
    """Number of cells of a lattice that hold one or more of (N, D) points.

    Args:
        points: (N, D) positions [m].
        edge: of the cells [m].
    """
    if native.supports(points):
        return torch.ops.lardhm.count_cells(points.detach(), edge)
    cells = (points / edge).floor().long()
    strides = (1 << 21) ** torch.arange(cells.shape[1], device=cells.device)
    # consecutive points mostly lie in one cell: this leaves a fraction of them to sort
    return len((cells * strides).sum(dim=1).unique_consecutive().unique())


def as_tensor(values: TensorLike, name: str, device: torch.device) -> Tensor:
    """Convert to a tensor on a device. Tensors and arrays keep their dtype; lists become float64.

    Raises:
        ValueError: values are not numbers, or nested lists differ in length.
    """
    if isinstance(values, (Tensor, np.ndarray)):
        return torch.as_tensor(values, device=device)
    return to_tensor(values, name, device)


def check_points(points: Tensor, dim: int) -> None:
    """Raise a ValueError if points are not (..., D)."""
    if points.ndim == 0 or points.shape[-1] != dim:
        raise ValueError(
            f"points must be (..., {dim}), one row of coordinates per point; "
            f"got {tuple(points.shape)}"
        )


def check_axes(axes: Sequence[Tensor], dim: int) -> None:
    """Raise a ValueError if axes are not D lists of finite coordinates."""
    if len(axes) != dim:
        raise ValueError(f"axes must be {dim} lists of coordinates; got {len(axes)}")
    if not all(bool(axis.isfinite().all()) for axis in axes):
        raise ValueError("axes must be finite; got NaN or infinity")


def to_map_frame(points: Tensor, origin: Tensor, dtype: torch.dtype) -> Tensor:
    """(..., D) world positions -> (..., D) positions relative to the origin, cast to ``dtype``.

    The origin is in whole meters, which are exact in float32 too, so the subtraction of float32
    points loses no precision.
    """
    working = torch.promote_types(torch.promote_types(points.dtype, dtype), torch.float32)
    shift = origin.to(working)
    plain = working == dtype or points.ndim != 2 or points.requires_grad
    if plain or torch.compiler.is_compiling():
        return (points.to(working) - shift).to(dtype)
    local = points.new_empty(points.shape, dtype=dtype)  # chunks avoid a large temporary
    shift = shift.expand(min(FRAME_CHUNK, len(points)), -1).contiguous()
    for to, part in zip(local.split(FRAME_CHUNK), points.split(FRAME_CHUNK), strict=True):
        to.copy_(part - shift[: len(part)])
    return local
