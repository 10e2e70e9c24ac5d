"""What an update asks of many clusters or points at once: the definition, and its native twin."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import features, native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.clustering import Clusters, clusters_about, points_where
from lardhm_torch.learning.map_state import factor_covariances


def reaching(
    centers: Tensor, raw_scale_tril: Tensor, kernel: Kernel, points: Tensor, stds: float
) -> Tensor:
    """Which kernels reach into the box around points: along every axis, some standard deviations far.

    Args:
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with the logarithm of their diagonals.
        kernel: covariance scale and floor.
        points: (N, D) positions [m], at least one, finite.
        stds: how far a kernel is taken to reach, in its own standard deviations.

    Returns:
        (M,) bool.
    """
    if native.supports(centers):
        given = (t.detach() for t in (centers, raw_scale_tril, points))
        return torch.ops.lardhm.reaching(*given, stds, *kernel[1:])
    lower, upper = points.aminmax(dim=0)
    factors = features.kernel_factors(raw_scale_tril, kernel)
    reach = stds * torch.linalg.vector_norm(factors, dim=2)
    return ((centers + reach >= lower) & (centers - reach <= upper)).all(dim=1)


def explain(
    points: Tensor, clusters: Clusters, floor: float, radius: float, reach: float
) -> tuple[Tensor, Clusters]:
    """Every point to the cluster with the nearest mean, if it is near enough.

    Distances to decide whether it is near enough are in standard deviations of the cluster.

    Args:
        points: (N, D) positions [m].
        clusters: M of them, at least one.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        radius: nearer points join the cluster.
        reach: nearer points have an owner; not less than ``radius``.

    Returns:
        (N,) int owners, M for a point without one; the moments of the points that join each of the
        clusters, of none the cluster's own mean and no scatter. Sums are taken in float64.
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
    found = clusters_about(centers.double(), *moments)
    return owners, Clusters(found.counts, found.means.to(centers), found.scatters.to(centers))


def possibly_inside(points: Tensor, clusters: Clusters, floor: float, radius: float) -> Tensor:
    """(P, D) the points that can lie inside some cluster: all that do, in their order, and others.

    Asking only them where the points lie saves most of the time.

    Args:
        points: (N, D) positions [m].
        clusters: M of them.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        radius: standard deviations within which a point is inside.
    """
    if native.supports(points):
        return torch.ops.lardhm.possibly_inside(points.detach(), *clusters, floor, radius)
    return points if len(clusters) else points[:0]


def unexplained(points: Tensor, owners: Tensor, kept: Tensor) -> Tensor:
    """(R, D) the points that no kept cluster owns, in their order.

    Args:
        points: (N, D) positions [m].
        owners: (N,) of `explain`.
        kept: (M,) bool, which clusters keep the points that they own.
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
    """`native.nearest_features` of ``points[order]``, searched in the order of the points.

    Neighbors that follow each other are found faster than those far apart, as in batches. The columns
    of a row come in any order, the same for indices and values.

    Args:
        points: (N, D) positions [m].
        order: (N,) every row once.
        centers: (M, D) cluster centers [m].
        raw_scale_tril: (M, D, D) factors with the logarithm of their diagonals.
        kernel: k, covariance scale and floor.
        index: of the centers, see `native.build_index`.
    """
    if native.supports(points):
        given = (points, order, centers, raw_scale_tril, index)
        return torch.ops.lardhm.ordered_features(*(t.detach() for t in given), *kernel)
    ordered = points.index_select(0, order)
    return native.nearest_features(ordered, centers, raw_scale_tril, kernel, index)
