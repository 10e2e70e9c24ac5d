"""Learning from a new scan without forgetting: the map recalls what it knows beside the new points.

No old scan is kept. The moments of a cluster tell where its points were, the map itself what it
held to be true there; points drawn from the moments, labelled by the map, stand for the old scans.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.clustering import factor_covariances, z_order
from lardhm_torch.features import Kernel, raw_factors
from lardhm_torch.fitting import FitConfig, deal_samples, fit_weights
from lardhm_torch.map_state import MapState

# Free points within four standard deviations of an occupied cluster (a kernel value of 0.0003)
# contradict it, if they are so many: single ones come from noise in range and pose.
INSIDE = 0.000335
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


def new_evidence(points: Tensor, labels: Tensor, limit: int, rng: torch.Generator) -> Evidence:
    """New points, or ``limit`` of them at random that count for all, as many of each class.

    Both classes have the same total in the loss, so that an equal number of each says most.
    """
    is_occupied = labels > 0.5
    if len(points) <= limit:
        return Evidence(points, labels, is_occupied, torch.ones_like(labels))
    classes = [is_occupied.nonzero().squeeze(1), (~is_occupied).nonzero().squeeze(1)]
    parts = []
    for rows, other in (classes, classes[::-1]):
        drawn = max(limit // 2, limit - len(other))
        counts = max(1.0, len(rows) / drawn)
        if len(rows) > drawn:
            # with repetition: a permutation of a million points takes longer than the training
            rows = rows[torch.randint(len(rows), (drawn,), generator=rng, device=rng.device)]
        parts.append((rows, torch.full_like(labels[rows], counts)))
    rows, strength = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return Evidence(points[rows], labels[rows], is_occupied[rows], strength)


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


def remembered_strength(known: MapState, new: Evidence, memory: float, floor: float) -> Tensor:
    """(M,) how many points the past of each cluster counts.

    As many as it has met, but not more than ``memory``. An occupied cluster that rays now pass
    through, so that the new points alone would call it free, counts no more than those that say so:
    old obstacles fade within a few scans however often they were seen.
    """
    strength = known.counts.clamp(max=memory).to(known.means.dtype)
    occupied = known.is_occupied.nonzero().squeeze(1)
    share = float(new.is_occupied.double().mean())
    if len(occupied) == 0 or not 0 < share < 1:
        return strength
    own = known.rows(occupied)
    raw = raw_factors(factor_covariances(own.clusters.covariances, floor))
    index, one = native.build_index(own.means, 1), Kernel(num_neighbors=1)
    owner, value = native.nearest_features(new.points, own.means, raw, one, index)
    inside = value.squeeze(1) > INSIDE
    owner, kinds = owner.squeeze(1)[inside].long(), new.is_occupied[inside]
    counts = new.strength[inside]
    hits = torch.zeros_like(own.weights).index_add_(0, owner[kinds], counts[kinds])
    passes = torch.zeros_like(own.weights).index_add_(0, owner[~kinds], counts[~kinds])
    worth = passes * share / (1 - share)  # in units of hits, as if both classes had one total
    held = strength[occupied]
    denied = (worth > hits) & (passes >= MIN_PASSES)
    return strength.index_copy(0, occupied, torch.where(denied, held.minimum(worth), held))


def draw_points(known: MapState, count: int, floor: float, rng: torch.Generator) -> Tensor:
    """(M * count, D) points uniform in ellipsoids with the clusters' means and covariances.

    Cells of k-means end where the next begins; a normal distribution would reach far into it.
    """
    clusters = known.clusters
    spread = clusters.scatters / clusters.counts.clamp(min=1)[:, None, None]
    factors = factor_covariances(spread, floor)
    num_clusters, dim = clusters.means.shape
    shape = (num_clusters, count, dim)
    direction = torch.randn(shape, generator=rng, device=rng.device, dtype=factors.dtype)
    direction /= torch.linalg.vector_norm(direction, dim=2, keepdim=True)
    share = torch.rand(num_clusters, count, 1, generator=rng, device=rng.device).to(factors)
    ball = (dim + 2) ** 0.5 * share ** (1 / dim) * direction
    return (clusters.means[:, None] + ball @ factors.mT).reshape(-1, dim)


def around(seen: Tensor, state: MapState, num_neighbors: int) -> Tensor:
    """(M,) bool: clusters that new points see among their nearest, and the nearest of those.

    The weights of the first are pulled by the new points; what the others know must hold them.
    """
    touched = torch.zeros_like(state.is_occupied)
    touched[seen.reshape(-1).long()] = True
    near = native.nearest_centers(state.centers[touched], state.centers, num_neighbors)
    return touched.index_fill(0, near.reshape(-1), True)


class Features(NamedTuple):
    """(N, K) indices of the nearest clusters of evidence, and the kernel values."""

    indices: Tensor
    values: Tensor


def answer(state: MapState, evidence: Evidence, kernel: Kernel, index: Tensor) -> Features:
    """What the evidence makes the clusters answer."""
    tensors = (state.centers, state.raw_scale_tril)
    return Features(*native.nearest_features(evidence.points, *tensors, kernel, index))


def join_evidence(parts: list[Evidence], features: list[Features]) -> tuple[Evidence, Features]:
    """All points of several, in order, with their features."""
    names = [field.name for field in fields(Evidence)]
    evidence = Evidence(*(torch.cat([getattr(part, name) for part in parts]) for name in names))
    return evidence, Features(*(torch.cat(columns) for columns in zip(*features, strict=True)))


def learn(
    weights: Tensor,
    evidence: Evidence,
    features: Features,
    config: FitConfig,
    rng: torch.Generator,
) -> Tensor:
    """(M,) weights trained on the evidence from a start; the classes share the loss as in `fit`.

    The regularizer is spread over all that the evidence stands for, not over the few points that
    carry it: otherwise every scan would pull the weights further to zero.
    """
    order = z_order(evidence.points)
    columns = (evidence.labels, evidence.is_occupied, evidence.strength, *features)
    labels, is_occupied, strength, indices, values = deal_samples(
        tuple(column.index_select(0, order) for column in columns),
        config.rows_a_batch(len(evidence)),
        rng,
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

    return fit_weights(features_of, labels, weights, scaled, factors=counts)
