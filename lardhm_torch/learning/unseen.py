"""Unknown points: training points of label 1/2, so that the probability of unobserved space is 1/2.

Kernels extend across walls and beyond observed space, where no occupied or free sample contradicts
them. Unknown points do: `sampling` places them behind hits, in cells that no ray crossed, and
`draw_tails` in the tails of the clusters. They form separate clusters, whose weights cancel these
contributions, so that the other clusters need not represent unobserved space.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, raw_factors
from lardhm_torch.learning.clustering import Clusters, points_where
from lardhm_torch.learning.map_state import MapState, factor_covariances
from lardhm_torch.learning.points import in_morton_order
from lardhm_torch.sampling import UNKNOWN

LARGEST = 1.25  # largest extent of a kernel, relative to the median ...
AROUND = 24  # ... of so many nearest clusters, itself among them
INSIDE = 6.0  # standard deviations from a surface's cluster: nothing there is unknown ...
SURFACE = 0.25  # [m] ... nor farther than this from its plane: wider clusters are no surfaces
TAILS = (2.0, 5.0)  # standard deviations from a cluster: where its tail is
TAIL_FEATURE = 0.4  # no cluster holds a place where no feature is larger
TAILS_PER_CLUSTER = 3  # at least ...
SAMPLES_PER_TAIL = 14  # ... and one for so many samples, so that large clusters have enough


def even_kernels(state: MapState, floor: float) -> MapState:
    """The clusters, of which those much larger than their neighbors have smaller kernels.

    A few hits far apart make a cluster that reaches meters into space that no ray observed, and only
    its tails have samples there. The extents of a kernel are at most `LARGEST` times the median of those
    of the nearest clusters of its class. The moments do not change. Free clusters keep their kernels,
    because free space is known between its samples. Without unknown clusters nothing changes.

    Args:
        state: M new clusters.
        floor: smallest standard deviation [m].
    """
    if not bool((state.kinds == 2).any()):
        return state
    values, axes = native.symmetric_axes(state.clusters.covariances)
    spread = values[:, -1]
    limit = torch.full_like(spread, torch.inf)
    for kind in (0, 2):
        rows = (state.kinds == kind).nonzero().squeeze(1)
        if len(rows):
            means = state.means[rows]
            extents = spread[rows].where(spread[rows] > 0, torch.inf)  # of single points: unknown
            around = extents[native.nearest_centers(means, means, AROUND)]
            limit[rows] = LARGEST**2 * around.median(dim=1).values
    rows = (spread > limit).nonzero().squeeze(1)
    values, axes = values[rows].minimum(limit[rows, None]), axes[rows]
    smaller = raw_factors(factor_covariances((axes * values[:, None]) @ axes.mT, floor))
    return replace(state, raw_scale_tril=state.raw_scale_tril.index_copy(0, rows, smaller))


def off_surfaces(points: Tensor, surfaces: Clusters, floor: float) -> Tensor:
    """(N, D) positions -> (N,) bool: not inside the nearest cluster of hits.

    Inside is within `INSIDE` standard deviations, and within `SURFACE` of its plane. At grazing
    incidence a place behind a hit still lies within the surface.

    Args:
        points: (N, D) positions [m].
        surfaces: occupied clusters; none: every point is off them.
        floor: smallest standard deviation [m].
    """
    if len(surfaces) == 0 or len(points) == 0:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    covariances = surfaces.covariances
    factors = factor_covariances(covariances, floor)
    normals = native.symmetric_axes(covariances)[1][:, :, 0]
    owner = native.nearest_centers(points, surfaces.means, 1).squeeze(1)
    offsets = points - surfaces.means[owner]
    whitened = torch.linalg.solve_triangular(factors[owner], offsets[:, :, None], upper=False)
    inside = whitened.squeeze(2).square().sum(dim=1) < INSIDE**2
    return ~(inside & ((offsets * normals[owner]).sum(dim=1).abs() < SURFACE))


def draw_tails(
    clusters: Clusters, is_occupied: Tensor, count: int, floor: float, rng: torch.Generator
) -> Tensor:
    """(count, D) positions in the tails of the clusters [m], more where these are large.

    Places are spread over space, not over clusters: a cluster is drawn as often as its volume says,
    half of them from the occupied ones, which are smaller.
    """
    dim = clusters.means.shape[1]
    covariances = clusters.covariances
    sizes = covariances.diagonal(dim1=1, dim2=2).sum(dim=1).sqrt() + floor
    volumes = sizes**dim
    for kind in (is_occupied, ~is_occupied):
        volumes[kind] /= volumes[kind].sum()
    bounds = volumes.double().cumsum(0)
    place = torch.rand(count, generator=rng, device=rng.device, dtype=torch.float64)
    place += torch.arange(count, device=rng.device)  # stratified
    chosen = torch.searchsorted(bounds, place.to(bounds) * (bounds[-1] / count))
    chosen.clamp_(max=len(volumes) - 1)
    factors = factor_covariances(covariances, floor)[chosen]
    shape = (count, dim)
    way = torch.randn(shape, generator=rng, device=rng.device).to(factors)
    low, high = TAILS
    far = low + (high - low) * torch.rand(count, 1, generator=rng, device=rng.device).to(factors)
    way *= far / torch.linalg.vector_norm(way, dim=1, keepdim=True)
    return clusters.means[chosen] + (factors @ way[:, :, None]).squeeze(2)


def settle_unknown(
    points: Tensor, labels: Tensor, state: MapState, kernel: Kernel, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The samples without unknown points inside surfaces, and with more in the clusters' tails.

    Samples without unknown points are returned as they are.

    Args:
        points: (N, D) positions [m], map frame, in Morton order.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        state: M clusters of these samples.
        kernel: of the map.
        rng: random state.

    Returns:
        (N', D) positions and (N',) labels; those in tails follow the others, each in Morton order.
    """
    is_unknown = labels == UNKNOWN
    if not bool(is_unknown.any()):
        return points, labels
    surfaces = Clusters(*(moments[state.is_occupied] for moments in state.clusters))
    rows = is_unknown.nonzero().squeeze(1)
    kept = ~is_unknown
    kept[rows] = off_surfaces(points[rows], surfaces, kernel.min_lengthscale)
    count = max(TAILS_PER_CLUSTER * len(state), len(points) // SAMPLES_PER_TAIL)
    tails = draw_tails(state.clusters, state.is_occupied, count, kernel.min_lengthscale, rng)
    index = native.build_index(state.centers, kernel.num_neighbors)
    parameters = (state.centers, state.raw_scale_tril, kernel, index)
    features = native.nearest_features(tails, *parameters)[1].amax(dim=1)
    (tails,) = in_morton_order(tails[features <= TAIL_FEATURE])
    labels = torch.cat([labels[kept], labels.new_full((len(tails),), UNKNOWN)])
    return torch.cat([points_where(points, kept), tails]), labels
