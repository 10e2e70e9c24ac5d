"""Assignment of points to existing clusters, in plain torch and in the native library."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import features, native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.map_state import factor_covariances


def kernels_near(
    centers: Tensor, raw_scale_tril: Tensor, kernel: Kernel, points: Tensor, stds: float
) -> Tensor:
    """Mask of the kernels whose bounding boxes intersect the bounding box of the points.

    Args:
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with log-transformed diagonals.
        kernel: covariance scale and minimum length scale.
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


def nearest_clusters(points: Tensor, clusters: Clusters, floor: float, radius: float) -> Tensor:
    """(N,) the cluster with the nearest mean, or -1 if the point is not within ``radius``.

    Args:
        points: (N, D) positions [m].
        clusters: M clusters.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        radius: Mahalanobis distance, in standard deviations of the cluster.
    """
    count = len(clusters)
    if count == 0 or len(points) == 0:
        return torch.full((len(points),), -1, device=points.device)
    if native.supports(points):
        return torch.ops.lardhm.nearest_clusters(points.detach(), *clusters, floor, radius).long()
    centers, factors = clusters.means, factor_covariances(clusters.covariances, floor)
    owners = features.nearest_centers(points, centers, 1).squeeze(1)
    offsets = (points - centers[owners])[:, :, None]
    whitened = torch.linalg.solve_triangular(factors[owners], offsets, upper=False)
    return torch.where(whitened.square().sum(dim=(1, 2)) <= radius**2, owners, -1)


def feature_sums(
    points: Tensor,
    centers: Tensor,
    raw_scale_tril: Tensor,
    wanted: Tensor,
    kernel: Kernel,
    index: Tensor,
) -> Tensor:
    """(M,) sum of the features of each wanted cluster over points, 0 for others.

    Args:
        points: (N, D) positions [m].
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with log-transformed diagonals.
        wanted: (M,) bool.
        kernel: k, covariance scale and minimum length scale.
        index: search index of the centers, see `native.build_index`.
    """
    if native.supports(points):
        given = (points, centers, raw_scale_tril, index)
        return torch.ops.lardhm.feature_sums(*(t.detach() for t in given), wanted, *kernel)
    found, values = native.nearest_features(points, centers, raw_scale_tril, kernel, index)
    sums = torch.zeros_like(centers[:, 0])
    return sums.index_add_(0, found.reshape(-1).long(), values.reshape(-1)) * wanted


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
        kernel: k, covariance scale and minimum length scale.
        index: search index of the centers, see `native.build_index`.
    """
    if native.supports(points):
        given = (points, order, centers, raw_scale_tril, index)
        return torch.ops.lardhm.ordered_features(*(t.detach() for t in given), *kernel)
    ordered = points.index_select(0, order)
    return native.nearest_features(ordered, centers, raw_scale_tril, kernel, index)
