"""Learning from a new scan without forgetting: the map recalls what it knows beside the new points.

No old scan is kept. The moments of a cluster tell where its points were, the map itself what it
held to be true there; points drawn from the moments, labelled by the map, stand for the old scans.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import explain, ordered_features, possibly_inside
from lardhm_torch.learning.clustering import MIN_COUNT, Columns, spread_rows
from lardhm_torch.learning.fitting import FitConfig, class_factors, deal_samples, fit_weights
from lardhm_torch.learning.map_state import MapState, factor_covariances
from lardhm_torch.points import in_morton_order

INSIDE = 3.0  # standard deviations from an occupied cluster, within which free points contradict it
KEPT = 0.25  # of a contradicted cluster's past


@dataclass(frozen=True, eq=False)
class Evidence(Columns):
    """What weights learn from: N points with a target each, and how much each counts.

    ``labels`` are 0 to 1: a recalled point has the probability that the map gave it. ``is_occupied``
    is the class a point stands for, so that both classes can be given the same total.
    """

    points: Tensor
    labels: Tensor
    is_occupied: Tensor
    strength: Tensor

    def __len__(self) -> int:
        """Number of points N."""
        return len(self.points)


def spread_points(points: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """(count, D) of the points, one from each of as many equal stretches; all if there are no more.

    Points of one ray follow each other, so that all rays get their share.
    """
    if count >= len(points):
        return points
    return points.index_select(0, spread_rows(len(points), count, rng))


def new_evidence(classes: list[Tensor], limit: int, rng: torch.Generator) -> list[Evidence]:
    """New points of each class, or ``limit`` of them that count for all, as many of each class.

    Both classes have the same total in the loss, so that an equal number of each says most.

    Args:
        classes: (N, D) occupied and (N, D) free points [m].
        limit: how many points at most.
        rng: random state.
    """
    parts = []
    for number, label in enumerate((1.0, 0.0)):
        members, other = classes[number], classes[1 - number]
        points = spread_points(members, max(limit // 2, limit - len(other)), rng)
        labels = points.new_full((len(points),), label)
        strength = torch.full_like(labels, len(members) / max(1, len(points)))
        parts.append(Evidence(points, labels, labels > 0.5, strength))
    return parts


def recalled_evidence(
    known: MapState, rows: Tensor, kernel: Kernel, strength: Tensor, rng: torch.Generator
) -> Evidence:
    """Points drawn from the moments of clusters, labelled by the map that these clusters are.

    Args:
        known: all clusters nearby, as they were before the new scan.
        rows: (Q,) which of them recall.
        kernel: how the map turns them into probabilities.
        strength: (Q, P) what each of P points of a cluster counts.
        rng: random state.
    """
    recalling = known.rows(rows)
    points = draw_points(recalling, strength.shape[1], kernel.min_lengthscale, rng)
    state = (known.centers, known.raw_scale_tril, known.weights, kernel)
    labels = native.occupancy(points, *state, probability=True)
    is_occupied = recalling.is_occupied[:, None].expand_as(strength)
    return Evidence(points, labels, is_occupied.reshape(-1), strength.reshape(-1))


def hit_clusters(known: MapState, hits: Tensor, floor: float) -> Tensor:
    """(M,) bool: occupied clusters that (N, D) hits lie in."""
    found = torch.zeros_like(known.is_occupied)
    occupied = known.is_occupied.nonzero().squeeze(1)
    if len(occupied) == 0 or len(hits) == 0:
        return found
    return found.index_copy_(0, occupied, _points_inside(known.rows(occupied), hits, floor) > 0)


def _points_inside(known: MapState, points: Tensor, floor: float) -> Tensor:
    """(M,) how many (N, D) points lie in each of M clusters, each point in its nearest at most."""
    return explain(points, known.clusters, floor, INSIDE, INSIDE)[1].counts


def contradicted(
    known: MapState, hit: Tensor, num_hits: int, passed: Tensor, floor: float
) -> Tensor:
    """(M,) how many points of an occupied cluster's past a scan leaves it; elsewhere infinity.

    A scan contradicts an occupied cluster if its rays pass through and none ends there. It is then
    worth no more than the points that say so, however often it was seen before: old obstacles fade.

    Args:
        known: M clusters.
        hit: (M,) which of them hits of the scan fell into.
        num_hits: of the scan.
        passed: (N, D) free points of the scan, or some of them that stand for all [m].
        floor: smallest standard deviation [m].
    """
    worth = torch.full_like(known.weights, torch.inf)
    occupied = known.is_occupied.nonzero().squeeze(1)
    if len(occupied) == 0 or num_hits == 0 or len(passed) == 0:
        return worth
    share = num_hits / len(passed)  # in units of hits, as if both classes had one total
    unseen = known.rows(known.is_occupied & ~hit).clusters
    passed = possibly_inside(passed, unseen, floor, INSIDE)
    passes = share * _points_inside(known.rows(occupied), passed, floor).to(worth)
    denied = (passes > 0) & ~hit[occupied]
    return worth.index_copy_(0, occupied, passes.where(denied, torch.inf))


def forget(part: MapState, worth: Tensor, memory: float) -> MapState:
    """Clusters that a scan contradicts lose most of their past: what is kept is `KEPT` of it.

    Their covariances stay, and their past counts as at most ``memory`` before it is cut. See
    `contradicted` for what ``worth`` is: (Q,), of the first Q clusters.
    """
    worth = torch.cat([worth, worth.new_full((len(part) - len(worth),), torch.inf)])
    kept = (KEPT * part.counts.clamp(max=memory)).long().clamp(min=MIN_COUNT)
    counts = torch.where(worth < kept, kept, part.counts).minimum(part.counts)
    share = (counts - 1).clamp(min=1) / (part.counts - 1).clamp(min=1)
    return replace(part, counts=counts, scatters=part.scatters * share.to(worth)[:, None, None])


def draw_points(known: MapState, count: int, floor: float, rng: torch.Generator) -> Tensor:
    """(M * count, D) points uniform in ellipsoids with the clusters' means and covariances.

    Cells of k-means end where the next begins; a normal distribution would reach far into it. Points
    come in pairs on opposite sides of the mean and at radii spread evenly: a few stand for a cluster
    better than as many independent ones.
    """
    clusters = known.clusters
    spread = clusters.scatters / clusters.counts.clamp(min=1)[:, None, None]
    factors = factor_covariances(spread, floor)
    num_clusters, dim = clusters.means.shape
    pairs = -(-count // 2)
    shape = (num_clusters, pairs, dim)
    direction = torch.randn(shape, generator=rng, device=rng.device, dtype=factors.dtype)
    direction /= torch.linalg.vector_norm(direction, dim=2, keepdim=True)
    share = torch.rand(num_clusters, pairs, 1, generator=rng, device=rng.device).to(factors)
    share = (share + torch.arange(pairs, device=rng.device)[:, None]) / pairs
    ball = (dim + 2) ** 0.5 * share ** (1 / dim) * direction
    ball = torch.cat([ball, -ball], dim=1)[:, :count]
    return (clusters.means[:, None] + ball @ factors.mT).reshape(-1, dim)


def around(changed: Tensor, centers: Tensor, num_neighbors: int, index: Tensor) -> Tensor:
    """(M,) bool: clusters that new points joined or made, their neighbors, and the next ones.

    The weights of the neighbors, too, are pulled by the new points; what the next ones know must
    hold them.
    """

    def neighbors(mask: Tensor) -> Tensor:
        near = native.nearest_centers(centers[mask], centers, num_neighbors, index)
        return torch.zeros_like(mask).index_fill_(0, near.reshape(-1), True)

    touched = changed | neighbors(changed)
    return touched | neighbors(touched & ~changed)


def join_evidence(parts: list[Evidence]) -> Evidence:
    """All points of several, in order."""
    return Evidence(*map(torch.cat, zip(*parts, strict=True)))


def learn(
    state: MapState,
    evidence: Evidence,
    kernel: Kernel,
    index: Tensor,
    config: FitConfig,
    rng: torch.Generator,
) -> Tensor:
    """(M,) weights trained on the evidence from a start; the classes share the loss as in `fit`.

    The regularizer is spread over all that the evidence stands for, not over the few points that
    carry it: otherwise every scan would pull the weights further to zero.

    Args:
        state: M clusters and the weights to start from.
        evidence: N points.
        kernel: of the map.
        index: of the centers, see `native.build_index`.
        config: passes, rates and regularizer.
        rng: random state.
    """
    batch_size = config.rows_a_batch(len(evidence))
    points, *columns = in_morton_order(*evidence)
    rows = torch.arange(len(points), device=points.device)
    order, labels, is_occupied, strength = deal_samples((rows, *columns), batch_size, rng)
    indices, values = ordered_features(
        points, order, state.centers, state.raw_scale_tril, kernel, index
    )
    total, occupied = strength.sum(), (strength * is_occupied).sum()
    counts = strength * (len(evidence) / total)
    if config.balance:
        factors = class_factors(total - occupied, occupied, config.occupied_share)
        counts *= factors.to(counts)[is_occupied.long()]
    scaled = replace(config, l2=config.l2 * len(evidence) / float(total))

    def features_of(rows: slice) -> tuple[Tensor, Tensor]:
        return indices[rows], values[rows]

    return fit_weights(features_of, labels, state.weights, scaled, factors=counts)
