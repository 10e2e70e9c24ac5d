"""Points to clusters: where the features sit and how wide they are.

Mini-batch k-means (Algorithm 1) finds the centers; the mean and scatter of the points nearest to
each center are its moments (eq. 6, 7), which pool exactly when clusters merge.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.native import nearest_centers
from lardhm_torch.points import morton_order

POINTS_PER_CLUSTER = 15  # of the rule that chooses the number of clusters, where points are sparse
DENSE_POINTS = 35  # the same where they are dense, or clusters would fit the noise of the hits
CELL_EDGE, CELLS_PER_CLUSTER = 0.2, 4  # [m] of the cells that tell the two apart, and how
CELLS_PER_SCAN_CLUSTER = 1  # the same where more scans will follow: a single one shows less
MAX_CHOSEN = 5000  # a class
START_POINTS = 50  # a center, drawn at random, among which the start is chosen
ITERATIONS = 20  # of k-means: t of Algorithm 1
VOLUME_ITERATIONS = 5  # the same where clusters fill a volume beside an unknown one: they are many
FEW_POINTS = 64  # of a class whose points may each be a cluster: hits of a few beams
MIN_COUNT = 5  # smaller clusters are merged into their nearest neighbor (paper, Section IV-B)


class Columns:
    """A dataclass of tensors with as many rows each: iterates over them, in order."""

    def __iter__(self: Any) -> Iterator[Tensor]:
        """The tensors."""
        return (getattr(self, field.name) for field in fields(self))


@dataclass(frozen=True, eq=False)
class Clusters(Columns):
    """Moments of M clusters: enough to pool them, nothing that training changes.

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
    """At most ``num_clusters`` clusters of the points, none of fewer than five unless points are few.

    Args:
        points: (N, D) positions of one class [m], in the order of `morton_order`.
        num_clusters: how many to look for; at most `most_clusters` of N.
        rng: random state of the start and of the batches.
        iterations: of k-means.

    Source: Guizilini & Ramos 2016, Algorithm 1, eq. (6), (7) and Section IV-B.
    """
    num_clusters = max(1, min(num_clusters, most_clusters(len(points))))
    centers = mini_batch_kmeans(points, num_clusters, rng, iterations=iterations)
    _, counts, sums, scatters = native.assign(points, centers)
    min_count = min(MIN_COUNT, max(1, len(points) // num_clusters))
    clusters = merge_small(clusters_about(centers, counts, sums, scatters), min_count)
    # Neighbors in space are neighbors in memory: queries of large maps are faster.
    order = morton_order(clusters.means)
    return Clusters(*(moments[order] for moments in clusters))


def most_clusters(num_points: int) -> int:
    """How many clusters so many points of a class can have: five points each, a few points one."""
    return max(num_points // MIN_COUNT, _few(num_points))


def _few(num_points: int) -> int:
    """How many clusters of fewer than five points there may be: none from 2 `FEW_POINTS` on."""
    return max(0, min(num_points, 2 * FEW_POINTS - num_points))


def cluster_classes(
    points: Tensor, labels: Tensor, num_clusters: int | None, rng: torch.Generator
) -> tuple[Clusters, Tensor]:
    """Occupied and free points clustered apart, as the paper found to work better (Section II-B).

    Args:
        points: (N, D) positions [m], in the order of `morton_order`.
        labels: (N,) 1 occupied, 0 free.
        num_clusters: total over both classes; None: chosen from the data.
        rng: random state.

    Returns:
        (M clusters, the occupied ones first; (M,) bool, which are occupied).
    """
    classes = split_labels(points, labels)
    if num_clusters is None:
        chosen = choose_num_clusters(next(members for members in classes if len(members)))
        totals = [chosen * share for share in class_shares(len(classes[2]))]
    else:
        totals = split_clusters([len(members) for members in classes], num_clusters)
    return cluster_each(classes, totals, rng)


def class_shares(num_unknown: int) -> tuple[int, int, int]:
    """Clusters of the occupied, the free and the unknown points, in proportion.

    Free space that must end where the unknown begins takes twice as many clusters.
    """
    return (1, 2, 1) if num_unknown else (1, 1, 0)


def cluster_each(
    classes: list[Tensor], totals: Sequence[int], rng: torch.Generator
) -> tuple[Clusters, Tensor]:
    """(M clusters, (M,) bool which are occupied) of the points of each class, in order.

    Args:
        classes: (N, D) occupied, (F, D) free and, if given, (U, D) unknown positions [m], in the
            order of `morton_order`.
        totals: how many clusters of each to look for.
        rng: random state.
    """
    with_unknown = len(classes) > 2 and len(classes[2]) > 0
    rest = VOLUME_ITERATIONS if with_unknown else ITERATIONS
    parts = []
    for number, (members, total) in enumerate(zip(classes, totals, strict=True)):
        if len(members) and total:
            found = cluster_points(members, total, rng, rest if number else ITERATIONS)
            parts.append(of_unknown(found) if number == 2 else found)
    clusters = concatenate_clusters(parts)
    is_occupied = torch.zeros_like(clusters.counts, dtype=torch.bool)
    is_occupied[: len(parts[0]) if len(classes[0]) else 0] = True
    return clusters, is_occupied


def split_classes(points: Tensor, is_occupied: Tensor) -> list[Tensor]:
    """Occupied and free points; views where the occupied ones come first, as from `sample_rays`."""
    count = int(is_occupied.sum())
    if bool(is_occupied[:count].all()):
        return [points[:count], points[count:]]
    return [points_where(points, is_occupied), points_where(points, ~is_occupied)]


def split_labels(points: Tensor, labels: Tensor) -> list[Tensor]:
    """Occupied, free and unknown points, by labels of 1, 0 and 1/2."""
    occupied, rest = split_classes(points, labels > 0.5)
    if bool((labels != 0.5).all()):
        return [occupied, rest, rest[:0]]
    return [occupied, points_where(points, labels < 0.5), points_where(points, labels == 0.5)]


def of_unknown(clusters: Clusters) -> Clusters:
    """Clusters of unknown points: as wide, but they count nothing, and all that is seen replaces them."""
    return Clusters(torch.zeros_like(clusters.counts), clusters.means, clusters.covariances)


def points_where(points: Tensor, mask: Tensor) -> Tensor:
    """``points[mask]``, twice as fast."""
    return points.index_select(0, mask.nonzero().squeeze(1))


def concatenate_clusters(parts: list[Clusters]) -> Clusters:
    """All clusters of several, in order."""
    return Clusters(*map(torch.cat, zip(*parts, strict=True)))


def split_clusters(class_sizes: list[int], num_clusters: int) -> list[int]:
    """How many clusters each class gets: occupied, free and, where there are any, unknown points.

    By `class_shares`, what does not go round to the occupied class; a class that cannot fill its
    share (five points a cluster) leaves the rest to the others.
    """
    room = [most_clusters(size) for size in class_sizes]
    num_unknown = room[2] if len(room) > 2 else 0
    shares = class_shares(num_unknown)
    unknown = min(num_unknown, num_clusters * shares[2] // sum(shares))
    known = num_clusters - unknown
    fair = -(-known * shares[0] // (shares[0] + shares[1]))
    occupied = min(room[0], max(fair, known - room[1]))
    return [occupied, min(room[1], known - occupied), unknown][: len(room)]


def scan_clusters(classes: list[Tensor]) -> list[int]:
    """How many clusters of each class a scan makes in a place that the map does not know.

    As many as `choose_num_clusters` gives, but finer: other scans will fill the place up. Only where
    points are so dense that they share a cell with dozens of others are clusters coarser than
    `POINTS_PER_CLUSTER` asks for.

    Args:
        classes: (N, D) occupied and (F, D) free positions [m].
    """
    chosen = choose_num_clusters(classes[0] if len(classes[0]) else classes[1], fine=True)
    rooms = [most_clusters(len(members)) for members in classes]
    return [min(chosen, room) for room in rooms]


def choose_num_clusters(points: Tensor, *, fine: bool = False) -> int:
    """How many clusters `fit` makes of a class with these occupied points; of the free one as many.

    One for every `CELLS_PER_CLUSTER` cells with points in them, so that clusters are as fine as the
    scene is large; of at least `POINTS_PER_CLUSTER` points on average, or they would be starved and
    accuracy fall (paper, Section IV-B), and of at most `DENSE_POINTS`. Up to
    `FEW_POINTS` points in different cells may have a cluster each: a cluster of beams that end far
    apart would reach across the room. The number of free points says what the sampler was asked
    for, and nothing about the scene.

    Args:
        points: (N, D) positions [m].
        fine: one for every `CELLS_PER_SCAN_CLUSTER` cells instead.
    """
    cells = (points / CELL_EDGE).floor().long()
    strides = (1 << 21) ** torch.arange(cells.shape[1], device=cells.device)
    # neighbors mostly follow each other: what is left to sort is a fraction of the points
    count = len((cells * strides).sum(dim=1).unique_consecutive().unique())
    few = min(count, _few(len(points)))
    count = max(few, count // (CELLS_PER_SCAN_CLUSTER if fine else CELLS_PER_CLUSTER))
    finest = max(len(points) // POINTS_PER_CLUSTER, few)
    coarsest = len(points) // DENSE_POINTS
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


def mini_batch_kmeans(
    points: Tensor,
    num_clusters: int,
    rng: torch.Generator,
    *,
    iterations: int = ITERATIONS,
    batch_size: int | None = None,
    restart_every: int = 5,
) -> Tensor:
    """Centers that are near to all points on average.

    Every batch point pulls its nearest center by 1 / (number of points that pulled it so far); a
    whole batch at a time this is the running mean of all points a center has met. We depart from
    Algorithm 1 twice, because each lowers the inertia by several percent: the random points of the
    start and of the batches are spread along a space-filling curve, and the counters start anew
    every ``restart_every`` iterations, so that a center forgets the points it met on its way.

    Args:
        points: (N, D) positions [m], in the order of `morton_order`; in another order the result is
            as valid, but worse.
        num_clusters: how many, at most N.
        rng: random state of the start and of the batches.
        iterations: t of Algorithm 1.
        batch_size: b of Algorithm 1; None: 10 points a center.
        restart_every: iterations between fresh counters.

    Returns:
        (num_clusters, D) centers [m].

    Source: Guizilini & Ramos 2016, Algorithm 1.
    """
    batch_size = min(len(points), batch_size or 10 * num_clusters)
    centers = _stratified_start(points, num_clusters, rng)
    rows = spread_rows(len(points), batch_size, rng, iterations)
    if native.supports(points):
        return torch.ops.lardhm.kmeans(points, centers, rows, batch_size, restart_every)
    met = torch.zeros(num_clusters, dtype=points.dtype, device=points.device)
    for iteration in range(iterations):
        if iteration % restart_every == 0:
            met.zero_()
        batch = points[rows[iteration]]
        labels = nearest_centers(batch, centers, 1).squeeze(1)
        pulls = torch.zeros_like(centers).index_add_(0, labels, batch - centers[labels])
        met += torch.bincount(labels, minlength=num_clusters)
        centers = centers + pulls / met.clamp(min=1)[:, None]
    return centers


def _stratified_start(points: Tensor, num_clusters: int, rng: torch.Generator) -> Tensor:
    """Random points, one from each of m stretches of the order that are equally long in meters.

    A stretch is weighted by the distance between points a quarter of a cluster apart in the order:
    where points are sparse they are picked more often than their number says. Inertia is least
    at a density of centers between that of the points and uniform, and starts near it.
    """
    count = START_POINTS * num_clusters
    ordered = points[spread_rows(len(points), count, rng)] if len(points) > count else points
    if num_clusters >= len(ordered):
        return ordered
    lag = max(1, len(ordered) // (4 * num_clusters))
    gaps = torch.linalg.vector_norm(ordered[lag:] - ordered[:-lag], dim=1)
    ahead = torch.cat([gaps, gaps[-1:].expand(lag)])
    behind = torch.cat([gaps[:1].expand(lag), gaps])
    weight = torch.minimum(ahead, behind).double()
    along = (weight + 1e-6 * weight.mean() + 1e-300).cumsum(0)
    share = torch.rand(num_clusters, generator=rng, device=rng.device, dtype=torch.double)
    place = (torch.arange(num_clusters, device=rng.device) + share) / num_clusters * along[-1]
    return ordered[torch.searchsorted(along, place).clamp(max=len(ordered) - 1)]


def spread_rows(num_points: int, count: int, rng: torch.Generator, *times: int) -> Tensor:
    """(*times, count) random rows of N, ascending, one from each of ``count`` <= N equal stretches."""
    shape = (*times, count)
    place = torch.rand(shape, generator=rng, device=rng.device, dtype=torch.double)
    place += torch.arange(count, device=rng.device)
    return (place * (num_points / count)).long().clamp_(max=num_points - 1)


def clusters_about(centers: Tensor, counts: Tensor, sums: Tensor, scatters: Tensor) -> Clusters:
    """Clusters of the points that `native.assign` gave to each center.

    Args:
        centers: (M, D) what the moments are taken about [m].
        counts: (M,) number of points.
        sums: (M, D) sum of the offsets from the center [m].
        scatters: (M, D, D) sum of their outer products [m^2].

    Source: Guizilini & Ramos 2016, eq. (6), (7).
    """
    shift = sums / counts.clamp(min=1)[:, None]
    about_mean = scatters - sums[:, :, None] * shift[:, None, :]
    return Clusters(counts.long(), centers + shift, about_mean)


def pool_clusters(clusters: Clusters, groups: Tensor, num_groups: int) -> Clusters:
    """Clusters of one group become one, with the exact moments of all their points.

    The scatter about the common mean is the sum of the scatters plus n d d^T for every cluster's
    distance d from that mean.

    Args:
        clusters: M clusters.
        groups: (M,) group of each, 0 to num_groups - 1.
        num_groups: how many groups.
    """
    shares = clusters.counts.to(clusters.means.dtype)
    counts = clusters.counts.new_zeros(num_groups).index_add_(0, groups, clusters.counts)
    shape = (num_groups, clusters.means.shape[1])
    anchor = clusters.means.new_zeros(shape).index_copy_(0, groups, clusters.means)
    offsets = (clusters.means - anchor[groups]) * shares[:, None]
    shift = clusters.means.new_zeros(shape).index_add_(0, groups, offsets)
    means = anchor + shift / counts.clamp(min=1)[:, None]
    apart = clusters.means - means[groups]
    between = shares[:, None, None] * apart[:, :, None] * apart[:, None, :]
    scatters = between.new_zeros(*shape, shape[1]).index_add_(
        0, groups, clusters.scatters + between
    )
    return Clusters(counts, means, scatters)


def merge_small(clusters: Clusters, min_count: int = MIN_COUNT) -> Clusters:
    """Clusters of fewer than ``min_count`` points are pooled with their nearest large neighbor.

    Empty clusters go. Where every cluster is small, the largest takes all.

    Source: Guizilini & Ramos 2016, Section IV-B.
    """
    large = clusters.counts >= min_count
    if bool(large.all()):
        return clusters
    if not bool(large.any()):
        large[clusters.counts.argmax()] = True
    kept = large.nonzero().squeeze(1)
    groups = torch.empty_like(clusters.counts)
    groups[kept] = torch.arange(len(kept), device=kept.device)
    small = (~large).nonzero().squeeze(1)
    groups[small] = nearest_centers(clusters.means[small], clusters.means[kept], 1).squeeze(1)
    return pool_clusters(clusters, groups, len(kept))
