"""Clustering of points: centers and covariances of the features.

Mini-batch k-means (Algorithm 1) finds the centers. The moments of a cluster are the mean and scatter
of the points nearest to its center (eq. 6, 7). The moments of merged clusters are exact.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.learning.kmeans import ITERATIONS, mini_batch_kmeans
from lardhm_torch.learning.points import count_cells, morton_order
from lardhm_torch.native import nearest_centers

POINTS_PER_CLUSTER = 15  # minimum mean number of points per cluster in `choose_num_clusters`
DENSE_POINTS = 35  # maximum, for dense points: smaller clusters would fit the noise
CELL_EDGE, CELLS_PER_CLUSTER = 0.2, 4  # [m] grid cells, and occupied cells per cluster
CELLS_PER_SCAN_CLUSTER = 1  # the same in `scan_clusters`
MAX_CHOSEN = 5000  # upper bound per class in `choose_num_clusters`
# iterations of k-means, of occupied points, and of free and unknown points if there are unknown ones
ITERATIONS_OF = (15, 5)
ROUGH_ITERATIONS = (8, 3)  # the same if centers and length scales are trained afterwards
FEW_POINTS = 64  # classes up to this size may have one cluster per point
MIN_COUNT = 5  # smaller clusters are merged into their nearest neighbor (paper, Section IV-B)


class Columns:
    """Base class of dataclasses of tensors with equally many rows. Iteration yields the tensors."""

    def __iter__(self: Any) -> Iterator[Tensor]:
        """Iterate over the tensors, in the order of the fields."""
        return (getattr(self, field.name) for field in fields(self))


@dataclass(frozen=True, eq=False)
class Clusters(Columns):
    """Moments of M clusters. They suffice to merge clusters, and training does not change them.

    Args:
        counts: (M,) int64 number of points.
        means: (M, D) mean position [m], eq. (6).
        scatters: (M, D, D) sum of outer products of the offsets from the mean [m^2].
    """

    counts: Tensor
    means: Tensor
    scatters: Tensor

    def __len__(self) -> int:
        """Number of clusters M."""
        return len(self.counts)

    @property
    def covariances(self) -> Tensor:
        """(M, D, D) sample covariances [m^2], eq. (7); zero for a single point."""
        return self.scatters / (self.counts - 1).clamp(min=1)[:, None, None]


def cluster_points(
    points: Tensor, num_clusters: int, rng: torch.Generator, iterations: int = ITERATIONS
) -> Clusters:
    """Cluster the points of one class into at most ``num_clusters`` clusters.

    Clusters of fewer than `MIN_COUNT` points are merged, unless there are only few points.

    Args:
        points: (N, D) positions of one class [m], in the order of `morton_order`.
        num_clusters: number of clusters to find; reduced to `most_clusters` of N.
        rng: random generator of the initial centers and of the batches.
        iterations: number of k-means iterations.

    Source: Guizilini & Ramos 2016, Algorithm 1, eq. (6), (7) and Section IV-B.
    """
    return grouped_points(points, num_clusters, rng, iterations)[0]


def grouped_points(
    points: Tensor, num_clusters: int, rng: torch.Generator, iterations: int = ITERATIONS
) -> tuple[Clusters, Tensor]:
    """The clusters of `cluster_points`, and (N,) int32 the cluster of each point."""
    num_clusters = max(1, min(num_clusters, most_clusters(len(points))))
    centers = mini_batch_kmeans(points, num_clusters, rng, iterations=iterations)
    labels, counts, sums, scatters = native.assign(points, centers)
    min_count = min(MIN_COUNT, max(1, len(points) // num_clusters))
    clusters = clusters_from_moments(centers, counts, sums, scatters)
    clusters, groups = merge_small(clusters, min_count)
    # Clusters that are close in space are close in memory, so queries of large maps are faster.
    order = morton_order(clusters.means)
    place = torch.empty_like(order, dtype=torch.int32)
    place[order] = torch.arange(len(order), dtype=torch.int32, device=order.device)
    owners = place[groups].index_select(0, labels)
    return Clusters(*(moments[order] for moments in clusters)), owners


def most_clusters(num_points: int) -> int:
    """Maximum number of clusters of a class: one per `MIN_COUNT` points, or per point if few."""
    return max(num_points // MIN_COUNT, max_singletons(num_points))


def max_singletons(num_points: int) -> int:
    """Number of clusters that may be smaller than `MIN_COUNT`; 0 from 2 `FEW_POINTS` points on."""
    return max(0, min(num_points, 2 * FEW_POINTS - num_points))


def cluster_classes(
    points: Tensor,
    labels: Tensor,
    num_clusters: int | Sequence[int] | None,
    rng: torch.Generator,
) -> tuple[Clusters, Tensor]:
    """Cluster occupied, free and unknown points separately, as the paper does (Section II-B).

    Args:
        points: (N, D) positions [m], in the order of `morton_order`.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        num_clusters: total over all classes, or one number for each class; None: chosen from the
            data.
        rng: random generator.

    Returns:
        M clusters, occupied ones first, and an (M,) bool mask of the occupied ones.
    """
    return group_classes(points, labels, num_clusters, rng)[:2]


class Grouped(NamedTuple):
    """Clusters of the points of several classes."""

    clusters: Clusters  # M clusters, those of the occupied points first
    is_occupied: Tensor  # (M,) bool
    classes: list[Tensor]  # (N, D) points of each class
    owners: list[Tensor]  # (N,) int32 their clusters, among those of the class
    numbers: list[int]  # of clusters of each class


def group_classes(
    points: Tensor,
    labels: Tensor,
    num_clusters: int | Sequence[int] | None,
    rng: torch.Generator,
    iterations: tuple[int, int] = ITERATIONS_OF,
) -> Grouped:
    """The clusters of `cluster_classes`, and which points belong to each."""
    classes = split_labels(points, labels)
    if num_clusters is None:
        chosen = choose_num_clusters(next(members for members in classes if len(members)))
        totals = [chosen * ratio for ratio in class_ratios(len(classes[2]))]
    elif isinstance(num_clusters, Sequence):
        totals = list(num_clusters)
    else:
        totals = split_clusters([len(members) for members in classes], num_clusters)
    return cluster_each(classes, totals, rng, iterations)


def class_ratios(num_unknown: int) -> tuple[int, int, int]:
    """Relative numbers of clusters of occupied, free and unknown points.

    With unknown points, free space gets twice as many clusters, because it must end where unknown
    space begins.
    """
    return (1, 2, 1) if num_unknown else (1, 1, 0)


def cluster_each(
    classes: list[Tensor],
    totals: Sequence[int],
    rng: torch.Generator,
    iterations: tuple[int, int] = ITERATIONS_OF,
) -> Grouped:
    """Cluster each class.

    Args:
        classes: (N, D) occupied, (F, D) free and, if given, (U, D) unknown positions [m], in the
            order of `morton_order`.
        totals: number of clusters to find in each class.
        rng: random generator.
        iterations: of k-means, see `ITERATIONS_OF`.
    """
    with_unknown = len(classes) > 2 and len(classes[2]) > 0
    parts, owners, numbers = [], [], []
    for kind, (members, total) in enumerate(zip(classes, totals, strict=True)):
        numbers.append(0)
        owners.append(torch.full_like(members[:, 0], -1, dtype=torch.int32))
        if len(members) and total:
            turns = iterations[1 if kind and with_unknown else 0]
            found, owners[kind] = grouped_points(members, total, rng, turns)
            numbers[kind] = len(found)
            parts.append(unknown_clusters(found) if kind == 2 else found)
    clusters = concatenate_clusters(parts)
    is_occupied = torch.zeros_like(clusters.counts, dtype=torch.bool)
    is_occupied[: numbers[0]] = True
    return Grouped(clusters, is_occupied, classes, owners, numbers)


def split_classes(points: Tensor, is_occupied: Tensor) -> list[Tensor]:
    """Occupied and free points. Views if occupied points come first, as from `sample_rays`."""
    count = int(is_occupied.sum())
    if bool(is_occupied[:count].all()):
        return [points[:count], points[count:]]
    return [points_where(points, is_occupied), points_where(points, ~is_occupied)]


def split_labels(points: Tensor, labels: Tensor) -> list[Tensor]:
    """Occupied, free and unknown points (labels 1, 0 and 1/2)."""
    if bool((labels != 0.5).all()):
        return [*split_classes(points, labels > 0.5), points[:0]]
    return [points_where(points, labels == label) for label in (1, 0, 0.5)]


def unknown_clusters(clusters: Clusters) -> Clusters:
    """The same clusters with count 0 and their covariances as scatters, for unknown points.

    They do not contribute to the counts and means of clusters that they are pooled with.
    """
    return Clusters(torch.zeros_like(clusters.counts), clusters.means, clusters.covariances)


def points_where(points: Tensor, mask: Tensor) -> Tensor:
    """``points[mask]``, but about twice as fast."""
    return points.index_select(0, mask.nonzero().squeeze(1))


def concatenate_clusters(parts: list[Clusters]) -> Clusters:
    """Concatenate clusters, in order."""
    return Clusters(*map(torch.cat, zip(*parts, strict=True)))


def split_clusters(class_sizes: list[int], num_clusters: int) -> list[int]:
    """Number of clusters of the occupied, the free and, if given, the unknown class.

    The total is divided in the ratio of `class_ratios`, rounded in favor of the occupied class. If a
    class has too few points (see `most_clusters`), the remainder goes to the other classes.
    """
    most = [most_clusters(size) for size in class_sizes]
    num_unknown = most[2] if len(most) > 2 else 0
    ratios = class_ratios(num_unknown)
    unknown = min(num_unknown, num_clusters * ratios[2] // sum(ratios))
    known = num_clusters - unknown
    target = -(-known * ratios[0] // (ratios[0] + ratios[1]))
    occupied = min(most[0], max(target, known - most[1]))
    return [occupied, min(most[1], known - occupied), unknown][: len(most)]


def scan_clusters(classes: list[Tensor]) -> list[int]:
    """Number of clusters of each class above which `StreamConfig.max_clusters` limits a scan.

    This is the number given by `choose_num_clusters` with ``fine=True``. Clusters have more than
    `POINTS_PER_CLUSTER` points only where points are so dense that dozens of them lie in one cell.

    Args:
        classes: (N, D) occupied and (F, D) free positions [m].
    """
    chosen = choose_num_clusters(classes[0] if len(classes[0]) else classes[1], fine=True)
    limits = [most_clusters(len(members)) for members in classes]
    return [min(chosen, limit) for limit in limits]


def choose_num_clusters(
    points: Tensor, *, fine: bool = False, represented: int = 0, share: float = 1.0
) -> int:
    """Number of clusters per class that `fit` uses for these occupied points.

    The number is one per `CELLS_PER_CLUSTER` cells that contain points, so it is proportional to the
    observed surface. It is bounded so that clusters have at least `POINTS_PER_CLUSTER` points on
    average, because accuracy drops with fewer (paper, Section IV-B), and at most `DENSE_POINTS`. Up
    to `FEW_POINTS` points in different cells may have a cluster each, because a cluster of hits that
    are far apart would extend across the room. The numbers for the free and unknown classes follow
    from it (`class_ratios`), because the number of free points depends on the sampler, not on the
    scene.

    Args:
        points: (N, D) positions [m].
        fine: use one cluster per `CELLS_PER_SCAN_CLUSTER` cells instead.
        represented: number of points that these represent; 0: themselves.
        share: of all points of the map, for a part of it: dense points of all parts have at most
            `MAX_CHOSEN` clusters together.
    """
    size = represented or len(points)
    count = count_cells(points, CELL_EDGE)
    few = min(count, max_singletons(size))
    count = max(few, count // (CELLS_PER_SCAN_CLUSTER if fine else CELLS_PER_CLUSTER))
    finest = max(size // POINTS_PER_CLUSTER, few)
    coarsest = min(size // DENSE_POINTS, int(share * MAX_CHOSEN))
    return max(1, min(max(count, coarsest), finest, MAX_CHOSEN))


def check_num_clusters(num_clusters: int | None) -> None:
    """Raise a ValueError if the number of clusters is neither None nor a positive integer."""
    if num_clusters is None:
        return
    whole = isinstance(num_clusters, numbers.Integral) and not isinstance(num_clusters, bool)
    if not whole or num_clusters < 1:
        raise ValueError(
            f"num_clusters must be a whole number, 1 or more, or None; got {num_clusters!r}"
        )


def clusters_from_moments(
    centers: Tensor, counts: Tensor, sums: Tensor, scatters: Tensor
) -> Clusters:
    """Clusters from the moments about the centers that `native.assign` returns.

    Args:
        centers: (M, D) reference positions of the moments [m].
        counts: (M,) number of points.
        sums: (M, D) sums of the offsets from the center [m].
        scatters: (M, D, D) sums of their outer products [m^2].

    Source: Guizilini & Ramos 2016, eq. (6), (7).
    """
    shift = sums / counts.clamp(min=1)[:, None]
    about_mean = scatters - sums[:, :, None] * shift[:, None, :]
    return Clusters(counts.long(), centers + shift, about_mean)


def pool_clusters(clusters: Clusters, groups: Tensor, num_groups: int) -> Clusters:
    """Merge the clusters of each group into one, with the exact moments of all their points.

    The scatter about the common mean is the sum of the scatters plus n d d^T for every cluster of n
    points, where d is the offset of its mean from the common mean.

    Args:
        clusters: M clusters.
        groups: (M,) group of each cluster, 0 to num_groups - 1.
        num_groups: number of groups.
    """
    sizes = clusters.counts.to(clusters.means.dtype)
    counts = clusters.counts.new_zeros(num_groups).index_add_(0, groups, clusters.counts)
    shape = (num_groups, clusters.means.shape[1])
    anchor = clusters.means.new_zeros(shape).index_copy_(0, groups, clusters.means)
    offsets = (clusters.means - anchor[groups]) * sizes[:, None]
    shift = clusters.means.new_zeros(shape).index_add_(0, groups, offsets)
    means = anchor + shift / counts.clamp(min=1)[:, None]
    apart = clusters.means - means[groups]
    between = sizes[:, None, None] * apart[:, :, None] * apart[:, None, :]
    scatters = between.new_zeros(*shape, shape[1]).index_add_(
        0, groups, clusters.scatters + between
    )
    return Clusters(counts, means, scatters)


def merge_small(clusters: Clusters, min_count: int = MIN_COUNT) -> tuple[Clusters, Tensor]:
    """Merge clusters of fewer than ``min_count`` points into their nearest large neighbor.

    Empty clusters are removed. If all clusters are small, they are merged into the largest.

    Returns:
        The clusters that are left, and (M,) which of them each given one belongs to.

    Source: Guizilini & Ramos 2016, Section IV-B.
    """
    large = clusters.counts >= min_count
    if bool(large.all()):
        return clusters, torch.arange(len(clusters), device=large.device)
    if not bool(large.any()):
        large[clusters.counts.argmax()] = True
    kept = large.nonzero().squeeze(1)
    groups = torch.empty_like(clusters.counts)
    groups[kept] = torch.arange(len(kept), device=kept.device)
    small = (~large).nonzero().squeeze(1)
    groups[small] = nearest_centers(clusters.means[small], clusters.means[kept], 1).squeeze(1)
    return pool_clusters(clusters, groups, len(kept)), groups
