"""Regrouping of new points and of the kept points of the clusters near them.

This is one step of adaptive k-means on the kept points, separately for each class. Clusters whose points
have a large loss are divided, new points join the nearest cluster or form new clusters, all points of
changed clusters are reassigned to their nearest centers, and clusters with too few points are dissolved
into their neighbors. Finally, clusters of mostly new points are divided, because their losses are not
known yet; places that are seen only once would otherwise have too few clusters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.learning.assignment import nearest_clusters
from lardhm_torch.learning.cluster_matching import take_clusters
from lardhm_torch.learning.clustering import (
    MIN_COUNT,
    Clusters,
    choose_num_clusters,
    cluster_points,
    most_clusters,
    points_where,
)
from lardhm_torch.learning.evidence import (
    add_points,
    evidence_moments,
    following,
    halves,
    kept_again,
    kept_counts,
    kept_points,
)
from lardhm_torch.learning.forgetting import trust
from lardhm_torch.learning.map_state import MapState, new_rows
from lardhm_torch.learning.points import in_morton_order

JOIN_STDS = 3.0  # new points within it of their nearest cluster join it; others form new clusters
MORE = 1.25  # clusters relative to the number up to which they are divided: above, small ones go
LEAST = 1 / 32  # of the mean inertia: clusters below it are dissolved if another one is close
SMALL = 1 / 8  # of it: clusters below it are not divided, and they make room for the ...
LARGE = 3.0  # ... division of clusters above so many times the mean inertia
SPLIT = 4 * MIN_COUNT  # a cluster with fewer kept points is not divided
NEW = 0.5  # fraction of new points above which a cluster is divided because of its inertia alone
MANY = 1.0  # new points relative to the kept ones, above which a cluster's points are regrouped
NEW_ITERATIONS = 5  # of k-means for new clusters
PER_OCCUPIED = (1, 2, 1)  # as in `fit`: n occupied clusters, 2 n free and n unknown ones


class Rule(NamedTuple):
    """How clusters are regrouped.

    Args:
        occupied: number of occupied clusters up to which they are divided.
        grows: clusters of new points in places without clusters raise the limits.
        few: there are so few hits that each may have a cluster of its own.
        split_loss: clusters with a larger mean loss are divided while there are fewer.
        floor: smallest standard deviation [m].
    """

    occupied: int
    grows: bool
    few: bool
    split_loss: float
    floor: float


class Groups(NamedTuple):
    """Clusters that are regrouped: their class is fixed, and their points are apart from the rest.

    Args:
        state: M clusters without evidence.
        evidence: (K, E, D) the points of the first ones; new clusters, the last ones, have none yet.
        sizes: (M,) number of points of each cluster.
        kinds: (M,) class, see `MapState.kinds`.
        changed: (M,) bool: the points go to the nearest centers.
    """

    state: MapState
    evidence: Tensor
    sizes: Tensor
    kinds: Tensor
    changed: Tensor

    def rows(self, kind: int) -> Tensor:
        """Rows of the clusters of a class."""
        return (self.kinds == kind).nonzero().squeeze(1)


def regrouped(
    known: MapState, classes: tuple[Tensor, ...], rule: Rule, rng: torch.Generator
) -> MapState:
    """Clusters after new points were added.

    Args:
        known: K clusters.
        classes: new occupied, free and unknown points, (N, D) each [m].
        rule: limits.
        rng: random generator.

    Returns:
        The K clusters followed by new ones; clusters without points have been dissolved.
    """
    groups = _divide(known, known.losses * trust(known.doubts), rule, exchange=True)
    before = len(groups.kinds)
    groups, owners = _joined(groups, classes, rule, rng)
    points, joined = torch.cat(classes), torch.cat(owners)
    received = torch.bincount(joined + 1, minlength=len(groups.kinds) + 1)[1:]
    alive = _kept(groups, received, before, rule)
    many = received > MANY * groups.sizes
    groups = groups._replace(changed=groups.changed | many | ~alive)
    again, enters = kept_again(points, joined, groups.evidence, groups.changed)
    counts = groups.state.counts + _unseen(groups, received, again)
    state = replace(groups.state, counts=torch.where(groups.kinds < 2, counts, 0))
    state = replace(state, scatters=_rescaled(groups.state, state.counts))
    sizes = [len(part) for part in classes]
    entering = [
        points_where(part, mask) for part, mask in zip(classes, enters.split(sizes), strict=True)
    ]
    homes = joined[enters].split([len(part) for part in entering])
    moving = (entering, homes, received - again)
    state = _reassigned(groups._replace(state=state), moving, alive, len(known), rule.floor)
    new = (state.fresh > NEW * kept_counts(state.evidence)).to(state.losses)
    groups = _divide(state, new, rule, exchange=False)
    return replace(groups.state, evidence=groups.evidence)


def _divide(known: MapState, losses: Tensor, rule: Rule, exchange: bool) -> Groups:
    """Divide clusters of large loss in two; the second halves are appended.

    Args:
        known: K clusters.
        losses: (K,) mean losses of their points; where these are not known, 1 or 0.
        rule: limits.
        exchange: large clusters may be divided in exchange for small ones.
    """
    kinds, light = known.kinds, replace(known, evidence=known.evidence[:, :0])
    divided, kept = torch.zeros_like(known.is_occupied), kept_counts(known.evidence)
    inertia = _inertia(light, kept)
    losses = losses.where(kept >= SPLIT, 0)
    rows, occupied = [], rule.occupied
    for kind, factor in enumerate(PER_OCCUPIED):
        own = ((kinds == kind) & (kept > 0)).nonzero().squeeze(1)
        room = factor * occupied - len(own)
        found = _worth_dividing(losses[own], inertia[own], room, rule.split_loss)
        found = own[found if exchange else found[: max(0, room)]]
        if kind == 0 and rule.grows and len(own):
            occupied = len(own) + min(len(found), max(0, room))
        rows.append(found)
    chosen = torch.cat(rows)
    if len(chosen) == 0:
        return Groups(light, known.evidence, kept, kinds, divided)
    first, second = halves(known.evidence.index_select(0, chosen))
    sizes = torch.stack([kept_counts(first), kept_counts(second)])
    balanced = (sizes.amin(dim=0) >= MIN_COUNT).nonzero().squeeze(1)
    chosen, first, second = chosen[balanced], first[balanced], second[balanced]
    sizes = sizes[:, balanced]
    parents, shares = light.rows(chosen), sizes.double() / sizes.sum(dim=0)
    of_parents = kinds[chosen]
    parts = [
        _half(parents, of_parents, evidence, share, rule)
        for evidence, share in zip((first, second), shares, strict=True)
    ]
    both = MapState(*(torch.cat(pair) for pair in zip(*parts, strict=True)))
    evidence = torch.cat([known.evidence, second]).index_copy_(0, chosen, first)
    divided = torch.cat([divided.index_fill(0, chosen, True), divided.new_ones(len(chosen))])
    kept = torch.cat([kept, sizes[1]]).index_copy_(0, chosen, sizes[0])
    return Groups(light.put(chosen, both), evidence, kept, torch.cat([kinds, of_parents]), divided)


def _worth_dividing(losses: Tensor, inertia: Tensor, room: int, split_loss: float) -> Tensor:
    """Rows of the clusters of a class that are divided: those of large loss and inertia.

    There may be ``room`` more clusters. If there is no more room, large clusters are divided in
    exchange for small ones, which `_kept` dissolves then.

    Args:
        losses: (M,) mean loss of the points of each; 0 if it has too few to be divided.
        inertia: (M,) see `_inertia`.
        room: how many more clusters there may be; negative if there are too many.
        split_loss: clusters with a smaller loss are not divided.
    """
    mean = inertia.mean()
    found = ((losses > split_loss) & (inertia > SMALL * mean)).nonzero().squeeze(1)
    order = (losses[found] * inertia[found]).argsort(descending=True, stable=True)
    found, first = found[order], max(0, room)
    exchanged = max(0, int((inertia < SMALL * mean).sum()) + min(0, room))
    more = found[first:]
    return torch.cat([found[:first], more[inertia[more] > LARGE * mean][:exchanged]])


def _half(
    parents: MapState, kinds: Tensor, evidence: Tensor, fraction: Tensor, rule: Rule
) -> MapState:
    """Clusters with the moments of their evidence, a fraction of that of their parents."""
    counts = (parents.counts * fraction).round().to(parents.counts).clamp(min=1)
    found = evidence_moments(evidence)
    clusters = _represented(found, torch.where(kinds == 2, 0, counts))
    rows = new_rows(clusters, kinds == 0, rule.floor, parents.evidence)
    return replace(
        rows,
        weights=parents.weights,
        doubts=parents.doubts,
        times=parents.times,
        fresh=kept_counts(evidence).to(parents.fresh),
        channel_sums=parents.channel_sums * fraction[:, None, None],
        class_weights=parents.class_weights,
    )


def _represented(found: Clusters, counts: Tensor) -> Clusters:
    """Clusters of other counts with the same means and covariances."""
    factor = (counts - 1).clamp(min=1).to(found.scatters)
    return Clusters(counts, found.means, found.covariances * factor[:, None, None])


def _rescaled(state: MapState, counts: Tensor) -> Tensor:
    """Scatters of clusters whose counts became ``counts`` and whose covariances are the same."""
    factor = (counts - 1).clamp(min=1) / (state.counts - 1).clamp(min=1)
    return state.scatters * factor[:, None, None].to(state.scatters)


def _joined(
    groups: Groups, classes: tuple[Tensor, ...], rule: Rule, rng: torch.Generator
) -> tuple[Groups, list[Tensor]]:
    """Clusters followed by new ones of points far from all others, and the cluster of each point.

    The cluster is -1 if a point forms none because there are too few like it.
    """
    owners, added, kinds = [], [], []
    start = len(groups.kinds)
    for kind, points in enumerate(classes):
        rows = groups.rows(kind)
        near = take_clusters(groups.state.clusters, rows)
        own = nearest_clusters(points, near, rule.floor, JOIN_STDS)
        far = (own < 0).nonzero().squeeze(1)
        joined = rows.index_select(0, own.clamp(min=0)) if len(rows) else own
        if len(far) >= MIN_COUNT or (len(far) and (rule.few or len(rows) == 0)):
            rest = points[far]
            new = _new_clusters(rest, kind, rule, rng)
            added.append(replace(new, evidence=new.evidence[:, :0]))
            kinds.append(torch.full_like(new.counts, kind))
            joined = joined.index_copy(0, far, start + _nearest(rest, new.means))
            start += len(new)
        else:
            joined = joined.index_fill(0, far, -1)
        owners.append(joined)
    if not added:
        return groups, owners
    state = groups.state
    for new in added:
        state = state.put(joined[:0], new)
    count = start - len(groups.kinds)
    return Groups(
        state,
        groups.evidence,
        torch.nn.functional.pad(groups.sizes, (0, count)),
        torch.cat([groups.kinds, *kinds]),
        torch.cat([groups.changed, groups.changed.new_ones(count)]),
    ), owners


def _new_clusters(points: Tensor, kind: int, rule: Rule, rng: torch.Generator) -> MapState:
    """Clusters of points far from all known ones. They keep no points yet."""
    (points,) = in_morton_order(points)
    chosen = choose_num_clusters(points) * PER_OCCUPIED[kind]
    found = cluster_points(points, min(chosen, most_clusters(len(points))), rng, NEW_ITERATIONS)
    clusters = _represented(found, torch.zeros_like(found.counts))
    is_occupied = torch.full_like(found.counts, kind == 0, dtype=torch.bool)
    return new_rows(clusters, is_occupied, rule.floor)


def _nearest(points: Tensor, centers: Tensor) -> Tensor:
    return native.nearest_centers(points, centers, 1).squeeze(1)


def _kept(groups: Groups, received: Tensor, before: int, rule: Rule) -> Tensor:
    """(M,) mask of the clusters that are not dissolved.

    As in k-means, clusters should have similar inertia, so the smallest are dissolved: those of hardly
    any inertia, small ones while there are more than the number up to which clusters are divided,
    and any while there are `MORE` times as many.

    Args:
        groups: M clusters.
        received: (M,) number of new points.
        before: number of clusters before new ones were added.
        rule: limits.
    """
    sizes = groups.sizes + received
    alive = sizes >= (1 if rule.few else MIN_COUNT)
    inertia = _inertia(groups.state, groups.sizes, received)
    wanted, most = rule.occupied, MORE * rule.occupied
    for kind, factor in enumerate(PER_OCCUPIED):
        own = groups.rows(kind)
        some = alive[own]
        if not bool(some.any()):
            some = sizes[own] > 0
        if not rule.few:
            some &= ~_needless(groups.state.means[own], inertia[own], sizes[own], some)
            small = some & (inertia[own] < SMALL * inertia[own][some].mean())
            excess = int(some.sum()) - factor * wanted
            some = _without_smallest(some, inertia[own], min(excess, int(small.sum())))
        known = int((own < before).sum())
        limit = int(factor * most) if rule.grows else max(factor * rule.occupied, known)
        some = _without_smallest(some, inertia[own], int(some.sum()) - max(1, limit))
        if kind == 0:
            wanted = max(wanted, int(some.sum()))
            most = max(MORE * int(some.sum()), rule.occupied)
        alive[own] = some
    return alive


def _without_smallest(some: Tensor, inertia: Tensor, count: int) -> Tensor:
    """(M,) mask of some clusters without the ``count`` of least inertia; none if it is negative."""
    order = torch.where(some, inertia, torch.inf).argsort(stable=True)
    return some.index_fill(0, order[: max(0, count)], False)


def _inertia(state: MapState, sizes: Tensor, received: Tensor | int = 0) -> Tensor:
    """(M,) sum of the squared distances of the points of clusters from their means [m^2].

    Args:
        state: M clusters.
        sizes: (M,) number of kept points; they stand for themselves if the class is unknown.
        received: (M,) number of new points.
    """
    number = torch.where(state.counts > 0, state.counts, sizes) + received
    return number * state.clusters.covariances.diagonal(dim1=1, dim2=2).sum(dim=1)


def _needless(means: Tensor, inertia: Tensor, sizes: Tensor, some: Tensor) -> Tensor:
    """(M,) mask of clusters of little inertia whose points another one can take for little more."""
    mean = inertia[some].mean()
    found = some & (inertia < LEAST * mean)
    rows, others = found.nonzero().squeeze(1), (some & ~found).nonzero().squeeze(1)
    if len(rows) and len(others):
        nearest = means[others[_nearest(means[rows], means[others])]]
        cost = sizes[rows] * (means[rows] - nearest).square().sum(dim=1)
        found[rows] = cost < mean
    return found


def _unseen(groups: Groups, joined: Tensor, again: Tensor) -> Tensor:
    """(M,) estimated number of the points joined to each cluster that it has not received before.

    A cluster that keeps one in r of its points recognizes one in r of those that it receives again.
    """
    represented = (groups.state.counts / groups.sizes.clamp(min=1)).clamp(min=1)
    return joined - torch.minimum(joined, (again * represented).round().to(joined))


def _reassigned(
    groups: Groups, entering: tuple[list[Tensor], Sequence[Tensor], Tensor], alive: Tensor,
    num_known: int, floor: float,
) -> MapState:  # fmt: skip
    """Clusters after new points and all points of changed clusters went to the nearest centers.

    The points of changed clusters take along an equal part of the count each.

    Args:
        groups: M clusters.
        entering: new points of each class, (N, D) each [m]; their clusters; (M,) their numbers.
        alive: (M,) bool: the others are dissolved.
        num_known: number of clusters that are not new, the first ones.
        floor: smallest standard deviation [m].
    """
    state, evidence, changed = groups.state, groups.evidence, groups.changed
    points, owners = [evidence[:0, 0]], [torch.empty_like(groups.kinds[:0])]
    carried = (state.counts / (groups.sizes + entering[2]).clamp(min=1)).double() * changed
    counts = state.counts.double().masked_fill(changed, 0)
    for kind, (new, joined) in enumerate(zip(*entering[:2], strict=True)):
        rows = (alive & (groups.kinds == kind)).nonzero().squeeze(1)
        if len(rows) == 0:
            continue
        regrouped = changed & (groups.kinds == kind)
        kept, homes = kept_points(evidence, regrouped[: len(evidence)].nonzero().squeeze(1))
        points.append(torch.cat([new, kept]))
        owners.append(rows.index_select(0, _nearest(points[-1], state.means[rows])))
        if kind < 2:
            counts.index_add_(0, owners[-1], carried[torch.cat([joined, homes])])
    counts = torch.where(groups.kinds < 2, counts.round().clamp(min=1), 0).to(state.counts)
    state = replace(state, counts=counts, scatters=_rescaled(state, counts))
    evidence, new = add_points(evidence, changed, torch.cat(points), torch.cat(owners))
    sizes = kept_counts(evidence)
    lost = (groups.sizes + new - sizes).clamp(min=0)
    fresh = state.fresh + torch.maximum(new, lost).to(state.fresh)
    state = replace(state, evidence=evidence, fresh=fresh)
    moved = ((sizes > 0) & ((new > 0) | (lost > 0))).nonzero().squeeze(1)
    return following(state, moved, evidence.index_select(0, moved), num_known, floor)
