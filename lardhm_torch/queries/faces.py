"""The surface of a map as flat faces: one for each side of an occupied cluster.

The hits of a cluster lie in a plate: a plane through their mean, normal to their direction of least
variance. A plate has a face on each side from which it was observed. The face lies one standard deviation
of the hits in front of their mean, because the nearest of noisy hits are about that far in front of it.
Its edges are those of uniformly distributed hits, or where the log-odds fall. A plate counts only if the
map predicts that its center is occupied. Kept hits far from all faces, such as stray hits and those
beyond the edges, are faces without an extent.

The faces of a map are cached. After an update only those near changed clusters are recomputed.
"""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.maps import (
    OccupancyMap,
    covariance_scale,
    kept_hits,
    num_neighbors,
    stored_moments,
)
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN
from lardhm_torch.queries.nearest_face import Faces, face_distances, nearest_faces

EDGE = math.sqrt(3)  # half edge of a uniform distribution, in standard deviations
FADES = 0.4  # of the log-odds at the center: a plate ends where they are below this
STEPS = 4  # from the center to an edge at which the log-odds are compared
SIDES = (0.15, 0.3)  # [m] in front of a face, where a sensor that saw it left free space
NEAR = 3.0  # standard deviations of the hits of a face: the others are not near it
CHUNK_CLUSTERS = 1 << 14


@dataclass(frozen=True, eq=False)
class _Plates:
    """Plates of the M clusters of a map, and the tensors that they were made from.

    ``is_surface`` (M,); ``is_seen`` (M, 2) from the side of the normal and from the other;
    ``centers`` (M, D), ``axes`` (M, D, D) and ``half`` (M, D), the thickness first; ``is_bare``
    (M, K) whether a kept hit is near no face.
    """

    source: tuple[Tensor, ...]
    is_bare: Tensor
    is_surface: Tensor
    is_seen: Tensor
    centers: Tensor
    axes: Tensor
    half: Tensor


_kept: weakref.WeakKeyDictionary[OccupancyMap, tuple[_Plates, Faces]] = weakref.WeakKeyDictionary()


@torch.no_grad()
def surface_faces(model: OccupancyMap) -> Faces:
    """The faces of a map held in memory, from the last call where no cluster has changed since."""
    source = _source(model)
    plates, faces = _kept.get(model, (None, None))
    if plates is not None and faces is not None:
        before = plates.source
        if all(map(torch.equal, source, before)):
            return faces
    plates, rows = _updated(model, source, plates)
    faces, hits = _faces_of(plates), kept_hits(model)
    if hits is not None:
        _find_bare(model, rows, hits, (plates, faces))
        faces = _with_bare(faces, hits, plates)
    _kept[model] = plates, faces
    return faces


def kernel_tensors(model: OccupancyMap) -> tuple[Tensor, ...]:
    """What determines the log-odds of a map: origin, weights, centers, and factors as it stores them."""
    raw = getattr(model, "raw_scale_tril", None)
    factors = model.scale_tril if raw is None else raw
    return model.origin, *(t.detach() for t in (model.weights, model.centers, factors))


def _source(model: OccupancyMap) -> tuple[Tensor, ...]:
    """Everything that the plates are made from: `kernel_tensors`, and the hits' moments if stored."""
    return *kernel_tensors(model), *(stored_moments(model) or ())


def _moments(model: OccupancyMap) -> tuple[Tensor, Tensor, Tensor]:
    """(M,) whether a cluster is one of hits, their (M, D) means and (M, D, D) covariances."""
    stored = stored_moments(model)
    if stored is not None:
        is_occupied, counts, means, scatters = stored
        sizes = counts.clamp(min=1).to(means.dtype)
        return is_occupied & (counts > 0), means, scatters / sizes[:, None, None]
    factors = model.scale_tril.detach()
    return (
        model.weights.detach() > 0,
        model.centers.detach(),
        factors @ factors.mT / covariance_scale(model),
    )


def _updated(
    model: OccupancyMap, source: tuple[Tensor, ...], old: _Plates | None
) -> tuple[_Plates, Tensor]:
    """Plates of the map: the old ones, and new ones, in some rows, where a cluster nearby has changed."""
    origin, weights, centers = source[:3]
    is_hit, means, covariances = _moments(model)
    dim, count, hits = model.dim, len(weights), kept_hits(model)
    capacity = 0 if hits is None else hits.shape[1]
    new = _Plates(
        tuple(tensor.clone() for tensor in source),
        torch.zeros(count, capacity, dtype=torch.bool, device=origin.device),
        torch.zeros_like(is_hit),
        torch.zeros(count, 2, dtype=torch.bool, device=origin.device),
        torch.zeros(count, dim, dtype=torch.float64, device=origin.device),
        torch.zeros(count, dim, dim, dtype=torch.float64, device=origin.device),
        torch.zeros(count, dim, dtype=torch.float64, device=origin.device),
    )
    rows = is_hit.nonzero().squeeze(1)
    everything = rows
    if old is not None and torch.equal(old.source[0], origin) and len(old.source[1]) <= count:
        kept = len(old.source[1])
        for name in ("is_bare", "is_surface", "is_seen", "centers", "axes", "half"):
            getattr(new, name)[:kept] = getattr(old, name)
        changed = torch.ones(count, dtype=torch.bool, device=origin.device)
        changed[:kept] = False
        for ours, theirs in zip(source[1:], old.source[1:], strict=True):
            changed[:kept] |= (ours[:kept] != theirs).reshape(kept, -1).any(dim=1)
        new.is_surface[changed] = False
        new.is_bare[changed] = False
        places = torch.cat([centers[changed], old.source[2][changed[:kept]]])
        rows = rows[changed[rows] | _near(model, means[rows], places)]
    for some in rows.split(CHUNK_CLUSTERS):
        _make_plates(model, some, (means[some], covariances[some]), new)
    if len(rows) == len(everything) or hits is None or old is None:
        return new, everything
    before = torch.cat([rows[rows < kept], changed[:kept].nonzero().squeeze(1)])
    parts = ((new.centers, new.half, rows), (old.centers, old.half, before))
    centers, half = (torch.cat([part[i][part[2]] for part in parts]) for i in range(2))
    spread = torch.linalg.vector_norm(hits[everything] - means[everything, None], dim=2)
    reach = torch.where(spread.isfinite(), spread, 0.0).amax(dim=1)
    reach = reach + (1 + NEAR) * torch.linalg.vector_norm(half, dim=1).amax()
    return new, everything[_distance_to(means[everything], centers) <= reach]


def _near(model: OccupancyMap, means: Tensor, places: Tensor) -> Tensor:
    """(M,) whether a cluster at one of these places may answer where a plate asks the map."""
    if len(places) == 0 or len(means) == 0:
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    centers = model.centers.detach()
    farthest = native.nearest_centers(means, centers, num_neighbors(model))
    reach = torch.linalg.vector_norm(centers[farthest] - means[:, None], dim=2).amax(dim=1)
    return _distance_to(means, places) <= reach + 4 * max(SIDES)


def _distance_to(points: Tensor, places: Tensor) -> Tensor:
    """(N,) distance of (N, D) points to the nearest of some places."""
    places = places.to(points.dtype)
    closest = places[native.nearest_centers(points, places, 1).squeeze(1)]
    return torch.linalg.vector_norm(closest - points, dim=1)


def _make_plates(
    model: OccupancyMap, rows: Tensor, moments: tuple[Tensor, Tensor], plates: _Plates
) -> None:
    """Write the plates of some clusters of hits, given their means and covariances."""
    centers, dim = moments[0].double(), model.dim
    values, axes = torch.linalg.eigh(moments[1].double())
    half = values.clamp(min=0).sqrt()
    half[:, 1:] *= EDGE

    def log_odds(offsets: Tensor) -> Tensor:
        """(B, S, D) offsets from the centers -> (B, S) log-odds."""
        points = (centers[:, None] + offsets) + plates.source[0]
        return model.log_odds(points.reshape(-1, dim)).reshape(offsets.shape[:2]).double()

    inside = log_odds(torch.zeros_like(centers)[:, None]).squeeze(1)
    ahead = half.new_tensor(SIDES) + half[:, :1]  # (B, S)
    normals = ahead[:, :, None] * axes[:, None, :, 0]
    seen = [log_odds(side * normals).amin(dim=1) < -LOG_ODDS_MARGIN for side in (1, -1)]
    limit = (FADES * inside)[:, None]
    steps = torch.arange(1, STEPS + 1, device=rows.device) / STEPS
    ends = [torch.zeros_like(centers) for _ in range(2)]
    for axis in range(1, dim):
        edge = half[:, axis, None] * axes[:, :, axis]
        for end, side in zip(ends, (1, -1), strict=True):
            along = log_odds(side * steps[:, None].double() * edge[:, None])
            end[:, axis] = _until(torch.cat([inside[:, None], along], dim=1), limit)
    half[:, 1:] *= (ends[0] + ends[1])[:, 1:] / 2
    shift = torch.einsum("mde,me->md", axes[:, :, 1:], (ends[0] - ends[1])[:, 1:] / 2 * EDGE
                         * values.clamp(min=0).sqrt()[:, 1:])  # fmt: skip
    plates.is_surface[rows] = inside > 0
    plates.is_seen[rows] = torch.stack(seen, dim=1)
    plates.centers[rows], plates.axes[rows], plates.half[rows] = centers + shift, axes, half


def _until(values: Tensor, limit: Tensor) -> Tensor:
    """(B, S) values at equal steps from 0 to 1, above (B, 1) limits at 0 -> (B,) where they cross."""
    below = values < limit
    first = below.to(torch.uint8).argmax(dim=1, keepdim=True).clamp(min=1)
    before, after = values.gather(1, first - 1), values.gather(1, first)
    part = ((before - limit) / (before - after).clamp(min=1e-12)).clamp(0, 1)
    where = (first - 1 + part).squeeze(1) / (values.shape[1] - 1)
    return torch.where(below.any(dim=1), where, 1.0)


def _faces_of(plates: _Plates) -> Faces:
    """One face on each side that was seen; on both where none was."""
    parts = []
    for side, seen in ((1, plates.is_seen[:, 0]), (-1, plates.is_seen[:, 1])):
        wanted = plates.is_surface & (seen | ~plates.is_seen.any(dim=1))
        rows = wanted.nonzero().squeeze(1)
        axes = plates.axes[rows].clone()
        axes[:, :, 0] *= side
        centers = plates.centers[rows] + plates.half[rows, :1] * axes[:, :, 0]
        parts.append((centers, axes, plates.half[rows, 1:], plates.half[rows, 0]))
    centers, axes, half, noise = (torch.cat(column) for column in zip(*parts, strict=True))
    nothing = noise[:0]
    tree = native.face_tree(centers, axes, half, nothing)
    return Faces(centers, axes, half, nothing, noise, tree)


def _find_bare(
    model: OccupancyMap, rows: Tensor, hits: Tensor, made: tuple[_Plates, Faces]
) -> None:
    """Find the kept hits of some clusters that the map holds to be occupied, but no face is near."""
    plates, faces = made
    plates.is_bare[rows] = False
    kept = hits[rows].isfinite().all(dim=2).nonzero()
    row, column = rows[kept[:, 0]], kept[:, 1]
    points = hits[row, column].double()
    nearest = nearest_faces(points, faces, math.inf)
    away = face_distances(points, faces, nearest, math.inf).abs()
    far = nearest < 0
    if len(faces.noise):
        far |= away > NEAR * faces.noise[nearest]
    row, column, points = row[far], column[far], points[far]
    plates.is_bare[row, column] = model.log_odds(points + plates.source[0]) > 0


def _with_bare(faces: Faces, hits: Tensor, plates: _Plates) -> Faces:
    """The faces, and those without an extent."""
    row, column = plates.is_bare.nonzero().unbind(dim=1)
    axes, seen = plates.axes[row].clone(), plates.is_seen[row]
    axes[:, :, 0] *= torch.where(seen[:, 0] | ~seen[:, 1], 1.0, -1.0)[:, None]
    points, nothing = hits[row, column].double(), axes.new_zeros(len(row), hits.shape[2])
    centers, axes = torch.cat([faces.centers, points]), torch.cat([faces.axes, axes])
    half = torch.cat([faces.half, nothing[:, 1:]])
    noise = torch.cat([faces.noise, nothing[:, 0]])
    tree = native.face_tree(centers, axes, half, faces.thickness)
    return Faces(centers, axes, half, faces.thickness, noise, tree)
