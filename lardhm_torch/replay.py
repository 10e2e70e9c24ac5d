"""Learning from a new scan without forgetting: the map recalls what it knows beside the new points.

No old scan is kept. The moments of a cluster tell where its points were, the map itself what it
held to be true there; points drawn from the moments, labelled by the map, stand for the old scans.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.clustering import factor_covariances, z_order
from lardhm_torch.features import Kernel
from lardhm_torch.fitting import FitConfig, deal_samples, fit_weights
from lardhm_torch.map_state import MapState
from lardhm_torch.native.update import explain, ordered_features

# Free points within so many standard deviations of an occupied cluster contradict it, if they are
# so many: single ones come from noise in range and pose.
INSIDE = 4.0
MIN_PASSES = 2


@dataclass(frozen=True)
class Evidence:
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


def new_evidence(classes: list[Tensor], limit: int, rng: torch.Generator) -> list[Evidence]:
    """New points of each class, or ``limit`` of them that count for all, as many of each class.

    Both classes have the same total in the loss, so that an equal number of each says most. The
    points are drawn one from each of equally long stretches: points of one ray follow each other.

    Args:
        classes: (N, D) occupied and (N, D) free points [m].
        limit: how many points at most.
        rng: random state.
    """
    parts = []
    for number, label in enumerate((1.0, 0.0)):
        points, other = classes[number], classes[1 - number]
        drawn, counts = min(len(points), max(limit // 2, limit - len(other))), 1.0
        if drawn < len(points):
            counts = len(points) / drawn
            place = torch.rand(drawn, generator=rng, device=rng.device, dtype=torch.float64)
            place += torch.arange(drawn, device=rng.device)
            points = points.index_select(0, (place * counts).long().clamp(max=len(points) - 1))
        labels = points.new_full((drawn,), label)
        parts.append(Evidence(points, labels, labels > 0.5, torch.full_like(labels, counts)))
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


def remembered_strength(
    known: MapState, new: list[Evidence], memory: float, floor: float
) -> Tensor:
    """(M,) how many points the past of each cluster counts.

    As many as it has met, but not more than ``memory``. An occupied cluster that rays now pass
    through, so that the new points alone would call it free, counts no more than those that say so:
    old obstacles fade within a few scans however often they were seen.

    Args:
        known: M clusters.
        new: occupied and free points of the scan, see `new_evidence`.
        memory: the most points that a past may count.
        floor: smallest standard deviation [m].
    """
    strength = known.counts.clamp(max=memory).to(known.means.dtype)
    occupied = known.is_occupied.nonzero().squeeze(1)
    if len(occupied) == 0 or not all(map(len, new)):
        return strength
    own = known.rows(occupied)
    factors = factor_covariances(own.clusters.covariances, floor)
    hits, passes = (
        explain(part.points, own.means, factors, INSIDE, INSIDE)[1] * part.strength[0]
        for part in new
    )
    # in units of hits, as if both classes had one total
    worth = passes * (len(new[0]) / len(new[1]))
    held = strength[occupied]
    denied = (worth > hits) & (passes >= MIN_PASSES)
    return strength.index_copy(0, occupied, torch.where(denied, held.minimum(worth), held))


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
    names = [field.name for field in fields(Evidence)]
    return Evidence(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


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
    (order,) = deal_samples((z_order(evidence.points),), batch_size, rng)
    indices, values = ordered_features(
        evidence.points, order, state.centers, state.raw_scale_tril, kernel, index
    )
    labels, is_occupied, strength = (
        column.index_select(0, order)
        for column in (evidence.labels, evidence.is_occupied, evidence.strength)
    )
    total, occupied = strength.sum(), (strength * is_occupied).sum()
    counts = strength * (len(evidence) / total)
    if config.balance and bool((occupied > 0) & (occupied < total)):
        own = config.occupied_share
        counts *= torch.where(
            is_occupied, own * total / occupied, (1 - own) * total / (total - occupied)
        )
    scaled = replace(config, l2=config.l2 * len(evidence) / float(total))

    def features_of(rows: slice) -> tuple[Tensor, Tensor]:
        return indices[rows], values[rows]

    return fit_weights(features_of, labels, state.weights, scaled, factors=counts)
