"""Probabilities on grids and slices, bounds of a map, and its nearest clusters."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.maps import (
    OccupancyMap,
    TensorLike,
    local_parts,
    native_lattice,
    pieces,
    reads_map,
    to_tensor,
)
from lardhm_torch.native import build_index, nearest_centers
from lardhm_torch.queries.memory import check_memory

BLOCK_POINTS = 1 << 20  # points evaluated at a time
NUM_STDS = 3.0  # half edge of a cluster's box; a kernel is exp(-3^2 / 2) = 1 % of its peak there
# Log-odds beyond a threshold from which on a place counts as measured: tails of kernels stay below it.
LOG_ODDS_MARGIN = 1.0
SURFACES = (
    "peak",
    "crossing",
)  # a surface lies on the ridge of the log-odds, or at a level of them


class Support(NamedTuple):
    """Nearest cluster of one class for each of N points.

    ``centers`` (N, D) float64 world positions [m] and ``thickness`` (N,) float64, the smallest
    standard deviation of the kernel [m]; NaN and 0 where there is no such cluster.
    """

    centers: Tensor
    thickness: Tensor


class Slice(NamedTuple):
    """A horizontal cut through a map.

    ``probability`` (nx, ny), and ``extent`` (x_first, x_last, y_first, y_last) of its points [m].
    """

    probability: Tensor
    extent: tuple[float, float, float, float]


def grid(
    lower: TensorLike,
    upper: TensorLike,
    resolution: float,
    device: torch.device | str | None = None,
) -> Tensor:
    """All points of a regular grid from ``lower`` to ``upper``.

    The last point of an axis is ``upper`` if the edge is a multiple of the resolution, and less
    than one resolution below it otherwise.

    Args:
        lower: (D,) first point, world frame [m].
        upper: (D,) far corner [m].
        resolution: distance between neighboring points [m].
        device: of the result; None: that of ``lower`` if it is a tensor, else the CPU.

    Returns:
        (n1, ..., nD, D) float64 positions [m].

    Raises:
        ValueError: the corners are not finite, ordered and of one length, or resolution is not > 0.

    >>> grid([0, 0], [1, 2], 0.5).shape
    torch.Size([3, 5, 2])
    """
    axes = grid_axes(lower, upper, resolution, device)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def grid_axes(
    lower: TensorLike,
    upper: TensorLike,
    resolution: float,
    device: torch.device | str | None = None,
) -> list[Tensor]:
    """The D coordinate lists of `grid`, float64 [m]; arguments and errors are the same."""
    lower = to_tensor(lower, "lower", device)
    upper = to_tensor(upper, "upper", lower.device)
    if not (resolution > 0 and math.isfinite(resolution)):
        raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
    if lower.ndim != 1 or lower.shape != upper.shape or not (lower <= upper).all():
        raise ValueError(
            "lower and upper must be two lists of D coordinates, lower <= upper; "
            f"got {lower.tolist()} and {upper.tolist()}"
        )
    if not (lower.isfinite().all() and upper.isfinite().all()):
        raise ValueError(
            f"lower and upper must be finite; got {lower.tolist()} and {upper.tolist()}"
        )
    counts = ((upper - lower) / resolution + 1e-6).floor() + 1  # 1e-6: 0.3 / 0.1 is 2.99...
    length = float(counts.sum())
    check_memory(f"an axis would have {length:.3g} points", resolution, 8 * length, power=1)
    return [
        start + resolution * torch.arange(count, dtype=torch.float64, device=lower.device)
        for start, count in zip(lower, counts.long().tolist(), strict=True)
    ]


@reads_map
def query_grid(
    model: OccupancyMap, lower: TensorLike, upper: TensorLike, resolution: float
) -> Tensor:
    """Probability at all points of `grid`, without the memory for all points at once.

    Args:
        model: the map.
        lower: (D,) first point, world frame [m].
        upper: (D,) far corner [m].
        resolution: distance between neighboring points [m].

    Returns:
        (n1, ..., nD) in the dtype and on the device of the map, without gradient.

    Raises:
        ValueError: as for `grid`; the corners do not have the dimension of the map; or the grid would
            not fit in memory.
    """
    axes = grid_axes(lower, upper, resolution, model.origin.device)
    if len(axes) != model.dim:
        raise ValueError(f"lower and upper must have {model.dim} coordinates; got {len(axes)}")
    points = math.prod(len(axis) for axis in axes)
    needed = 2 * model.centers.element_size() * points
    check_memory(
        f"the grid would have {points / 1e6:.3g} million points", resolution, needed, len(axes)
    )
    return lattice_values(model, axes, probability=True)


@torch.no_grad()
def lattice_values(model: OccupancyMap, axes: list[Tensor], *, probability: bool) -> Tensor:
    """Probability, or log-odds, at all combinations of D lists of world coordinates [m].

    Returns:
        (len(axes[0]), len(axes[1]), ...) without gradient.
    """
    native = native_lattice(model, axes, probability)
    if native is not None:
        return native
    shape = [len(axis) for axis in axes]
    result = model.centers.new_empty(math.prod(shape))
    for start in range(0, len(result), BLOCK_POINTS):
        stop = min(start + BLOCK_POINTS, len(result))
        index = torch.unravel_index(torch.arange(start, stop, device=result.device), shape)
        points = torch.stack([axis[i] for axis, i in zip(axes, index, strict=True)], dim=1)
        result[start:stop] = model(points) if probability else model.log_odds(points)
    return result.reshape(shape)


@reads_map
def query_slice(
    model: OccupancyMap,
    height: float | None = None,
    resolution: float = 0.05,
    bounds: tuple[TensorLike, TensorLike] | None = None,
) -> Slice:
    """Probability on a horizontal plane of a 3-D map, or on all of a 2-D map.

    Args:
        model: the map.
        height: z of the plane [m]; None for a 2-D map.
        resolution: distance between neighboring points [m].
        bounds: lower and upper (x, y) [m]; further coordinates are ignored. None: `map_bounds`.

    Returns:
        (nx, ny) probabilities and their extent [m].

    Raises:
        ValueError: height is missing for a 3-D map or given for a 2-D one; the map has another
            dimension; or as for `grid`.
    """
    if model.dim not in (2, 3):
        raise ValueError(
            f"a slice needs a map of 2 or 3 dimensions; got {model.dim}. Use query_grid"
        )
    if (height is None) != (model.dim == 2):
        raise ValueError(f"height must be a number in 3-D and None in 2-D; got {height}")
    ends = map_bounds(model) if bounds is None else bounds
    level = [] if height is None else [float(height)]
    lower, upper = ([*to_tensor(end, "bounds").tolist()[:2], *level] for end in ends)
    axes = grid_axes(lower, upper, resolution)
    probability = query_grid(model, lower, upper, resolution)
    probability = probability.reshape(len(axes[0]), len(axes[1]))
    x_first, x_last, y_first, y_last = (float(axes[i][j]) for i in (0, 1) for j in (0, -1))
    return Slice(probability, (x_first, x_last, y_first, y_last))


@torch.no_grad()
@reads_map
def map_bounds(model: OccupancyMap, margin: float = 0.0) -> tuple[Tensor, Tensor]:
    """Axis-aligned bounding box of all clusters, three standard deviations around each.

    Args:
        model: the map.
        margin: added on all sides [m].

    Returns:
        lower and upper corner, (D,) float64, world frame [m].

    Raises:
        ValueError: the map is empty.
    """
    lower, upper = cluster_boxes(model)
    if len(lower) == 0:
        raise ValueError("the map must hold clusters to have bounds; it is empty: fit it first")
    return lower.amin(dim=0) - margin, upper.amax(dim=0) + margin


def cluster_boxes(
    model: OccupancyMap, sign: int = 0, bounds: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Axis-aligned boxes of three standard deviations around each cluster.

    The standard deviation of a kernel along axis d is the length of row d of its factor.

    Args:
        model: the map.
        sign: 1 or -1 for the clusters whose weights have this sign; 0 for all.
        bounds: corners (D,) of a box, world frame [m]; boxes that do not touch it may be
            left out. None: all of space.

    Returns:
        (M, D) lower and (M, D) upper corners, float64, world frame [m].
    """
    boxes = []
    for piece in pieces(model, bounds):
        chosen = piece.weights.detach() * sign > 0 if sign else slice(None)
        factors = piece.scale_tril.detach()[chosen].double()
        half_edges = NUM_STDS * torch.linalg.vector_norm(factors, dim=2)
        centers = piece.centers.detach()[chosen].double() + piece.origin
        boxes.append((centers - half_edges, centers + half_edges))
    if not boxes:
        boxes = [(model.origin.new_zeros(0, model.dim),) * 2]
    return torch.cat([lower for lower, _ in boxes]), torch.cat([upper for _, upper in boxes])


class SupportingClusters:
    """The clusters of a map whose weights have one sign, for `Support` at many points.

    Args:
        model: a map that fits in memory.
        sign: 1 or -1, of the weights.
    """

    def __init__(self, model: OccupancyMap, sign: int) -> None:
        chosen = (model.weights.detach() * sign > 0).nonzero().squeeze(1)
        self.origin = model.origin
        self.centers = model.centers.detach()[chosen]
        self.factors = model.scale_tril.detach()[chosen]
        self.stds = torch.full_like(self.centers[:, 0], torch.nan, dtype=torch.float64)
        self.index = build_index(self.centers, 1)

    def nearest(self, points: Tensor) -> Support:
        """Nearest of the clusters, for (N, D) float64 world positions [m]."""
        if len(self.centers) == 0:
            return Support(torch.full_like(points, torch.nan), torch.zeros_like(points[:, 0]))
        local = (points - self.origin).to(self.centers.dtype)
        nearest = nearest_centers(local, self.centers, 1, self.index).squeeze(1)
        new = nearest[self.stds[nearest].isnan()].unique()
        self.stds[new] = torch.linalg.svdvals(self.factors[new].double())[:, -1]
        return Support(self.centers[nearest].double() + self.origin, self.stds[nearest])


@torch.no_grad()
def nearest_support(model: OccupancyMap, points: Tensor, sign: int) -> Support:
    """The nearest cluster whose weight has this sign, for (N, D) float64 world positions [m]."""
    support = Support(torch.full_like(points, torch.nan), torch.zeros_like(points[:, 0]))
    for rows, part in local_parts(model, points, points):
        found = SupportingClusters(part, sign).nearest(points[rows])
        support.centers[rows], support.thickness[rows] = found
    return support


@reads_map
def occupancy_gradient(model: OccupancyMap, points: TensorLike) -> Tensor:
    """Gradient of the log-odds, which points into obstacles.

    Args:
        model: the map.
        points: (..., D) world positions [m].

    Returns:
        (..., D) in the dtype of the points, float64 for arrays and lists [1/m].
    """
    if not isinstance(points, Tensor):
        points = to_tensor(points, "points", model.origin.device)
    with torch.enable_grad():
        points = points.detach().clone().requires_grad_()
        return torch.autograd.grad(model.log_odds(points).sum(), points)[0]


def threshold_log_odds(threshold: float) -> float:
    """Log-odds of a probability threshold.

    Raises:
        ValueError: threshold is not between 0 and 1, both excluded.
    """
    if not 0 < threshold < 1:
        raise ValueError(f"threshold must be between 0 and 1, both excluded; got {threshold}")
    return math.log(threshold / (1 - threshold))
