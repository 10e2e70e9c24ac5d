"""Questions to a map: lattices of points, slices, the first obstacle along a ray, gradients.

A map is anything with the members of `LardHilbertMap` that are used here: ``log_odds(points)``,
``centers``, ``scale_tril``, ``weights``, ``origin`` and ``dim``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

BLOCK_POINTS = 1 << 20  # points evaluated at a time
NUM_STDS = 3.0  # how far a cluster reaches: exp(-3² / 2) = 1 % of its peak
BISECTIONS = 16  # a step of 5 cm is narrowed down to below 1 µm
STRIDE = 16  # steps of a ray evaluated together, before finished rays are set aside
EVIDENCE = 1.0  # log-odds beyond the threshold that something measured reaches; ripple does not


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


@torch.no_grad()
def query_grid(model: Any, lower: Any, upper: Any, resolution: float) -> Tensor:
    """Probability at all points of `grid`, without holding the points: (nx, ny, nz).

    Evaluated a million points at a time; the result has the map's dtype and device.
    """
    axes = grid_axes(lower, upper, resolution, model.centers.device)
    if len(axes) != model.dim:
        raise ValueError(f"lower and upper must have {model.dim} coordinates; got {len(axes)}")
    shape = [len(axis) for axis in axes]
    result = model.centers.new_empty(math.prod(shape))
    for start in range(0, len(result), BLOCK_POINTS):
        stop = min(start + BLOCK_POINTS, len(result))
        index = torch.unravel_index(torch.arange(start, stop, device=result.device), shape)
        points = torch.stack([axis[i] for axis, i in zip(axes, index, strict=True)], dim=1)
        result[start:stop] = model(points)
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
        bounds: lower and upper (x, y) [m]; left out: those of the map.

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
    if len(model.centers) == 0:
        raise ValueError("the map must hold clusters to have bounds; it is empty: fit it first")
    lower, upper = cluster_boxes(model)
    return lower.amin(dim=0) - margin, upper.amax(dim=0) + margin


def cluster_boxes(model: Any) -> tuple[Tensor, Tensor]:
    """(M, D) and (M, D) corners of the boxes around each cluster's three standard deviations.

    The standard deviation along axis d is the length of row d of the factor. World frame, float64.
    """
    reach = NUM_STDS * torch.linalg.vector_norm(model.scale_tril.detach().double(), dim=2)
    centers = model.centers.detach().double() + model.origin
    return centers - reach, centers + reach


def occupancy_gradient(model: Any, points: Tensor) -> Tensor:
    """(..., D) gradient of the log-odds at (..., D) world points [1/m]: the way into obstacles."""
    with torch.enable_grad():
        points = points.detach().clone().requires_grad_()
        return torch.autograd.grad(model.log_odds(points).sum(), points)[0]


@torch.no_grad()
def raycast(
    model: Any,
    origins: Tensor,
    directions: Tensor,
    max_range: float,
    threshold: float = 0.5,
    step: float | None = None,
) -> Tensor:
    """Distance along each ray at which the probability first rises above a threshold.

    The ray is sampled every ``step`` until log-odds are clearly above the threshold, by 1; then
    the place where they last crossed it is narrowed down by bisection. Without that margin the
    ripple around 0 where nothing was measured would stop rays. A ray that starts clearly above the
    threshold gives 0; one that starts in between is met where it gets clearly above.

    Args:
        model: the map.
        origins: (R, D) or (D,) starts, world frame [m].
        directions: (R, D) of any length but 0.
        max_range: where to give up [m].
        threshold: probability of occupancy that counts as an obstacle, between 0 and 1.
        step: [m]; an obstacle thinner than this can be missed. Left out: the median standard
            deviation of the occupied clusters across their surface, a third of a wall or less.

    Returns:
        (R,) float64 distances [m], infinite where nothing is met up to max_range.

    Raises:
        ValueError: shapes do not match, a direction is zero or not finite, or a number is not in
            its range.
    """
    _check_raycast(model, origins, directions, max_range, threshold, step)
    device = model.centers.device
    directions = directions.to(device, torch.float64)
    directions = directions / torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    origins = origins.to(device, torch.float64).expand_as(directions)
    step = min(surface_step(model) if step is None else step, max_range)
    level = math.log(threshold / (1 - threshold))
    rays_at_once = max(1, BLOCK_POINTS // STRIDE)
    parts = [
        _march(model, start, heading, max_range, level, step)
        for start, heading in zip(
            origins.split(rays_at_once), directions.split(rays_at_once), strict=True
        )
    ]
    return torch.cat(parts)


def surface_step(model: Any) -> float:
    """Median of the clusters' smallest standard deviation [m], of those that speak for occupied.

    Raises:
        ValueError: the map has no such cluster and so no surface.
    """
    factors = model.scale_tril[model.weights > 0].detach().double()
    if len(factors) == 0:
        raise ValueError("the map must hold a cluster of positive weight; got none: give a step")
    return float(torch.linalg.svdvals(factors)[:, -1].median())


def _march(
    model: Any, origins: Tensor, directions: Tensor, max_range: float, level: float, step: float
) -> Tensor:
    """(R,) depth at which each ray meets the level; finished rays leave the batch."""
    high = origins.new_full((len(origins),), torch.inf)  # first depth clearly above the level
    low = torch.full_like(high, -1.0)  # last depth before it that is not above; -1: none yet
    active = torch.arange(len(origins), device=origins.device)
    steps = torch.arange(STRIDE, device=origins.device)
    start = 0
    while len(active) and start * step <= max_range:
        depths = ((start + steps).double() * step).clamp(max=max_range)
        points = origins[active, None] + depths[:, None] * directions[active, None]
        log_odds = model.log_odds(points)
        clear = log_odds > level + EVIDENCE
        hit = clear.any(dim=1)
        first = torch.where(hit, clear.to(torch.uint8).argmax(dim=1), STRIDE)
        below = (log_odds <= level) & (steps < first[:, None])
        last = torch.where(below, depths, -1.0).amax(dim=1)
        low[active] = torch.maximum(low[active], last)
        high[active[hit]] = depths[first[hit]]
        active = active[~hit]
        start += STRIDE
    hits = high.isfinite().nonzero().squeeze(1)
    target = torch.where(low[hits] < 0, level + EVIDENCE, level)
    low = torch.where(low < 0, (high - step).clamp(min=0.0), low)
    high[hits] = _bisect(model, origins[hits], directions[hits], low[hits], high[hits], target)
    return high


def _bisect(
    model: Any, origins: Tensor, directions: Tensor, low: Tensor, high: Tensor, level: Tensor
) -> Tensor:
    """(R,) depths between low, where log-odds are not above the level, and high, where they are."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        above = model.log_odds(origins + middle[:, None] * directions) > level
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return high


def _check_raycast(
    model: Any,
    origins: Tensor,
    directions: Tensor,
    max_range: float,
    threshold: float,
    step: float | None,
) -> None:
    if directions.ndim != 2 or directions.shape[1] != model.dim:
        raise ValueError(f"directions must be (R, {model.dim}); got {tuple(directions.shape)}")
    if tuple(origins.shape) not in (tuple(directions.shape), (model.dim,)):
        raise ValueError(
            f"origins must be {tuple(directions.shape)} as the directions, or one ({model.dim},); "
            f"got {tuple(origins.shape)}"
        )
    lengths = torch.linalg.vector_norm(directions.double(), dim=1)
    if not ((lengths > 0) & lengths.isfinite()).all():
        raise ValueError("directions must be finite and not zero; got one that is")
    if not (max_range > 0 and math.isfinite(max_range)):
        raise ValueError(f"max_range must be > 0 m and finite; got {max_range}")
    if not 0 < threshold < 1:
        raise ValueError(f"threshold must be between 0 and 1, both excluded; got {threshold}")
    if step is not None and not step > 0:
        raise ValueError(f"step must be > 0 m; got {step}")
