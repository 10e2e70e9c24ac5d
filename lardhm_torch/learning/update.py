"""One more scan into a map: Algorithm 2, and a default under which the map stops growing.

Algorithm 2 clusters the new points and merges new clusters with old ones. Two partitions of one
surface rarely put their centers within one standard deviation of each other, so a map grows with
every visit. By default new points therefore go straight into the clusters of their class that
explain them, and only the others are clustered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import explain, reaching, unexplained
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
    around,
    contradicted,
    forget,
    hit_clusters,
    join_evidence,
    learn,
    new_evidence,
    recalled_evidence,
    spread_points,
)
from lardhm_torch.points import in_morton_order

COVERED = 0.36  # of a cluster's variance: new points that spread over so much have seen all of it
SMOOTHER = 2.0  # free space than surfaces: so many times the points before a cluster is too coarse
REACH = 2.0  # standard deviations of its kernel that a cluster near a scan reaches
LOOKED_AT = 4  # times as many points may contradict old clusters as train the weights
# The map recalls its own leaning to hits, so that new points need no more of it.
UPDATE_FIT = FitConfig(batch_size=1024, l2=0.01, occupied_share=0.5)


@dataclass(frozen=True, kw_only=True)
class UpdateConfig:
    """How a new scan enters a map. Radii are in standard deviations of a cluster."""

    as_in_paper: bool = False  # cluster all new points and merge by Algorithm 2
    zeta: float = 1.0  # [m] of Algorithm 2: clusters farther apart never merge
    radius: float = 3.0  # a point this near to the nearest center of its class joins the cluster
    reach: float = 4.0  # nearer points make no new cluster
    fringe: float = 2.0  # a new cluster with an old center this near to its own is not taken
    refine: float = 1.3  # a scan with so many times the points of a cluster makes finer ones of it
    crowded: float = 8.0  # in that, a past counts at most so many times the usual points
    max_points: int = 20_000  # that train the weights, at random; all points enter the clusters
    replay: int = 8  # points recalled from an old cluster; 0: train on new points only
    memory: float = 800.0  # a cluster's past counts at most as many points: the world may change
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
    """What every step of an update needs beside clusters and points."""

    kernel: Kernel
    config: UpdateConfig
    rng: torch.Generator


def updated(
    state: MapState, points: Tensor, labels: Tensor, num_clusters: int | None, task: Task
) -> tuple[Tensor, MapState]:
    """One more scan: clusters pooled or appended, weights trained.

    Only clusters near the points are read, so that the cost does not grow with the map. Old
    clusters keep their rows; new ones come after them.

    Args:
        state: M clusters.
        points: (N, D) new positions, map frame [m].
        labels: (N,) 1 occupied, 0 free.
        num_clusters: total over both classes if no point were explained yet; None: from the data.
        task: kernel, settings, random state.

    Returns:
        ((Q,) rows of the clusters near the points; what becomes of them, in that order, and after
        them the new clusters).

    Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
    """
    near = reaching(state.centers, state.raw_scale_tril, task.kernel, points, REACH)
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
    """(Known clusters with the new points pooled into them, and new ones; which known ones were hit)."""
    if num_clusters is None:
        totals = scan_clusters(classes)
    else:
        totals = split_clusters([len(members) for members in classes], num_clusters)
    part, hit = known, torch.zeros_like(known.is_occupied)
    for kind, members, total in zip((True, False), classes, totals, strict=True):
        if total:
            part, met = absorb(part, members, kind, total, task)
            hit = hit.index_fill(0, met, True) if kind else hit
    return part, hit


def _train(
    part: MapState, known: MapState, classes: list[Tensor], hit: Tensor, task: Task
) -> MapState:
    """Weights trained on the new points and on what the clusters around them recall.

    Args:
        part: what the clusters nearby become, new ones at the end.
        known: what they were.
        classes: occupied and free new points [m].
        hit: (Q,) which known clusters hits fell into.
        task: kernel, settings, random state.
    """
    config, kernel, rng = task.config, task.kernel, task.rng
    index = native.build_index(part.centers, kernel.num_neighbors)
    new = new_evidence(classes, config.max_points, rng)
    if not config.replay or len(known) == 0:
        learned = learn(part, join_evidence(new), kernel, index, config.fit, rng)
        return replace(part, weights=learned)
    changed = torch.ones_like(part.is_occupied)
    changed[: len(known)] = (part.means[: len(known)] != known.means).any(dim=1)
    moving = around(changed, part.centers, kernel.num_neighbors, index)
    rows = moving[: len(known)].nonzero().squeeze(1)
    looked_at = LOOKED_AT * config.max_points
    passed = spread_points(classes[1], looked_at, rng)
    worth = contradicted(known, hit, len(classes[0]), passed, kernel.min_lengthscale)
    strength = known.counts.clamp(max=config.memory).to(worth).minimum(worth)[rows]
    strength = (strength / config.replay)[:, None].expand(-1, config.replay)
    old = recalled_evidence(known, rows, kernel, strength, rng)
    learned = learn(part, join_evidence([*new, old]), kernel, index, config.fit, rng)
    return replace(
        forget(part, worth, config.memory), weights=torch.where(moving, learned, part.weights)
    )


def absorb(
    part: MapState, points: Tensor, is_occupied: bool, num_clusters: int, task: Task
) -> tuple[MapState, Tensor]:
    """Points of one class pooled into the clusters that explain them; the others make new ones.

    Args:
        part: clusters nearby, of both classes.
        points: (N, D) new points of one class [m].
        is_occupied: which class.
        num_clusters: how many all the points would make; the unexplained make their share.
        task: kernel, settings, random state.

    Returns:
        (what becomes of ``part``, new clusters at its end; rows of those that points fell into).
    """
    floor = task.kernel.min_lengthscale
    own = (part.is_occupied == is_occupied).nonzero().squeeze(1)
    known = part.rows(own)
    look = _explain(known, points, len(points) / num_clusters, task)
    pooled = (look.found.counts > 0).nonzero().squeeze(1)
    part = pool_into(part, own[pooled], take_clusters(look.found, pooled), floor)
    met = torch.cat([own[pooled], own[look.outgrown]])
    if len(look.rest) < MIN_COUNT:
        return part, met
    (rest,) = in_morton_order(look.rest)
    share = -(-num_clusters * len(rest) // len(points))
    new = cluster_points(rest, share, task.rng)
    new, where = _settle(known, new, look, task)
    kinds = torch.full((len(new),), is_occupied, device=points.device)
    return append_clusters(part, new, kinds, floor, own[where]), met


class _Look(NamedTuple):
    """What known clusters make of new points.

    ``found`` are the moments of the points that join each cluster; ``outgrown`` are the clusters
    that are too coarse for the scan, and ``covered`` those among them that the scan saw whole;
    ``rest`` are the points of the outgrown clusters, and those that no cluster explains.
    """

    rest: Tensor
    found: Clusters
    outgrown: Tensor
    covered: Tensor


def _explain(known: MapState, points: Tensor, usual_count: float, task: Task) -> _Look:
    config, clusters = task.config, known.clusters
    if len(known) == 0:
        return _Look(points, clusters, known.is_occupied, known.is_occupied)
    rule = (task.kernel.min_lengthscale, config.radius, config.reach)
    owners, found = explain(points, clusters, *rule)
    # many scans that each see a little more of a cluster must not hide that it has become too coarse
    most = config.crowded if bool(known.is_occupied[0]) else SMOOTHER * config.crowded
    past = clusters.counts.clamp(2 * usual_count, most * usual_count)
    outgrown = found.counts > config.refine * past
    covered = outgrown & (_spread(found) > COVERED * _spread(clusters))
    found = Clusters(found.counts * ~outgrown, found.means, found.scatters)
    return _Look(unexplained(points, owners, ~outgrown), found, outgrown, covered)


def _spread(clusters: Clusters) -> Tensor:
    """(M,) total variance [m^2]."""
    total = clusters.scatters.diagonal(dim1=1, dim2=2).sum(dim=1)
    return total / clusters.counts.clamp(min=1)


def _settle(known: MapState, new: Clusters, look: _Look, task: Task) -> tuple[Clusters, Tensor]:
    """Which new clusters are taken, in which order, and the rows that the first of them take over.

    A new cluster that has an old center among its own points is the fringe of old ones and is left
    out. The new clusters of a covered one share its points in proportion to their own, and one of
    them takes over its row.
    """
    none = known.counts[:0]
    if len(known) == 0:
        return new, none
    owner = native.nearest_centers(new.means, known.means, 1).squeeze(1)
    offsets = known.means[owner] - new.means
    apart = whitened(offsets, new.covariances, task.kernel.min_lengthscale) > task.config.fringe
    kept = look.outgrown[owner] | apart
    new, owner = take_clusters(new, kept), owner[kept]
    heirs = look.covered[owner]
    total = torch.zeros_like(known.counts).index_add_(0, owner, new.counts)
    gain = torch.where(heirs, 1 + known.counts[owner] / total[owner], 1.0).to(new.means.dtype)
    order = torch.arange(len(new), device=owner.device)
    first = torch.full_like(known.counts, len(new)).scatter_reduce(0, owner, order, "amin")
    where = (look.covered & (first < len(new))).nonzero().squeeze(1)
    rest = torch.ones_like(heirs).index_fill_(0, first[where], False).nonzero().squeeze(1)
    order = torch.cat([first[where], rest])
    scatters = new.scatters * gain[:, None, None]
    return take_clusters(
        Clusters((new.counts * gain).round().long(), new.means, scatters), order
    ), where
