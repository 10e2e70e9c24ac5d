"""Assignment of points to existing clusters, in plain torch and in the native library."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import features, native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.clustering import Clusters, clusters_from_moments, points_where
from lardhm_torch.learning.map_state import factor_covariances


def kernels_near(
    centers: Tensor, raw_scale_tril: Tensor, kernel: Kernel, points: Tensor, stds: float
) -> Tensor:
    """Mask of the kernels whose bounding boxes intersect the bounding box of the points.

    Args:
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with log-transformed diagonals.
        kernel: covariance scale and minimum length-scale.
        points: (N, D) positions [m], at least one, finite.
        stds: half-width of the bounding box of a kernel, in its standard deviations.

    Returns:
        (M,) bool.
    """
    if native.supports(centers):
        given = (t.detach() for t in (centers, raw_scale_tril, points))
        return torch.ops.lardhm.reaching(*given, stds, *kernel[1:])
    lower, upper = points.aminmax(dim=0)
    factors = features.kernel_factors(raw_scale_tril, kernel)
    half_width = stds * torch.linalg.vector_norm(factors, dim=2)
    return ((centers + half_width >= lower) & (centers - half_width <= upper)).all(dim=1)


def explain(
    points: Tensor, clusters: Clusters, floor: float, radius: float, reach: float
) -> tuple[Tensor, Clusters]:
    """Assign every point to the cluster with the nearest mean, if it is within the given radii.

    The radii are Mahalanobis distances, in standard deviations of the cluster.

    Args:
        points: (N, D) positions [m].
        clusters: M clusters, at least one.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        radius: points within it join the cluster.
        reach: points within it are owned by the cluster; at least ``radius``.

    Returns:
        (N,) int owner of each point, M for points without an owner; and the moments of the points
        that join each cluster, accumulated in float64. A cluster that no point joins has count 0,
        its own mean and scatter 0.
    """
    if native.supports(points):
        rule = (floor, radius, reach)
        owners, *moments = torch.ops.lardhm.explain(points.detach(), *clusters, *rule)
        return owners, Clusters(*moments)
    centers, factors = clusters.means, factor_covariances(clusters.covariances, floor)
    count, dim = centers.shape
    owners = torch.full((len(points),), count, device=points.device)
    moments = [centers.new_zeros(count, *[dim] * power, dtype=torch.float64) for power in range(3)]
    for rows in torch.arange(len(points), device=points.device).split(features.QUERY_CHUNK):
        chunk = points[rows]
        owner = features.nearest_centers(chunk, centers, 1).squeeze(1)
        offsets = (chunk - centers[owner])[:, :, None]
        whitened = torch.linalg.solve_triangular(factors[owner], offsets, upper=False)
        squared = whitened.square().sum(dim=(1, 2))
        owners[rows[squared <= reach**2]] = owner[squared <= reach**2]
        joins = squared <= radius**2
        owner, offset = owner[joins], offsets[joins, :, 0].double()
        moments[0].index_add_(0, owner, torch.ones_like(offset[:, 0]))
        moments[1].index_add_(0, owner, offset)
        moments[2].index_add_(0, owner, offset[:, :, None] * offset[:, None])
    found = clusters_from_moments(centers.double(), *moments)
    return owners, Clusters(found.counts, found.means.to(centers), found.scatters.to(centers))


def inside_candidates(points: Tensor, clusters: Clusters, floor: float, radius: float) -> Tensor:
    """(P, D) candidate points that may lie inside some cluster, in order.

    This fast prefilter keeps all points that lie inside a cluster, and possibly others.

    Args:
        points: (N, D) positions [m].
        clusters: M clusters.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        radius: points within this Mahalanobis distance are inside.
    """
    if native.supports(points):
        return torch.ops.lardhm.possibly_inside(points.detach(), *clusters, floor, radius)
    return points if len(clusters) else points[:0]


def unexplained(points: Tensor, owners: Tensor, kept: Tensor) -> Tensor:
    """(R, D) points that are not owned by a kept cluster, in order.

    Args:
        points: (N, D) positions [m].
        owners: (N,) owners returned by `explain`.
        kept: (M,) bool, clusters that keep their points.
    """
    if native.supports(points):
        return torch.ops.lardhm.unexplained(points.detach(), owners, kept)
    left_out = torch.cat([~kept, kept.new_ones(1)])
    return points_where(points, left_out.index_select(0, owners))


def ordered_features(
    points: Tensor,
    order: Tensor,
    centers: Tensor,
    raw_scale_tril: Tensor,
    kernel: Kernel,
    index: Tensor,
) -> tuple[Tensor, Tensor]:
    """`native.nearest_features` of ``points[order]``, computed in the order of ``points``.

    The search is faster if consecutive points are close to each other, which is not the case in
    batches. The order of the columns in a row is unspecified, but equal in indices and values.

    Args:
        points: (N, D) positions [m].
        order: (N,) permutation of the rows.
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with log-transformed diagonals.
        kernel: k, covariance scale and minimum length-scale.
        index: search index of the centers, see `native.build_index`.
    """
    if native.supports(points):
        given = (points, order, centers, raw_scale_tril, index)
        return torch.ops.lardhm.ordered_features(*(t.detach() for t in given), *kernel)
    ordered = points.index_select(0, order)
    return native.nearest_features(ordered, centers, raw_scale_tril, kernel, index)
