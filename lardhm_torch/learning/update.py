"""Incremental update with one more scan: evidence, regrouping, and training of changed clusters.

A map keeps a bounded sample of the real points of each cluster (`evidence`). An update adds the points
of a scan to it, reduces the weight of contradicted points (`forgetting`), regroups changed clusters
(`regrouping`) and trains their weights on the kept points and their labels (`retraining`). So the map
is always trained on a sample of all scans. Algorithm 2 of the paper is also available.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import kernels_near
from lardhm_torch.learning.channel_sums import handed_over
from lardhm_torch.learning.cluster_matching import merge_clusters
from lardhm_torch.learning.clustering import (
    FEW_POINTS,
    choose_num_clusters,
    cluster_classes,
    points_where,
    split_labels,
)
from lardhm_torch.learning.evidence import keeps_points, kept_points, with_evidence
from lardhm_torch.learning.fitting import FitConfig, FitTask
from lardhm_torch.learning.forgetting import doubted, forget, trust
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.passing import passed_clusters, still_unknown
from lardhm_torch.learning.points import at_most, in_morton_order
from lardhm_torch.learning.regrouping import Rule, regrouped
from lardhm_torch.learning.retraining import balanced, retrained, trained
from lardhm_torch.native.crossings import Lines
from lardhm_torch.native.thinning import few_per_cell
from lardhm_torch.sampling import UNKNOWN

UNDECIDED = 0.1  # distance of a probability from 1/2 within which a place is still unknown
BOX_STDS = 2.0  # half-width of a kernel, in standard deviations, to select clusters near a scan
UPDATE_FIT = FitConfig(passes=2, batch_size=1024)


@dataclass(frozen=True, kw_only=True)
class UpdateConfig:
    """Settings of an incremental update."""

    as_in_paper: bool = False  # cluster all new points and merge the clusters by Algorithm 2
    zeta: float = 1.0  # [m] maximum distance between merged clusters in Algorithm 2
    split_loss: float = 0.003  # clusters whose points have a larger mean log-loss are divided
    cell_edge: float = 0.05  # [m] in a cell of this edge, at most 4 new points of a class are used
    max_points: int = 20_000  # maximum number of new points of each class; a random subset is used
    max_trained_points: int = 150_000  # of more kept points, all clusters use their first ones only
    fit: FitConfig = UPDATE_FIT

    def __post_init__(self) -> None:
        for name in ("zeta", "split_loss", "cell_edge", "max_points", "max_trained_points"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be > 0; got {getattr(self, name)}")


class Task(NamedTuple):
    """Settings and random generator of an update."""

    kernel: Kernel
    config: UpdateConfig
    rng: torch.Generator


class Changes(NamedTuple):
    """Result of an update: rows to overwrite, their clusters and new ones, and rows to remove."""

    where: Tensor
    part: MapState
    removed: Tensor


def updated(
    state: MapState,
    points: Tensor,
    labels: Tensor,
    num_clusters: int | None,
    task: Task,
    rays: Lines | None = None,
) -> Changes:
    """Update clusters and weights with one more scan.

    Only clusters near the points are processed. Existing clusters keep their rows, unless they are
    dissolved.

    Args:
        state: M clusters.
        points: (N, D) new positions, map frame [m].
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        num_clusters: maximum number of clusters near the points, over all classes; None: chosen
            from the number of hits there.
        task: kernel, settings, random generator.
        rays: of the scan, in the map's frame; None: they are not known.

    Returns:
        The clusters near the points; see `parameters.write_rows`. New clusters take the rows of
        dissolved ones.

    Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
    """
    kernel, config, rng = task.kernel, task.config, task.rng
    nearby = kernels_near(state.centers, state.raw_scale_tril, kernel, points, BOX_STDS)
    nearby = nearby.nonzero().squeeze(1)
    part = state.rows(nearby)
    part = replace(part, evidence=with_evidence(part, kernel.min_lengthscale, rng))
    if config.as_in_paper:
        return Changes(nearby, _as_in_paper(part, points, labels, num_clusters, task), nearby[:0])
    index = native.build_index(part.centers, kernel.num_neighbors)
    few = int(state.counts[state.is_occupied].sum() + (labels > UNKNOWN).sum()) <= FEW_POINTS
    points, labels = _thinned(points, labels, config, rng)
    points, labels = _still_unknown(part, points, labels, kernel, index)
    before = part.doubts
    part, points, labels = _contradicted(part, points, labels, rays, kernel, index)
    part, classes = forget(part, before), tuple(split_labels(points, labels))
    total = int(state.counts[state.is_occupied].sum())
    occupied, grows = _most_occupied(part, classes[0], num_clusters, total), num_clusters is None
    rule = Rule(occupied, grows, few, config.split_loss, kernel.min_lengthscale)
    part = regrouped(part, classes, rule, rng)
    alive = keeps_points(part.evidence)
    part = handed_over(part, alive)
    part = part if bool(alive.all()) else part.rows(alive)
    part = retrained(part, config.max_trained_points, kernel, config.fit, rng)
    return _without(nearby, part, alive)


def _without(nearby: Tensor, part: MapState, alive: Tensor) -> Changes:
    """Changes of a map whose rows ``nearby`` become the living of as many clusters and new ones.

    Args:
        nearby: (Q,) rows of known clusters.
        part: the living clusters, in order.
        alive: (P,) mask of the living among the known clusters and the new ones after them.
    """
    known = alive[: len(nearby)]
    places = nearby[known]
    dead = nearby[~known]
    filled = dead[: max(0, len(part) - len(places))]
    return Changes(torch.cat([places, filled]), part, dead[len(filled) :])


def _thinned(
    points: Tensor, labels: Tensor, config: UpdateConfig, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """A few samples of each label in each cell, and a stratified random subset of many.

    The samples of a scan are dense near the sensor and on close surfaces; the map is as accurate without
    most of those.
    """
    few = few_per_cell(points, (2 * labels).long(), config.cell_edge)
    of_few = labels[few]
    rows = [few[of_few == label] for label in (1.0, 0.0, UNKNOWN)]
    chosen = torch.cat([at_most(own, config.max_points, rng) for own in rows])
    return points.index_select(0, chosen), labels.index_select(0, chosen)


def _still_unknown(
    part: MapState, points: Tensor, labels: Tensor, kernel: Kernel, index: Tensor
) -> tuple[Tensor, Tensor]:
    """The samples without unknown points in places that earlier scans observed.

    Unknown points were checked against the rays of their own scan only. They are dropped where the
    probability of the map is not near 1/2.
    """
    rows = (labels == UNKNOWN).nonzero().squeeze(1)
    if len(rows) == 0 or len(part) == 0:
        return points, labels
    tensors = (part.centers, part.raw_scale_tril, part.weights, kernel)
    unknown = points.index_select(0, rows)
    probability = native.occupancy(unknown, *tensors, probability=True, index=index)
    known = (probability - UNKNOWN).abs() >= UNDECIDED
    kept = torch.ones_like(labels, dtype=torch.bool).index_fill_(0, rows[known], False)
    return points_where(points, kept), labels[kept]


def _contradicted(
    part: MapState,
    points: Tensor,
    labels: Tensor,
    rays: Lines | None,
    kernel: Kernel,
    index: Tensor,
) -> tuple[MapState, Tensor, Tensor]:
    """Clusters with new doubts, and the samples with free points where rays pass doubted clusters."""
    if rays is None:
        part = replace(part, doubts=doubted(part, points, labels, kernel, index))
        return part, points, labels
    passed, places = passed_clusters(part, rays)
    part = replace(part, doubts=doubted(part, points, labels, kernel, index, passed))
    gone = points_where(places, trust(part.doubts)[passed] < 1)
    labels = torch.cat([labels, labels.new_zeros(len(gone))])
    return still_unknown(part, rays, kernel.min_lengthscale), torch.cat([points, gone]), labels


def _most_occupied(part: MapState, hits: Tensor, num_clusters: int | None, total: int) -> int:
    """Number of occupied clusters up to which those near a scan are divided.

    It is the number that `clustering.choose_num_clusters` gives for the points that they have received.
    ``total`` is the number of hits that the whole map has received before.
    """
    if num_clusters is not None:
        return num_clusters // 4
    kept, _ = kept_points(part.evidence, part.is_occupied.nonzero().squeeze(1))
    size = max(int(part.counts[part.is_occupied].sum()), len(hits))  # most hits may be known
    share = size / max(1, total, len(hits))
    return choose_num_clusters(torch.cat([kept, hits]), represented=size, share=share)


def _as_in_paper(
    part: MapState, points: Tensor, labels: Tensor, num_clusters: int | None, task: Task
) -> MapState:
    """Algorithm 2: clusters of the new points, merged with known ones and trained on the points."""
    points, labels = in_morton_order(points, labels)
    new, is_occupied = cluster_classes(points, labels, num_clusters, task.rng)
    floor = task.kernel.min_lengthscale
    part = merge_clusters(part, new, is_occupied, task.config.zeta, floor)
    index = native.build_index(part.centers, task.kernel.num_neighbors)
    kinds = torch.where(labels == UNKNOWN, 2, (labels < UNKNOWN).long())
    samples = (points, labels, balanced(kinds, torch.ones_like(labels), task.config.fit))
    weights, _ = trained(part, index, samples, FitTask(task.kernel, task.config.fit, task.rng))
    return replace(part, weights=weights)
