"""Mini-batch k-means: centers of clusters of points (Algorithm 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.learning.points import at_most
from lardhm_torch.native import nearest_centers
from lardhm_torch.sampling import spread_rows

START_POINTS = 50  # number of random points per center from which initial centers are chosen
ITERATIONS = 20  # t in Algorithm 1


def mini_batch_kmeans(
    points: Tensor,
    num_clusters: int,
    rng: torch.Generator,
    *,
    iterations: int = ITERATIONS,
    batch_size: int | None = None,
    restart_every: int = 5,
) -> Tensor:
    """Mini-batch k-means: centers with a small mean squared distance to the points.

    Each center is the running mean of the batch points assigned to it: a point moves its nearest
    center by the offset divided by the number of points assigned so far. There are two departures
    from Algorithm 1, each of which lowers the inertia by several percent: initial centers and batches
    are stratified samples in Morton order, and the counts are reset every ``restart_every``
    iterations, so that points assigned to an earlier position of a center are discarded.

    Args:
        points: (N, D) positions [m], in the order of `morton_order`; in any other order the
            result is valid, but less accurate.
        num_clusters: number of centers, at most N.
        rng: random generator of the initial centers and of the batches.
        iterations: t in Algorithm 1.
        batch_size: b in Algorithm 1; None: 10 points per center.
        restart_every: number of iterations between resets of the counts.

    Returns:
        (num_clusters, D) centers [m].

    Source: Guizilini & Ramos 2016, Algorithm 1.
    """
    batch_size = min(len(points), batch_size or 10 * num_clusters)
    centers = _stratified_start(points, num_clusters, rng)
    rows = spread_rows(len(points), batch_size, rng, iterations)
    if native.supports(points):
        return torch.ops.lardhm.kmeans(points, centers, rows, batch_size, restart_every)
    counts = torch.zeros(num_clusters, dtype=points.dtype, device=points.device)
    for iteration in range(iterations):
        if iteration % restart_every == 0:
            counts.zero_()
        batch = points[rows[iteration]]
        labels = nearest_centers(batch, centers, 1).squeeze(1)
        shifts = torch.zeros_like(centers).index_add_(0, labels, batch - centers[labels])
        counts += torch.bincount(labels, minlength=num_clusters)
        centers = centers + shifts / counts.clamp(min=1)[:, None]
    return centers


def _stratified_start(points: Tensor, num_clusters: int, rng: torch.Generator) -> Tensor:
    """Initial centers: stratified random points, with strata of equal length along the Morton order.

    The length of a step is the distance [m] between points that are a quarter of a cluster size
    apart in the order, so sparse regions receive more centers than in proportion to their points.
    The inertia is smallest for a density of centers between that of the points and a uniform one.
    """
    count = START_POINTS * num_clusters
    ordered = at_most(points, count, rng)
    if num_clusters >= len(ordered):
        return ordered
    lag = max(1, len(ordered) // (4 * num_clusters))
    gaps = torch.linalg.vector_norm(ordered[lag:] - ordered[:-lag], dim=1)
    ahead = torch.cat([gaps, gaps[-1:].expand(lag)])
    behind = torch.cat([gaps[:1].expand(lag), gaps])
    weight = torch.minimum(ahead, behind).double()
    along = (weight + 1e-6 * weight.mean() + 1e-300).cumsum(0)
    position = torch.rand(num_clusters, generator=rng, device=rng.device, dtype=torch.double)
    place = (torch.arange(num_clusters, device=rng.device) + position) / num_clusters * along[-1]
    return ordered[torch.searchsorted(along, place).clamp(max=len(ordered) - 1)]
