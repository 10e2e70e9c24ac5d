"""Lower bound on the distance to the nearest obstacle, with gradient."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.maps import (
    OccupancyMap,
    TensorLike,
    in_memory,
    num_neighbors,
    reads_map,
    to_tensor,
)
from lardhm_torch.queries.faces import kernel_tensors, surface_faces
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN, threshold_log_odds
from lardhm_torch.queries.nearest_face import (
    Faces,
    height_and_side,
    nearest_faces,
    plates_of,
    to_nearest,
)

MIN_THRESHOLD = 0.27  # log-odds of -1: `LOG_ODDS_MARGIN` above it is unknown space
LATTICE = 7  # points along each axis of a cluster at which the map is queried
NEARLY = 0.5  # log-odds so little below those of an obstacle count, too: one may lie in between
CHUNK_POINTS = 1 << 17


@reads_map
def clearance(model: OccupancyMap, points: TensorLike, threshold: float = 0.5) -> Tensor:
    """Lower bound on the distance to the nearest obstacle; differentiable.

    An obstacle is where the log-odds exceed those of the threshold by `LOG_ODDS_MARGIN`, as for
    `raycast`. The result is the larger of two lower bounds.

    - At most k clusters contribute to the log-odds of a point, so one of them contributes at least
      1/k. Therefore an obstacle lies in the ellipsoid |inv(L) (x - c)| <= E of a cluster of positive
      weight w, with E = sqrt(2 log(k w / log-odds)). The first bound is the distance to flat boxes
      (plates) around the ellipsoids.
    - The map is queried on a lattice over all these ellipsoids, to find points that are obstacles or
      nearly so. The second bound is the distance to the `faces` of the map, made thick enough to
      contain these points. It is much tighter, but an obstacle between points of the lattice can be
      missed.

    Args:
        model: the map; a tiled map must fit in memory.
        points: (..., D) world positions [m].
        threshold: probability of occupancy that counts as an obstacle, between 0.27 and 1.

    Returns:
        (...) float64 distances [m], at most that to the nearest obstacle, and 1-Lipschitz. Negative
        where an obstacle is possible; infinite if the map has no obstacle.

    Raises:
        ValueError: threshold is not between 1 / (1 + e) = 0.27 and 1, or points are not (..., D).
    """
    if not MIN_THRESHOLD < threshold < 1:
        raise ValueError(f"threshold must be between 0.27 and 1; got {threshold}")
    points = to_tensor(points, "points", model.origin.device)
    if points.ndim == 0 or points.shape[-1] != model.dim:
        raise ValueError(f"points must be (..., {model.dim}); got {tuple(points.shape)}")
    model = in_memory(model)
    local = points.reshape(-1, model.dim) - model.origin
    plates = obstacle_plates(model, threshold_log_odds(threshold) + LOG_ODDS_MARGIN)
    bounds = [to_nearest(local, part, torch.inf)[0] for part in plates]
    return torch.maximum(*bounds).reshape(points.shape[:-1])


class _Obstacles(NamedTuple):
    """Two sets of plates; each of them contains all obstacles of a map."""

    ellipsoids: Faces
    surfaces: Faces


_kept: weakref.WeakKeyDictionary[OccupancyMap, tuple[tuple[Tensor, ...], _Obstacles]]
_kept = weakref.WeakKeyDictionary()


@torch.no_grad()
def obstacle_plates(model: OccupancyMap, target: float) -> _Obstacles:
    """Plates around every point whose log-odds exceed a target above 0; kept with the map."""
    source = (*kernel_tensors(model), model.origin.new_tensor(target))
    before, plates = _kept.get(model, ((), None))
    if plates is not None and all(map(torch.equal, source, before)):
        return plates
    ellipsoids = _ellipsoids(model, target)
    plates = _Obstacles(ellipsoids, _around_surfaces(model, ellipsoids, target))
    _kept[model] = tuple(part.clone() for part in source), plates
    return plates


def _ellipsoids(model: OccupancyMap, target: float) -> Faces:
    """Plates around the ellipsoids of all clusters that can contribute enough to an obstacle."""
    weights = model.weights.detach().double()
    most = min(num_neighbors(model), int((weights > 0).sum()))
    rows = (weights * most > target).nonzero().squeeze(1)
    axes, stds, _ = torch.linalg.svd(model.scale_tril.detach()[rows].double())
    axes, stds = axes.flip(2).contiguous(), stds.flip(1)  # the thinnest axis first
    extents = stds * (2 * (most * weights[rows] / target).log()).sqrt()[:, None]
    centers = model.centers.detach()[rows].double()
    return plates_of(centers, axes, extents[:, 1:].contiguous(), extents[:, 0].contiguous())


def _around_surfaces(model: OccupancyMap, ellipsoids: Faces, target: float) -> Faces:
    """The faces of the map, made so thick that they contain what exceeds the target nearby.

    The map is asked on a lattice over each ellipsoid. One that holds obstacles far from all faces is
    added as it is.
    """
    faces = surface_faces(model)
    if len(faces.centers) == 0:
        return ellipsoids
    steps = torch.linspace(-1, 1, LATTICE, dtype=torch.float64, device=faces.half.device)
    lattice = torch.cartesian_prod(*[steps] * model.dim).reshape(-1, model.dim)
    extents = torch.cat([ellipsoids.thickness[:, None], ellipsoids.half], dim=1)
    ends = faces.centers.new_zeros(3, len(faces.centers))  # before, behind and beside each face
    lonely = torch.zeros(len(extents), dtype=torch.bool, device=extents.device)
    rows = torch.arange(len(extents), device=extents.device)
    for some in rows.split(max(1, CHUNK_POINTS // len(lattice))):
        axes = ellipsoids.axes[some] * extents[some, None]
        points = ellipsoids.centers[some, None] + torch.einsum("mde,se->msd", axes, lattice)
        slack = extents[some, 0] / (LATTICE - 1)
        is_near = model.log_odds(points + model.origin) > target - NEARLY
        owner = is_near.nonzero()[:, 0]
        points = points[is_near]
        nearest = nearest_faces(points, faces, torch.inf)
        height, side = height_and_side(points, faces, nearest)
        is_far = torch.hypot(height, side.clamp(min=0)) > extents[some].amax(dim=1)[owner]
        lonely[some[owner[is_far]]] = True
        kept = ~lonely[some[owner]]
        for end, away in zip(ends, (height, -height, side), strict=True):
            end.scatter_reduce_(0, nearest[kept], (away + slack[owner])[kept], "amax")
    before, behind, beside = ends
    centers = faces.centers + ((before - behind) / 2)[:, None] * faces.axes[:, :, 0]
    plates = (centers, faces.axes, faces.half + beside[:, None], (before + behind) / 2)
    others = (ellipsoids.centers, ellipsoids.axes, ellipsoids.half, ellipsoids.thickness)
    parts = zip(plates, others, strict=True)
    return plates_of(*(torch.cat([ours, theirs[lonely]]) for ours, theirs in parts))
