"""Incremental training without forgetting, by pseudo-samples that replace old scans.

No old scan is stored. Pseudo-samples are drawn from the moments of the clusters and labelled with the
probability of the map. The weights are then trained on pseudo-samples and new points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import explain, inside_candidates, ordered_features
from lardhm_torch.learning.clustering import MIN_COUNT, Columns, spread_rows
from lardhm_torch.learning.fitting import FitConfig, class_factors, fit_weights, stratified_batches
from lardhm_torch.learning.map_state import MapState, factor_covariances
from lardhm_torch.points import in_morton_order

INSIDE = 3.0  # Mahalanobis radius within which a point lies in an occupied cluster
KEPT_FRACTION = 0.25  # fraction of the count that a contradicted cluster keeps


@dataclass(frozen=True, eq=False)
class Evidence(Columns):
    """Weighted training points: N positions, targets, classes and sample weights.

    ``labels`` are in [0, 1]: the label of a pseudo-sample is the probability of the map. ``is_occupied``
    is the class of a point, used to balance the classes. ``strength`` is the sample weight.
    """

    points: Tensor
    labels: Tensor
    is_occupied: Tensor
    strength: Tensor

    def __len__(self) -> int:
        """Number of points N."""
        return len(self.points)


def spread_points(points: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """(count, D) stratified random subset of the points; all points if there are at most ``count``.

    Points of a ray are consecutive, so the subset represents all rays equally.
    """
    if count >= len(points):
        return points
    return points.index_select(0, spread_rows(len(points), count, rng))


def new_evidence(classes: list[Tensor], limit: int, rng: torch.Generator) -> list[Evidence]:
    """Training points of a scan: at most ``limit`` points, half of each class if possible.

    Points of a subset are weighted to represent all points of their class. Both classes have the same
    total weight in the loss, so equal numbers of points are most efficient.

    Args:
        classes: (N, D) occupied and (N, D) free points [m].
        limit: maximum number of points.
        rng: random generator.
    """
    parts = []
    for number, label in enumerate((1.0, 0.0)):
        members, other = classes[number], classes[1 - number]
        points = spread_points(members, max(limit // 2, limit - len(other)), rng)
        labels = points.new_full((len(points),), label)
        strength = torch.full_like(labels, len(members) / max(1, len(points)))
        parts.append(Evidence(points, labels, labels > 0.5, strength))
    return parts


def replay_evidence(
    known: MapState, rows: Tensor, kernel: Kernel, strength: Tensor, rng: torch.Generator
) -> Evidence:
    """Pseudo-samples drawn from clusters, labelled with the probability of the map.

    Args:
        known: all clusters near the scan, before the update.
        rows: (Q,) clusters to draw from.
        kernel: kernel settings of the map.
        strength: (Q, P) sample weights of the P pseudo-samples of each cluster.
        rng: random generator.
    """
    sources = known.rows(rows)
    points = draw_points(sources, strength.shape[1], kernel.min_lengthscale, rng)
    state = (known.centers, known.raw_scale_tril, known.weights, kernel)
    labels = native.occupancy(points, *state, probability=True)
    is_occupied = sources.is_occupied[:, None].expand_as(strength)
    return Evidence(points, labels, is_occupied.reshape(-1), strength.reshape(-1))


def hit_clusters(known: MapState, hits: Tensor, floor: float) -> Tensor:
    """(M,) bool mask of the occupied clusters that contain any of the (N, D) hits [m]."""
    found = torch.zeros_like(known.is_occupied)
    occupied = known.is_occupied.nonzero().squeeze(1)
    if len(occupied) == 0 or len(hits) == 0:
        return found
    return found.index_copy_(0, occupied, _points_inside(known.rows(occupied), hits, floor) > 0)


def _points_inside(known: MapState, points: Tensor, floor: float) -> Tensor:
    """(M,) number of (N, D) points inside each cluster; a point counts for its nearest one only."""
    return explain(points, known.clusters, floor, INSIDE, INSIDE)[1].counts


def contradicted(
    known: MapState, hit: Tensor, num_hits: int, passed: Tensor, floor: float
) -> Tensor:
    """(M,) upper bound on the weight of each cluster's old points; infinity if not contradicted.

    A scan contradicts an occupied cluster if rays pass through it and no ray ends in it. The bound is
    the number of contradicting points, however often the cluster was observed before, so obstacles
    that have been removed disappear from the map.

    Args:
        known: M clusters.
        hit: (M,) bool, clusters that contain hits of the scan.
        num_hits: number of hits of the scan.
        passed: (N, D) free points of the scan, or a subset that represents them [m].
        floor: smallest standard deviation [m].
    """
    bound = torch.full_like(known.weights, torch.inf)
    occupied = known.is_occupied.nonzero().squeeze(1)
    if len(occupied) == 0 or num_hits == 0 or len(passed) == 0:
        return bound
    point_weight = num_hits / len(passed)  # weight of a free point that balances the classes
    unseen = known.rows(known.is_occupied & ~hit).clusters
    passed = inside_candidates(passed, unseen, floor, INSIDE)
    passes = point_weight * _points_inside(known.rows(occupied), passed, floor).to(bound)
    denied = (passes > 0) & ~hit[occupied]
    return bound.index_copy_(0, occupied, passes.where(denied, torch.inf))


def decay_evidence(part: MapState, bound: Tensor, memory: float) -> MapState:
    """Evidence decay: reduce the counts of contradicted clusters to the fraction `KEPT_FRACTION`.

    Counts are capped at ``memory`` before they are reduced. Covariances do not change. ``bound`` is
    the (Q,) result of `contradicted` for the first Q clusters.
    """
    bound = torch.cat([bound, bound.new_full((len(part) - len(bound),), torch.inf)])
    kept = (KEPT_FRACTION * part.counts.clamp(max=memory)).long().clamp(min=MIN_COUNT)
    counts = torch.where(bound < kept, kept, part.counts).minimum(part.counts)
    fraction = (counts - 1).clamp(min=1) / (part.counts - 1).clamp(min=1)
    return replace(part, counts=counts, scatters=part.scatters * fraction.to(bound)[:, None, None])


def draw_points(known: MapState, count: int, floor: float, rng: torch.Generator) -> Tensor:
    """(M * count, D) points, uniform in ellipsoids with the means and covariances of the clusters.

    Cells of k-means do not overlap, whereas samples of a normal distribution would lie in adjacent
    cells too. To reduce the variance, points are drawn in antithetic pairs about the mean, with
    stratified radii.
    """
    clusters = known.clusters
    spread = clusters.scatters / clusters.counts.clamp(min=1)[:, None, None]
    factors = factor_covariances(spread, floor)
    num_clusters, dim = clusters.means.shape
    pairs = -(-count // 2)
    shape = (num_clusters, pairs, dim)
    direction = torch.randn(shape, generator=rng, device=rng.device, dtype=factors.dtype)
    direction /= torch.linalg.vector_norm(direction, dim=2, keepdim=True)
    volume = torch.rand(num_clusters, pairs, 1, generator=rng, device=rng.device).to(factors)
    volume = (volume + torch.arange(pairs, device=rng.device)[:, None]) / pairs
    ball = (dim + 2) ** 0.5 * volume ** (1 / dim) * direction
    ball = torch.cat([ball, -ball], dim=1)[:, :count]
    return (clusters.means[:, None] + ball @ factors.mT).reshape(-1, dim)


def neighborhood(changed: Tensor, centers: Tensor, num_neighbors: int, index: Tensor) -> Tensor:
    """(M,) bool mask of changed clusters, their neighbors, and the neighbors of those.

    New points also affect the weights of the neighbors, so pseudo-samples of the second neighbors are
    needed to constrain them.
    """

    def neighbors(mask: Tensor) -> Tensor:
        near = native.nearest_centers(centers[mask], centers, num_neighbors, index)
        return torch.zeros_like(mask).index_fill_(0, near.reshape(-1), True)

    touched = changed | neighbors(changed)
    return touched | neighbors(touched & ~changed)


def join_evidence(parts: list[Evidence]) -> Evidence:
    """Concatenate evidence, in order."""
    return Evidence(*map(torch.cat, zip(*parts, strict=True)))


def learn(
    state: MapState,
    evidence: Evidence,
    kernel: Kernel,
    index: Tensor,
    config: FitConfig,
    rng: torch.Generator,
) -> Tensor:
    """(M,) weights trained on the evidence; classes are balanced as in `fit`.

    The regularizer is divided by the total sample weight, not by the number of points. Otherwise,
    every scan would shrink the weights further toward 0.

    Args:
        state: M clusters with initial weights.
        evidence: N weighted points.
        kernel: kernel settings of the map.
        index: search index of the centers, see `native.build_index`.
        config: passes, rates and regularizer.
        rng: random generator.
    """
    batch_size = config.rows_per_batch(len(evidence))
    points, *columns = in_morton_order(*evidence)
    rows = torch.arange(len(points), device=points.device)
    order, labels, is_occupied, strength = stratified_batches((rows, *columns), batch_size, rng)
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
