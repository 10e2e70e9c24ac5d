"""Gaps in surfaces: kernels that reach the next cluster in their plane, and training points between.

Between the rings of a spinning lidar lie gaps wider than the clusters of the hits, and a floor falls
into stripes. Where clusters lie in one plane and no ray passed between them, their kernels are
stretched until they meet, and occupied points in the gap train the weights. The moments of the
clusters do not change, and updates keep the stretched kernels as they keep fine-tuned ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, raw_factors
from lardhm_torch.learning.clustering import points_where
from lardhm_torch.learning.map_state import MapState, factor_covariances
from lardhm_torch.native.crossings import PRIMES
from lardhm_torch.sampling import UNKNOWN

PATCH = 5  # nearest clusters that define the plane of a cluster ...
FLAT = 0.25  # ... if their thickness, relative to their second smallest extent, is at most this
CANDIDATES = 24  # nearest clusters among which the next one in the plane is sought
FARTHEST = 3.0  # [m] ... up to this distance
SLOPE = 0.1  # largest distance of either center from the plane of the other, relative to the gap
ALONG = 0.5  # cosine of the largest angle between an axis and the way to the next cluster
REACH = 0.5  # standard deviation along the axis, relative to the distance of the next cluster
EDGE = 2.0  # standard deviations from the center, where a cluster ends and the gap begins
MOST = 64  # points in a gap
CLEAR = (
    0.2  # [m] a free or unknown point in the plane, closer than this to a probe, keeps a gap open
)
CELL_BITS = 20  # of the table in `close_points`
PROBES = (0.25, 0.5, 0.75)  # places between the centers where such points are sought


class Plates(NamedTuple):
    """M clusters of hits as flat ellipsoids, in the planes of their neighborhoods."""

    centers: Tensor  # (M, D) [m]
    axes: Tensor  # (M, D, D) columns: the normal of the plane, then axes in the plane
    extents: Tensor  # (M, D) standard deviations along the axes [m]
    counts: Tensor  # (M,) number of hits
    is_flat: Tensor  # (M,) bool

    @property
    def normals(self) -> Tensor:
        """(M, D) normals of the planes."""
        return self.axes[:, :, 0]


class Gaps(NamedTuple):
    """P gaps between a cluster and the next one along one of its axes."""

    first: Tensor  # (P,) row of the cluster
    second: Tensor  # (P,) row of the next cluster
    axis: Tensor  # (P,) number of the axis of the first
    lengths: Tensor  # (P,) distance of the centers [m]
    empty: Tensor  # (P,) length of the gap between the edges of the clusters [m]


def bridged(
    state: MapState, points: Tensor, labels: Tensor, kernel: Kernel, rng: torch.Generator
) -> tuple[MapState, Tensor, Tensor]:
    """Stretch kernels of surfaces across gaps and add occupied samples there.

    Without unknown samples nothing is known about gaps, and nothing changes.

    Args:
        state: M new clusters of the samples.
        points: (N, D) positions [m], map frame.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        kernel: of the map.
        rng: random state.

    Returns:
        The clusters, (N', D) positions and (N',) labels; added samples are the last ones.
    """
    rows = state.is_occupied.nonzero().squeeze(1)
    if len(rows) < PATCH or not bool((labels == UNKNOWN).any()):
        return state, points, labels
    plates = find_plates(state.rows(rows), kernel.min_lengthscale)
    gaps = find_gaps(plates)
    gaps = _selected(gaps, ~is_open(gaps, plates, points_where(points, labels <= UNKNOWN)))
    stretched, raw = stretched_factors(gaps, plates)
    raw_scale_tril = state.raw_scale_tril.index_copy(0, rows[stretched], raw)
    added = points_in(gaps, plates, rng)
    labels = torch.cat([labels, labels.new_ones(len(added))])
    return replace(state, raw_scale_tril=raw_scale_tril), torch.cat([points, added]), labels


def find_plates(surfaces: MapState, floor: float) -> Plates:
    """Clusters of hits as flat ellipsoids.

    The plane is that of the `PATCH` nearest clusters, so that it is also known where a cluster holds
    hits of a single ring.

    Args:
        surfaces: M occupied clusters, at least `PATCH`.
        floor: smallest standard deviation [m].
    """
    centers, covariances = surfaces.means, surfaces.clusters.covariances
    near = native.nearest_centers(centers, centers, PATCH)
    fractions = surfaces.counts[near].to(centers)
    fractions = fractions / fractions.sum(dim=1, keepdim=True)
    offsets = centers[near] - centers[:, None]
    offsets = offsets - (fractions[:, :, None] * offsets).sum(dim=1, keepdim=True)
    around = covariances[near] + offsets[:, :, :, None] * offsets[:, :, None]
    around = (fractions[:, :, None, None] * around).sum(dim=1)
    variances, directions = native.symmetric_axes(around)
    normals = directions[:, :, 0]
    across = normals[:, :, None] * normals[:, None]  # (M, D, D)
    eye = torch.eye(centers.shape[1]).to(centers)
    inside = (eye - across) @ covariances @ (eye - across)
    # the normal has the only negative eigenvalue
    spread, axes = native.symmetric_axes(inside - across)
    spread[:, 0] = (normals[:, None] @ covariances @ normals[:, :, None]).flatten()
    extents = (spread.clamp(min=0) + floor**2).sqrt()
    patch = (variances.clamp(min=0) + floor**2).sqrt()
    is_flat = (patch[:, 0] < FLAT * patch[:, 1]) & (extents[:, 0] < FLAT * extents[:, -1])
    return Plates(centers, axes, extents, surfaces.counts, is_flat)


def find_gaps(plates: Plates) -> Gaps:
    """The next cluster in the plane of each flat cluster, along each of its axes and both ways.

    In the plane means: each center lies within the thickness of the thicker cluster and `SLOPE` times
    the distance from the plane of the other.
    """
    centers, axes, extents, _, is_flat = plates
    rows = is_flat.nonzero().squeeze(1)
    near = native.nearest_centers(centers[rows], centers, min(CANDIDATES + 1, len(centers)))
    offsets = centers[near] - centers[rows, None]  # (F, K, D)
    lengths = torch.linalg.vector_norm(offsets, dim=2)
    along = offsets @ axes[rows]
    height = (offsets * plates.normals[near]).sum(dim=2).abs().maximum(along[:, :, 0].abs())
    thickness = extents[:, 0]
    level = height < thickness[near].maximum(thickness[rows, None]) + SLOPE * lengths
    fits = level & is_flat[near] & (lengths > 0) & (lengths < FARTHEST)
    found = []
    for column in range(1, centers.shape[1]):
        for sign in (1, -1):
            ahead = fits & (sign * along[:, :, column] > ALONG * lengths)
            nearest, place = torch.where(ahead, lengths, torch.inf).min(dim=1)
            first = nearest.isfinite().nonzero().squeeze(1)
            second = near[first, place[first]]
            found.append((rows[first], second, torch.full_like(first, column), nearest[first]))
    first, second, axis, lengths = map(torch.cat, zip(*found, strict=True))
    ways = (centers[second] - centers[first]) / lengths[:, None]
    ends = [_extent(plates, owner, ways) for owner in (first, second)]
    gaps = Gaps(first, second, axis, lengths, lengths - EDGE * (ends[0] + ends[1]))
    return _selected(gaps, gaps.empty > 0)


def _selected(gaps: Gaps, which: Tensor) -> Gaps:
    return Gaps(*(column[which] for column in gaps))


def is_open(gaps: Gaps, plates: Plates, others: Tensor) -> Tensor:
    """(P,) bool: a free or unknown point lies in the gap, in the plane.

    A free one means that a ray passed through, as in a door. An unknown one lies behind a hit: something
    stands in the gap and hides what is there.

    Args:
        gaps: P gaps.
        plates: M clusters.
        others: (F, D) free and unknown points [m].
    """
    if len(gaps.first) == 0:
        return torch.zeros_like(gaps.first, dtype=torch.bool)
    begin, normal = plates.centers[gaps.first], plates.normals[gaps.first]
    way = plates.centers[gaps.second] - begin
    thickness = plates.extents[gaps.first, 0].maximum(plates.extents[gaps.second, 0])
    places = way.new_tensor(PROBES)[:, None, None]
    probes = begin + places * way  # (3, P, D)
    farthest = float((thickness.square() + CLEAR**2).max().sqrt())
    others = close_points(others, probes.flatten(0, 1), farthest)
    if len(others) == 0:
        return torch.zeros_like(gaps.first, dtype=torch.bool)
    near = native.nearest_centers(probes.flatten(0, 1), others, 4)
    offsets = others[near].unflatten(0, probes.shape[:2]) - probes[:, :, None]
    height = (offsets * normal[:, None]).sum(dim=3).abs()
    aside = (offsets.square().sum(dim=3) - height.square()).clamp(min=0).sqrt()
    inside = (height < thickness[:, None]) & (aside < CLEAR)
    return inside.any(dim=2).any(dim=0)


def close_points(points: Tensor, places: Tensor, radius: float) -> Tensor:
    """Those of (N, D) points that may be closer than ``radius`` to one of (P, D) places, and some more.

    A hash of cells finds them in much less time than a search.
    """
    if native.supports(points):
        return points_where(points, torch.ops.lardhm.in_cells_around(points, places, radius))
    edge, dim = 2 * radius, points.shape[1]
    corners = torch.cartesian_prod(*[places.new_tensor([-radius, radius])] * dim).view(-1, dim)
    marked = torch.zeros(1 << CELL_BITS, dtype=torch.bool, device=points.device)
    marked[cell_entry(places[:, None] + corners, edge)] = True
    return points_where(points, marked[cell_entry(points, edge)])


def cell_entry(points: Tensor, edge: float) -> Tensor:
    """(..., D) positions -> (...) entry of each point's cell in a table of 2^`CELL_BITS`, int64."""
    cells = (points / edge).floor_()
    entry = cells[..., 0].long() * PRIMES[0]
    for axis in range(1, points.shape[-1]):
        entry ^= cells[..., axis].long() * PRIMES[axis % len(PRIMES)]
    return entry.bitwise_and_((1 << CELL_BITS) - 1)


def stretched_factors(gaps: Gaps, plates: Plates) -> tuple[Tensor, Tensor]:
    """(Q,) rows of the clusters with gaps, and (Q, D, D) raw factors that reach across them."""
    count, dim = plates.extents.shape
    extents = plates.extents.flatten()
    extents = extents.scatter_reduce(
        0, gaps.first * dim + gaps.axis, REACH * gaps.lengths, "amax"
    ).view(count, dim)
    rows = gaps.first.unique()
    axes = plates.axes[rows]
    covariances = (axes * extents[rows, None].square()) @ axes.mT
    return rows, raw_factors(factor_covariances(covariances, 0.0))


def points_in(gaps: Gaps, plates: Plates, rng: torch.Generator) -> Tensor:
    """(N, D) positions in the half of each gap next to its first cluster [m], as dense as its hits."""
    first, second = gaps.first, gaps.second
    wide = plates.extents[first, 1:].log().mean(dim=1).exp()  # of a square of the same area
    edge = 12**0.5 * wide
    wanted = plates.counts[first] * gaps.empty / (2 * edge)
    wanted = wanted + torch.rand(len(first), generator=rng, device=rng.device).to(wanted)
    number = wanted.long().clamp(max=MOST)
    first, second = first.repeat_interleave(number), second.repeat_interleave(number)
    begin, end = _drawn(plates, first, rng), _drawn(plates, second, rng)
    place = torch.rand(len(first), 1, generator=rng, device=rng.device).to(begin) / 2
    points = begin + place * (end - begin)
    local = (plates.axes[first].mT @ (points - plates.centers[first])[:, :, None]).squeeze(2)
    return points[(local / plates.extents[first])[:, 1:].square().sum(dim=1) > EDGE**2]


def _extent(plates: Plates, owner: Tensor, ways: Tensor) -> Tensor:
    """(P,) standard deviation of clusters along (P, D) directions [m]."""
    along = (ways[:, None] @ plates.axes[owner]).squeeze(1)
    return torch.linalg.vector_norm(along * plates.extents[owner], dim=1)


def _drawn(plates: Plates, owner: Tensor, rng: torch.Generator) -> Tensor:
    """(N, D) a random position in each of the given clusters [m]."""
    shape = (len(owner), plates.centers.shape[1])
    noise = torch.randn(shape, generator=rng, device=rng.device).to(plates.centers)
    moved = plates.axes[owner] @ (plates.extents[owner] * noise)[:, :, None]
    return plates.centers[owner] + moved.squeeze(2)
