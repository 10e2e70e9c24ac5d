"""Regrouping: new points and the evidence of one class of clusters, grouped anew where they changed.

One step of adaptive k-means on the kept points. Clusters whose points the map predicts badly are
divided, new points join the nearest cluster or form new ones, every point of a changed cluster goes to
its nearest center, and clusters with too few points are dissolved into their neighbors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import raw_factors
from lardhm_torch.learning.assignment import nearest_clusters
from lardhm_torch.learning.cluster_matching import moved_factors
from lardhm_torch.learning.clustering import (
    MIN_COUNT,
    Clusters,
    choose_num_clusters,
    cluster_points,
    most_clusters,
)
from lardhm_torch.learning.evidence import (
    evidence_moments,
    halves,
    keep_points,
    kept_counts,
    kept_points,
)
from lardhm_torch.learning.forgetting import trust
from lardhm_torch.learning.map_state import MapState, factor_covariances, new_rows
from lardhm_torch.learning.points import in_morton_order

JOIN_STDS = 3.0  # new points within it of their nearest cluster join it; others form new clusters
SPLIT = 4 * MIN_COUNT  # a cluster with fewer kept points is not divided
NEW_ITERATIONS = 5  # of k-means for new clusters


class Rule(NamedTuple):
    """How clusters of a class are regrouped.

    Args:
        kind: 0 occupied, 1 free, 2 unknown.
        limit: maximum number of clusters; more are dissolved, smallest first.
        grows: clusters of new points in places without clusters raise the limit.
        few: there are so few hits that each may have a cluster of its own.
        split_loss: clusters with a larger mean loss are divided while there are fewer.
        floor: smallest standard deviation [m].
    """

    kind: int
    limit: int
    grows: bool
    few: bool
    split_loss: float
    floor: float


def regrouped(known: MapState, points: Tensor, rule: Rule, rng: torch.Generator) -> MapState:
    """Clusters of one class after new points of this class were added.

    Args:
        known: K clusters of the class.
        points: (N, D) new points of the class [m].
        rule: class and limits.
        rng: random generator.

    Returns:
        The K clusters followed by new ones; clusters without points have been dissolved.
    """
    state, divided = _divide(known, rule)
    owners = nearest_clusters(points, state.clusters, rule.floor, JOIN_STDS)
    rest = points[owners < 0]
    start = len(state)
    if len(rest) >= MIN_COUNT or (len(rest) and (rule.few or len(known) == 0)):
        state = state.put(owners[:0], _new_clusters(rest, rule, rng))
        owners = owners.masked_scatter(owners < 0, start + _nearest(rest, state.means[start:]))
    joined = torch.bincount(owners[owners >= 0], minlength=len(state))
    limit = rule.limit + (len(state) - start if rule.grows else 0)
    alive = _kept(state, joined, limit, rule.few)
    is_new = torch.arange(len(state), device=alive.device) >= start
    divided = torch.cat([divided, divided.new_zeros(len(state) - start)])
    touched = divided | (joined > 0) | is_new | ~alive
    evidence = _reassigned(state, points[owners >= 0], touched, alive)
    fresh = state.fresh + (evidence != state.evidence).any(dim=2).sum(dim=1)
    if rule.kind < 2:
        state = replace(state, counts=state.counts + _unseen(state, points, owners, joined))
    return _moved(replace(state, evidence=evidence, fresh=fresh), rule, len(known))


def _divide(known: MapState, rule: Rule) -> tuple[MapState, Tensor]:
    """Divide clusters of large loss in two; the second halves are appended."""
    divided = torch.zeros_like(known.is_occupied)
    room = rule.limit - len(known)
    losses = known.losses * trust(known.doubts)
    large = (losses > rule.split_loss) & (kept_counts(known.evidence) >= SPLIT)
    rows = large.nonzero().squeeze(1)
    if room <= 0 or len(rows) == 0:
        return known, divided
    rows = rows[losses[rows].argsort(descending=True, stable=True)[:room]]
    first, second = halves(known.evidence[rows])
    sizes = torch.stack([kept_counts(first), kept_counts(second)])
    balanced = sizes.amin(dim=0) >= MIN_COUNT
    rows, first, second, sizes = (
        rows[balanced],
        first[balanced],
        second[balanced],
        sizes[:, balanced],
    )
    parents, share = known.rows(rows), sizes[0] / sizes.sum(dim=0)
    counts = (parents.counts * share).round().to(parents.counts)
    parts = [
        _half(parents, evidence, count, part, rule)
        for evidence, count, part in (
            (first, counts, share),
            (second, parents.counts - counts, 1 - share),
        )
    ]
    both = MapState(*(torch.cat(pair) for pair in zip(*parts, strict=True)))
    divided = torch.cat([divided.index_fill(0, rows, True), divided.new_ones(len(rows))])
    return known.put(rows, both), divided


def _half(
    parents: MapState, evidence: Tensor, counts: Tensor, fraction: Tensor, rule: Rule
) -> MapState:
    """Clusters with the moments of their evidence, which represents ``counts`` points.

    They have a fraction of the parents' channels.
    """
    found = evidence_moments(evidence)
    clusters = _represented(found, torch.zeros_like(counts) if rule.kind == 2 else counts)
    is_occupied = torch.full_like(counts, rule.kind == 0, dtype=torch.bool)
    rows = new_rows(clusters, is_occupied, rule.floor, evidence)
    return replace(
        rows,
        weights=parents.weights,
        doubts=parents.doubts,
        fresh=kept_counts(evidence).to(parents.fresh),
        channel_sums=parents.channel_sums * fraction[:, None, None],
        class_weights=parents.class_weights,
    )


def _represented(found: Clusters, counts: Tensor) -> Clusters:
    """Clusters of other counts with the same means and covariances."""
    factor = (counts - 1).clamp(min=1).to(found.scatters)
    return Clusters(counts, found.means, found.covariances * factor[:, None, None])


def _new_clusters(points: Tensor, rule: Rule, rng: torch.Generator) -> MapState:
    """Clusters of points far from all known ones. They keep no points yet."""
    (points,) = in_morton_order(points)
    chosen = choose_num_clusters(points) * (2 if rule.kind == 1 else 1)
    found = cluster_points(points, min(chosen, most_clusters(len(points))), rng, NEW_ITERATIONS)
    clusters = _represented(found, torch.zeros_like(found.counts))
    return new_rows(
        clusters, torch.full_like(found.counts, rule.kind == 0, dtype=torch.bool), rule.floor
    )


def _unseen(state: MapState, points: Tensor, owners: Tensor, joined: Tensor) -> Tensor:
    """(M,) estimated number of the points joined to each cluster that it has not received before.

    A cluster that keeps one in r of its points recognizes one in r of those that it receives again.
    """
    kept = kept_counts(state.evidence)
    rows = ((owners >= 0) & (kept[owners] > 0)).nonzero().squeeze(1)
    near = state.evidence[owners[rows]]
    again = (near == points[rows][:, None]).all(dim=2).any(dim=1)
    found = torch.bincount(owners[rows[again]], minlength=len(state))
    represented = (state.counts / kept.clamp(min=1)).clamp(min=1)
    return joined - torch.minimum(joined, (found * represented).round().to(joined))


def _nearest(points: Tensor, centers: Tensor) -> Tensor:
    return native.nearest_centers(points, centers, 1).squeeze(1)


def _kept(state: MapState, joined: Tensor, limit: int, few: bool) -> Tensor:
    """(M,) mask of the clusters that are not dissolved."""
    sizes = kept_counts(state.evidence) + joined
    alive = sizes >= (1 if few else MIN_COUNT)
    if not bool(alive.any()):
        alive = sizes > 0
    excess = int(alive.sum()) - max(1, limit)
    if excess > 0:
        alive[torch.where(alive, sizes, sizes.amax() + 1).argsort(stable=True)[:excess]] = False
    return alive


def _reassigned(state: MapState, points: Tensor, touched: Tensor, alive: Tensor) -> Tensor:
    """Evidence after new points and all kept points of touched clusters went to the nearest center."""
    rows = alive.nonzero().squeeze(1)
    if len(rows) == 0:
        return torch.full_like(state.evidence, torch.inf)
    moving, _ = kept_points(state.evidence[touched])
    moving = torch.cat([points, moving])
    owners = _nearest(moving, state.means[rows])
    receives = torch.zeros_like(alive).index_fill(0, rows[owners], True)
    staying, places = kept_points(state.evidence[receives & ~touched])
    order = torch.cumsum(receives, 0) - 1  # of the clusters that receive points
    places = order[(receives & ~touched).nonzero().squeeze(1)[places]]
    kept = keep_points(
        torch.cat([moving, staying]), torch.cat([order[rows[owners]], places]), int(receives.sum())
    )
    evidence = state.evidence.masked_fill((touched & ~receives)[:, None, None], torch.inf)
    return evidence.index_copy(0, receives.nonzero().squeeze(1), kept)


def _moved(state: MapState, rule: Rule, num_known: int) -> MapState:
    """Clusters whose evidence changed get its moments; fine-tuning of known clusters is preserved."""
    rows = ((state.fresh > 0) & (kept_counts(state.evidence) > 0)).nonzero().squeeze(1)
    before = state.rows(rows)
    found = evidence_moments(before.evidence)
    clusters = _represented(found, before.counts)
    old, new = (factor_covariances(c.covariances, rule.floor) for c in (before.clusters, clusters))
    raw = torch.where(
        (rows < num_known)[:, None, None],
        moved_factors(before.raw_scale_tril, old, new),
        raw_factors(new),
    )
    centers = before.centers + (clusters.means - before.means)
    after = replace(before, centers=centers, raw_scale_tril=raw, counts=clusters.counts,
                    means=clusters.means, scatters=clusters.scatters)  # fmt: skip
    return state.put(rows, after)
