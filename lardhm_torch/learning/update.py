"""Incremental update with one more scan: Algorithm 2, and a default rule with bounded growth.

Algorithm 2 clusters the new points and merges new clusters with old ones. Two independent partitions
of a surface rarely have centers within one standard deviation of each other, so the map grows with
every scan of the same place. By default, new points are therefore assigned directly to nearby clusters
of their class, and only the remaining points are clustered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import explain, kernels_near, unexplained
from lardhm_torch.learning.cluster_matching import (
    append_clusters,
    merge_clusters,
    pool_into,
    take_clusters,
    whitened,
)
from lardhm_torch.learning.clustering import (
    MIN_COUNT,
    Clusters,
    cluster_classes,
    cluster_points,
    scan_clusters,
    split_classes,
    split_clusters,
)
from lardhm_torch.learning.fitting import FitConfig
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.replay import (
    contradicted,
    decay_evidence,
    hit_clusters,
    join_evidence,
    learn,
    neighborhood,
    new_evidence,
    replay_evidence,
    spread_points,
)
from lardhm_torch.points import in_morton_order

COVERED_FRACTION = 0.36  # a scan covers a cluster if its points have this fraction of the variance
FREE_FACTOR = 2.0  # factor on `UpdateConfig.crowded` for free clusters, which may be coarser
BOX_STDS = 2.0  # half-width of a kernel, in standard deviations, to select clusters near a scan
CHECKED_POINTS = 4  # number of free points checked for contradictions, relative to max_points
# Pseudo-samples already contain the class weight of `fit`, so the classes get equal weights here.
UPDATE_FIT = FitConfig(batch_size=1024, l2=0.01, occupied_share=0.5)


@dataclass(frozen=True, kw_only=True)
class UpdateConfig:
    """Settings of an incremental update. Radii are in standard deviations of a cluster."""

    as_in_paper: bool = False  # cluster all new points and merge the clusters by Algorithm 2
    zeta: float = 1.0  # [m] maximum distance of merged clusters in Algorithm 2
    radius: float = 3.0  # points within it of the nearest center of their class join the cluster
    reach: float = 4.0  # only points beyond it form new clusters
    fringe: float = 2.0  # new clusters with an old center within it are discarded
    refine: float = 1.3  # clusters whose ratio of new to old points exceeds this are split
    crowded: float = 8.0  # for that rule, the old count is capped at this times the usual count
    max_points: int = 20_000  # random points used to train the weights; clusters use all points
    replay: int = 8  # pseudo-samples per old cluster; 0: train on new points only
    memory: float = 800.0  # upper bound on the weight of the old points of a cluster
    fit: FitConfig = UPDATE_FIT

    def __post_init__(self) -> None:
        if not 0 < self.radius <= self.reach:
            raise ValueError(
                f"radius and reach must satisfy 0 < radius <= reach; got {self.radius} "
                f"and {self.reach}"
            )
        if not (self.zeta > 0 and self.fringe >= 0 and self.refine > 0 and self.memory > 0):
            raise ValueError(
                "zeta, refine and memory must be > 0 and fringe 0 or more; got "
                f"{self.zeta}, {self.refine}, {self.memory} and {self.fringe}"
            )
        if not self.crowded >= 2:
            raise ValueError(f"crowded must be 2 or more; got {self.crowded}")
        if self.max_points < 1 or self.replay < 0:
            raise ValueError(
                "max_points must be 1 or more and replay 0 or more; "
                f"got {self.max_points} and {self.replay}"
            )


class Task(NamedTuple):
    """Settings and random generator of an update."""

    kernel: Kernel
    config: UpdateConfig
    rng: torch.Generator


def updated(
    state: MapState, points: Tensor, labels: Tensor, num_clusters: int | None, task: Task
) -> tuple[Tensor, MapState]:
    """Update clusters and weights with one more scan.

    Only clusters near the points are processed, so the cost does not grow with the map. Existing
    clusters keep their rows, and new clusters are appended.

    Args:
        state: M clusters.
        points: (N, D) new positions, map frame [m].
        labels: (N,) 1 occupied, 0 free.
        num_clusters: total over both classes for a scan of an unmapped place; None: chosen from the
            data.
        task: kernel, settings, random generator.

    Returns:
        (Q,) rows of the clusters near the points; and the updated clusters in that order, followed
        by the new clusters.

    Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
    """
    near = kernels_near(state.centers, state.raw_scale_tril, task.kernel, points, BOX_STDS)
    nearby = near.nonzero().squeeze(1)
    known = state.rows(nearby)
    classes = split_classes(points, labels > 0.5)
    if task.config.as_in_paper:
        points, labels = in_morton_order(points, labels)
        new, is_occupied = cluster_classes(points, labels, num_clusters, task.rng)
        part = merge_clusters(
            known, new, is_occupied, task.config.zeta, task.kernel.min_lengthscale
        )
        hit = hit_clusters(known, classes[0], task.kernel.min_lengthscale)
    else:
        part, hit = _grown(known, classes, num_clusters, task)
    return nearby, _train(part, known, classes, hit, task)


def _grown(
    known: MapState, classes: list[Tensor], num_clusters: int | None, task: Task
) -> tuple[MapState, Tensor]:
    """Known clusters pooled with new points, followed by new clusters; and a mask of those hit."""
    if num_clusters is None:
        totals = scan_clusters(classes)
    else:
        totals = split_clusters([len(members) for members in classes], num_clusters)
    part, hit = known, torch.zeros_like(known.is_occupied)
    for kind, members, total in zip((True, False), classes, totals, strict=True):
        if total:
            part, joined = absorb(part, members, kind, total, task)
            hit = hit.index_fill(0, joined, True) if kind else hit
    return part, hit


def _train(
    part: MapState, known: MapState, classes: list[Tensor], hit: Tensor, task: Task
) -> MapState:
    """Train the weights on the new points and on pseudo-samples of nearby clusters.

    Args:
        part: updated clusters near the scan, followed by new ones.
        known: Q clusters near the scan, before the update.
        classes: (N, D) occupied and (F, D) free new points [m].
        hit: (Q,) bool, known clusters that contain new hits.
        task: kernel, settings, random generator.
    """
    config, kernel, rng = task.config, task.kernel, task.rng
    index = native.build_index(part.centers, kernel.num_neighbors)
    new = new_evidence(classes, config.max_points, rng)
    if not config.replay or len(known) == 0:
        learned = learn(part, join_evidence(new), kernel, index, config.fit, rng)
        return replace(part, weights=learned)
    changed = torch.ones_like(part.is_occupied)
    changed[: len(known)] = (part.means[: len(known)] != known.means).any(dim=1)
    moving = neighborhood(changed, part.centers, kernel.num_neighbors, index)
    rows = moving[: len(known)].nonzero().squeeze(1)
    num_checked = CHECKED_POINTS * config.max_points
    passed = spread_points(classes[1], num_checked, rng)
    bound = contradicted(known, hit, len(classes[0]), passed, kernel.min_lengthscale)
    strength = known.counts.clamp(max=config.memory).to(bound).minimum(bound)[rows]
    strength = (strength / config.replay)[:, None].expand(-1, config.replay)
    old = replay_evidence(known, rows, kernel, strength, rng)
    learned = learn(part, join_evidence([*new, old]), kernel, index, config.fit, rng)
    return replace(
        decay_evidence(part, bound, config.memory),
        weights=torch.where(moving, learned, part.weights),
    )


def absorb(
    part: MapState, points: Tensor, is_occupied: bool, num_clusters: int, task: Task
) -> tuple[MapState, Tensor]:
    """Assign points of one class to nearby clusters; cluster the remaining points.

    Args:
        part: clusters near the scan, of both classes.
        points: (N, D) new points of one class [m].
        is_occupied: class of the points.
        num_clusters: number of clusters for all points; reduced in proportion to the points that
            remain.
        task: kernel, settings, random generator.

    Returns:
        Updated clusters ``part``, followed by new ones; and the rows of clusters that contain new
        points.
    """
    floor = task.kernel.min_lengthscale
    own = (part.is_occupied == is_occupied).nonzero().squeeze(1)
    known = part.rows(own)
    assignment = _assign(known, points, len(points) / num_clusters, task)
    pooled = (assignment.found.counts > 0).nonzero().squeeze(1)
    part = pool_into(part, own[pooled], take_clusters(assignment.found, pooled), floor)
    joined = torch.cat([own[pooled], own[assignment.too_coarse]])
    if len(assignment.rest) < MIN_COUNT:
        return part, joined
    (rest,) = in_morton_order(assignment.rest)
    num_new = -(-num_clusters * len(rest) // len(points))
    new = cluster_points(rest, num_new, task.rng)
    new, where = _select_new(known, new, assignment, task)
    kinds = torch.full((len(new),), is_occupied, device=points.device)
    return append_clusters(part, new, kinds, floor, own[where]), joined


class _Assignment(NamedTuple):
    """Assignment of new points to known clusters.

    ``found`` holds the moments of the points that join each cluster. ``too_coarse`` masks the clusters
    that are too coarse for the scan, and ``covered`` those of them that the scan covers completely.
    ``rest`` holds the points of too coarse clusters, and the points without a nearby cluster.
    """

    rest: Tensor
    found: Clusters
    too_coarse: Tensor
    covered: Tensor


def _assign(known: MapState, points: Tensor, usual_count: float, task: Task) -> _Assignment:
    config, clusters = task.config, known.clusters
    if len(known) == 0:
        return _Assignment(points, clusters, known.is_occupied, known.is_occupied)
    rule = (task.kernel.min_lengthscale, config.radius, config.reach)
    owners, found = explain(points, clusters, *rule)
    # Cap the count, so that a cluster that grew over many scans can still be found to be too coarse.
    most = config.crowded if bool(known.is_occupied[0]) else FREE_FACTOR * config.crowded
    past = clusters.counts.clamp(2 * usual_count, most * usual_count)
    too_coarse = found.counts > config.refine * past
    covered = too_coarse & (_spread(found) > COVERED_FRACTION * _spread(clusters))
    found = Clusters(found.counts * ~too_coarse, found.means, found.scatters)
    return _Assignment(unexplained(points, owners, ~too_coarse), found, too_coarse, covered)


def _spread(clusters: Clusters) -> Tensor:
    """(M,) total variance of each cluster [m^2]."""
    total = clusters.scatters.diagonal(dim1=1, dim2=2).sum(dim=1)
    return total / clusters.counts.clamp(min=1)


def _select_new(
    known: MapState, new: Clusters, assignment: _Assignment, task: Task
) -> tuple[Clusters, Tensor]:
    """Select and order the new clusters, and return the rows that the first of them replace.

    A new cluster close to an old center lies at the boundary of an old cluster and is discarded. The
    count of a covered cluster is distributed among its new clusters in proportion to their counts,
    and one of them replaces its row.
    """
    none = known.counts[:0]
    if len(known) == 0:
        return new, none
    owner = native.nearest_centers(new.means, known.means, 1).squeeze(1)
    offsets = known.means[owner] - new.means
    apart = whitened(offsets, new.covariances, task.kernel.min_lengthscale) > task.config.fringe
    kept = assignment.too_coarse[owner] | apart
    new, owner = take_clusters(new, kept), owner[kept]
    inherits = assignment.covered[owner]
    total = torch.zeros_like(known.counts).index_add_(0, owner, new.counts)
    gain = torch.where(inherits, 1 + known.counts[owner] / total[owner], 1.0).to(new.means.dtype)
    order = torch.arange(len(new), device=owner.device)
    first = torch.full_like(known.counts, len(new)).scatter_reduce(0, owner, order, "amin")
    where = (assignment.covered & (first < len(new))).nonzero().squeeze(1)
    rest = torch.ones_like(inherits).index_fill_(0, first[where], False).nonzero().squeeze(1)
    order = torch.cat([first[where], rest])
    scatters = new.scatters * gain[:, None, None]
    return take_clusters(
        Clusters((new.counts * gain).round().long(), new.means, scatters), order
    ), where
