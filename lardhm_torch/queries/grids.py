"""Questions to a map at points: lattices, slices, bounds, gradients.

A map is anything with the members of `LardHilbertMap` that are used here: ``log_odds(points)``,
``centers``, ``scale_tril``, ``weights``, ``origin`` and ``dim``. One that is too large to have these
tensors in one piece, a `tiles.TiledMap`, has ``pieces()`` and ``local_parts(lower, upper)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch.native import nearest_centers

BLOCK_POINTS = 1 << 20  # points evaluated at a time
NUM_STDS = 3.0  # how far a cluster reaches: exp(-3² / 2) = 1 % of its peak
EVIDENCE = 1.0  # log-odds beyond the threshold that something measured reaches; ripple does not
SURFACES = ("peak", "crossing")  # where a surface lies: on the ridge of log-odds, or at a level


class Support(NamedTuple):
    """Of N points: center (N, D) float64 world [m] of the nearest supporting cluster, and its
    smallest standard deviation (N,) float64 [m]; NaN and 0 where nothing supports.
    """

    centers: Tensor
    thickness: Tensor


class Slice(NamedTuple):
    """A horizontal cut through a map.

    ``probability`` is (nx, ny); ``extent`` is (x_first, x_last, y_first, y_last) of its lattice [m].
    """

    probability: Tensor
    extent: tuple[float, float, float, float]


def grid(lower: Any, upper: Any, resolution: float, device: Any = None) -> Tensor:
    """All points of a lattice that starts at ``lower`` and goes up to ``upper`` or just below it.

    Args:
        lower: D coordinates of the first point, world frame [m].
        upper: D coordinates of the far corner [m]; it is a lattice point if the edges are multiples
            of the resolution.
        resolution: distance of neighboring points [m].
        device: of the result; left out: that of ``lower`` if it is a tensor, else the CPU.

    Returns:
        (nx, ny, nz, D) float64 positions [m] (in two dimensions (nx, ny, D), and so on).

    Raises:
        ValueError: the corners are not finite, ordered and of one length, or resolution is not > 0.

    >>> grid([0, 0], [1, 2], 0.5).shape
    torch.Size([3, 5, 2])
    """
    axes = grid_axes(lower, upper, resolution, device)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def grid_axes(lower: Any, upper: Any, resolution: float, device: Any = None) -> list[Tensor]:
    """The D coordinate lists of `grid`, float64 [m]; arguments and errors are the same."""
    lower = torch.as_tensor(lower, dtype=torch.float64, device=device)
    upper = torch.as_tensor(upper, dtype=torch.float64, device=lower.device)
    if not (resolution > 0 and math.isfinite(resolution)):
        raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
    if lower.ndim != 1 or lower.shape != upper.shape or not (lower <= upper).all():
        raise ValueError(
            "lower and upper must be two lists of D coordinates, lower <= upper; "
            f"got {lower.tolist()} and {upper.tolist()}"
        )
    if not (lower.isfinite().all() and upper.isfinite().all()):
        raise ValueError(f"lower and upper must be finite; got {lower} and {upper}")
    counts = ((upper - lower) / resolution + 1e-6).floor().long() + 1  # 1e-6: 0.3 / 0.1 is 2.99...
    return [
        start + resolution * torch.arange(int(count), dtype=torch.float64, device=lower.device)
        for start, count in zip(lower, counts, strict=True)
    ]


def query_grid(model: Any, lower: Any, upper: Any, resolution: float) -> Tensor:
    """Probability at all points of `grid`, without storing the points.

    Args:
        model: a map.
        lower: (D,) lower corner, world frame [m].
        upper: (D,) upper corner, world frame [m].
        resolution: distance of neighboring points [m].

    Returns:
        (nx, ny, nz) probabilities with the dtype and the device of the map.

    Raises:
        ValueError: see `grid`.
    """
    axes = grid_axes(lower, upper, resolution, model.origin.device)
    if len(axes) != model.dim:
        raise ValueError(f"lower and upper must have {model.dim} coordinates; got {len(axes)}")
    return lattice_values(model, axes, probability=True)


@torch.no_grad()
def lattice_values(model: Any, axes: list[Tensor], *, probability: bool) -> Tensor:
    """Probability, or log-odds, at all combinations of D lists of world coordinates [m].

    By the map's own ``query_lattice``, where it has one; else a million points at a time.
    """
    if hasattr(model, "query_lattice"):
        return model.query_lattice(axes, probability=probability)
    answer = model if probability else model.log_odds
    shape = [len(axis) for axis in axes]
    result = model.centers.new_empty(math.prod(shape))
    for start in range(0, len(result), BLOCK_POINTS):
        stop = min(start + BLOCK_POINTS, len(result))
        index = torch.unravel_index(torch.arange(start, stop, device=result.device), shape)
        points = torch.stack([axis[i] for axis, i in zip(axes, index, strict=True)], dim=1)
        result[start:stop] = answer(points)
    return result.reshape(shape)


def query_slice(
    model: Any,
    height: float | None = None,
    resolution: float = 0.05,
    bounds: tuple[Any, Any] | None = None,
) -> Slice:
    """Probability on a horizontal plane of a 3-D map, or on all of a 2-D map.

    Args:
        model: the map.
        height: z of the plane [m]; None for a 2-D map.
        resolution: distance of neighboring points [m].
        bounds: lower and upper (x, y) [m]; None: those of the map.

    Returns:
        The axes and the probabilities of the slice.

    Raises:
        ValueError: height is missing for a 3-D map or given for a 2-D one; another dimension.
    """
    if model.dim not in (2, 3):
        raise ValueError(
            f"a slice needs a map of 2 or 3 dimensions; got {model.dim}. Use query_grid"
        )
    if (height is None) != (model.dim == 2):
        raise ValueError(f"height must be a number in 3-D and None in 2-D; got {height}")
    lower, upper = map_bounds(model) if bounds is None else bounds
    level = [] if height is None else [float(height)]
    lower, upper = ([*torch.as_tensor(end).tolist()[:2], *level] for end in (lower, upper))
    axes = grid_axes(lower, upper, resolution)
    probability = query_grid(model, lower, upper, resolution)
    probability = probability.reshape(len(axes[0]), len(axes[1]))
    x_first, x_last, y_first, y_last = (float(axes[i][j]) for i in (0, 1) for j in (0, -1))
    return Slice(probability, (x_first, x_last, y_first, y_last))


@torch.no_grad()
def map_bounds(model: Any, margin: float = 0.0) -> tuple[Tensor, Tensor]:
    """Lower and upper corner of the mapped space: all clusters, three standard deviations around.

    Args:
        model: the map.
        margin: added on all sides [m].

    Returns:
        (D,) and (D,) float64, world frame [m].

    Raises:
        ValueError: the map is empty.
    """
    lower, upper = cluster_boxes(model)
    if len(lower) == 0:
        raise ValueError("the map must hold clusters to have bounds; it is empty: fit it first")
    return lower.amin(dim=0) - margin, upper.amax(dim=0) + margin


def cluster_boxes(model: Any, sign: int = 0) -> tuple[Tensor, Tensor]:
    """(M, D) and (M, D) corners of the boxes around each cluster's three standard deviations.

    The standard deviation along axis d is the length of row d of the factor. World frame, float64.
    With a sign of 1 or -1 only of the clusters whose weights have it.
    """
    boxes = []
    for piece in pieces(model):
        chosen = piece.weights.detach() * sign > 0 if sign else slice(None)
        factors = piece.scale_tril.detach()[chosen].double()
        reach = NUM_STDS * torch.linalg.vector_norm(factors, dim=2)
        centers = piece.centers.detach()[chosen].double() + piece.origin
        boxes.append((centers - reach, centers + reach))
    if not boxes:
        boxes = [(model.origin.new_zeros(0, model.dim),) * 2]
    return torch.cat([lower for lower, _ in boxes]), torch.cat([upper for _, upper in boxes])


@torch.no_grad()
def nearest_support(model: Any, points: Tensor, sign: int) -> Support:
    """The nearest cluster whose weight has this sign, of (N, D) float64 world positions [m]."""
    support = Support(torch.full_like(points, torch.nan), torch.zeros_like(points[:, 0]))
    for rows, part in local_parts(model, points, points):
        supporters = (part.weights * sign > 0).nonzero().squeeze(1)
        if len(supporters) == 0:
            continue
        centers = part.centers.detach()[supporters]
        local = (points[rows] - part.origin).to(centers.dtype)
        nearest = nearest_centers(local, centers, 1).squeeze(1)
        stds = torch.linalg.svdvals(part.scale_tril.detach()[supporters].double())
        support.centers[rows] = centers[nearest].double() + part.origin
        support.thickness[rows] = stds[nearest, -1]
    return support


def pieces(model: Any) -> Iterable[Any]:
    """Maps that together hold every cluster once: the map itself, or its tiles one by one."""
    return model.pieces() if hasattr(model, "pieces") else (model,)


def local_parts(model: Any, lower: Tensor, upper: Tensor) -> Iterator[tuple[Tensor, Any]]:
    """Numbers of some of N boxes, (N, D) to (N, D) world [m], and a map that answers inside of them.

    All numbers with the map itself; of a tiled map those of boxes near each other, and a part of it.
    """
    if hasattr(model, "local_parts"):
        yield from model.local_parts(lower, upper)
    else:
        yield torch.arange(len(lower), device=lower.device), model


def occupancy_gradient(model: Any, points: Tensor) -> Tensor:
    """(..., D) gradient of the log-odds at (..., D) world points [1/m]: the way into obstacles."""
    with torch.enable_grad():
        points = points.detach().clone().requires_grad_()
        return torch.autograd.grad(model.log_odds(points).sum(), points)[0]
