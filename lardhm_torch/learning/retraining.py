"""Training of the weights of changed clusters on the kept points around them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import ordered_features
from lardhm_torch.learning.class_balance import count_factors
from lardhm_torch.learning.cluster_matching import take_clusters
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.evidence import first_points, kept_counts, kept_points
from lardhm_torch.learning.fitting import FitConfig, FitTask, fit_weights, stratified_batches
from lardhm_torch.learning.forgetting import trust
from lardhm_torch.learning.map_state import EVIDENCE, MapState
from lardhm_torch.learning.points import blurred_hits, morton_order
from lardhm_torch.learning.unseen import off_surfaces
from lardhm_torch.sampling import UNKNOWN

FRESH = 1 / 16  # fraction of new points above which the weight of a cluster is trained
FEWEST = 16  # kept points of a cluster that are used in any case, and all of those with a ...
SMALL_LOSS = 0.003  # ... smaller mean loss use
MIN_BATCHES, MIN_STEPS = 8, 64  # per pass, and in all: few points give enough steps, too
LOSS_STRIDE = 4  # losses are estimated from one of so many samples
KIND_LABELS = torch.tensor([1.0, 0.0, UNKNOWN])  # of the classes in `MapState.kinds`


def retrained(
    state: MapState, limit: int, kernel: Kernel, config: FitConfig, rng: torch.Generator
) -> MapState:
    """Train the weights of changed clusters and their neighbors on evidence; other weights are fixed.

    A cluster has changed if more than `FRESH` of its kept points are new.

    The evidence of the neighbors of those constrains them, too. The classes are balanced over all
    clusters of the state, so that the balance does not depend on which of them are trained. Unknown
    points inside surfaces have no weight, as in `fit`. ``losses`` of the trained clusters are updated.

    Args:
        state: M clusters.
        limit: number of kept points to train on; see `_first_points`.
        kernel: kernel settings of the map.
        config: passes, rates and regularizer.
        rng: random generator.
    """
    kept = kept_counts(state.evidence)
    changed = state.fresh > FRESH * kept
    if not bool(changed.any()):
        return state
    index = native.build_index(state.centers, kernel.num_neighbors)
    moving = changed | _neighbors(changed, state.centers, kernel.num_neighbors, index)
    beside = _neighbors(moving & ~changed, state.centers, kernel.num_neighbors, index)
    rows = (moving | beside).nonzero().squeeze(1)
    rows = rows[morton_order(state.centers[rows])]
    points, owners, kept = _first_points(state, rows, kept, limit)
    strength = evidence_weights(state, kept)
    factors = balanced(state.kinds, strength, config, kept) * trust(state.doubts)
    labels = KIND_LABELS.to(points)[state.kinds].index_select(0, owners)
    factors = factors.index_select(0, owners)
    surfaces = take_clusters(state.clusters, rows[state.is_occupied[rows]])
    factors = _settled(points, labels, factors, surfaces, kernel.min_lengthscale)
    represented = float((strength * kept).index_select(0, rows).sum())
    config = replace(config, l2=config.l2 * len(points) / represented)
    config = _with_enough_steps(config, len(points))
    task = FitTask(kernel, config, rng)
    weights, (rows, losses) = trained(state, index, (points, labels, factors), task)
    owners = owners.index_select(0, rows)
    found = torch.bincount(owners, minlength=len(state))
    losses = torch.zeros_like(weights).index_add_(0, owners, losses) / found
    return replace(
        state,
        weights=torch.where(moving, weights, state.weights),
        losses=torch.where(moving & (found > 0), losses, state.losses),
        fresh=state.fresh.masked_fill(moving, 0),
    )


def _first_points(
    state: MapState, rows: Tensor, kept: Tensor, limit: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The first kept points of some clusters: few of those with a small loss, more of the others.

    Args:
        state: M clusters; a loss of 0 is not known.
        rows: (Q,) clusters.
        kept: (M,) number of their points.
        limit: number of points in all, about; above it, fewer than all points are used, but `FEWEST`.

    Returns:
        (L, D) points; (L,) their clusters; (M,) number of points that each cluster uses.
    """
    is_easy = (state.losses > 0) & (state.losses < SMALL_LOSS)
    used = torch.where(is_easy, kept.clamp(max=FEWEST), kept)
    most = EVIDENCE * limit / max(1, int(used[rows].sum()))
    used = used.clamp(max=max(FEWEST, int(most)))
    first = first_points(state.evidence.index_select(0, rows), used[rows])
    points, places = kept_points(first)
    return points, rows.index_select(0, places), used


def _settled(
    points: Tensor, labels: Tensor, factors: Tensor, surfaces: Clusters, floor: float
) -> Tensor:
    """(N,) loss factors, 0 for unknown points inside surfaces (`unseen.off_surfaces`).

    Unknown points were sampled behind the hits of one scan, and other scans may show surfaces there.
    """
    unknown = (labels == UNKNOWN).nonzero().squeeze(1)
    inside = ~off_surfaces(points.index_select(0, unknown), surfaces, floor)
    return factors.index_fill(0, unknown[inside], 0)


def _with_enough_steps(config: FitConfig, num_points: int) -> FitConfig:
    """Training settings with smaller batches and more passes if there are few points."""
    largest = max(1, num_points // MIN_BATCHES)
    config = replace(config, batch_size=min(config.rows_per_batch(num_points), largest))
    batches = -(-num_points // config.rows_per_batch(num_points))
    return replace(config, passes=max(config.passes_over(num_points), -(-MIN_STEPS // batches)))


def trained(
    state: MapState, index: Tensor, samples: tuple[Tensor, Tensor, Tensor], task: FitTask
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Train all weights on weighted samples, starting from the weights of the state.

    Args:
        state: M clusters.
        index: search index of the centers, see `native.build_index`.
        samples: (N, D) positions [m], neighbors close to each other in memory; (N,) labels in [0, 1];
            (N,) loss factors.
        task: kernel, training settings and random generator.

    Returns:
        (M,) weights; and a subset of the samples with the loss of each, in excess of that of a perfect
        prediction.
    """
    points, labels, factors = samples
    config = task.config
    points = blurred_hits(points, labels, config.hit_noise, task.rng)
    batch_size = config.rows_per_batch(len(points))
    along = torch.arange(len(points), device=points.device)
    (batched,) = stratified_batches((along,), batch_size, task.rng)
    features = ordered_features(
        points, batched, state.centers, state.raw_scale_tril, task.kernel, index
    )
    targets = labels.index_select(0, batched)
    weights = fit_weights(
        lambda rows: (features[0][rows], features[1][rows]),
        targets, state.weights, config, factors=factors.index_select(0, batched),
    )  # fmt: skip
    losses = excess_losses(*features, targets, weights, LOSS_STRIDE)
    return weights, (batched[::LOSS_STRIDE], losses)


def excess_losses(
    indices: Tensor, values: Tensor, labels: Tensor, weights: Tensor, stride: int = 1
) -> Tensor:
    """Loss of every ``stride``-th of N samples, in excess of that of a perfect prediction.

    Args:
        indices: (N, K) clusters.
        values: (N, K) kernel values.
        labels: (N,) in [0, 1].
        weights: (M,).
        stride: 1 for all samples.
    """
    if native.descends(indices, values):
        return torch.ops.lardhm.errors(indices, values, labels, weights, stride, True)
    indices, values, labels = (tensor[::stride] for tensor in (indices, values, labels))
    log_odds = (values * weights[indices]).sum(dim=1)
    loss = torch.nn.functional.binary_cross_entropy_with_logits(log_odds, labels, reduction="none")
    return loss + torch.xlogy(labels, labels) + torch.xlogy(1 - labels, 1 - labels)


def _neighbors(mask: Tensor, centers: Tensor, num_neighbors: int, index: Tensor) -> Tensor:
    """(M,) mask of clusters -> (M,) mask of the neighbors of their centers."""
    points = centers[mask]
    if native.supports(points):
        given = (points.detach(), centers.detach(), num_neighbors, index)
        return torch.ops.lardhm.neighbors_of(*given)
    near = native.nearest_centers(points, centers, num_neighbors, index)
    return torch.zeros_like(mask).index_fill_(0, near.reshape(-1), True)


def evidence_weights(state: MapState, kept: Tensor) -> Tensor:
    """(M,) weight of each kept point of a cluster: the number of points that it represents."""
    represented = state.counts / kept.clamp(min=1)
    return represented.clamp(min=1).to(state.weights)


def balanced(
    kinds: Tensor, strength: Tensor, config: FitConfig, sizes: Tensor | None = None
) -> Tensor:
    """(N,) loss factors, mean 1: sample weights within a class, and classes balanced as in `fit`.

    Args:
        kinds: (N,) class of each sample, or of the samples of each group.
        strength: (N,) their weights.
        config: class weights.
        sizes: (N,) number of samples of each group; None: one sample each.
    """
    sizes = torch.ones_like(strength) if sizes is None else sizes.to(strength)
    counts = strength.new_zeros(3, dtype=torch.float64).index_add_(0, kinds, sizes.double())
    # from the order of the labels to that of the kinds
    shares = count_factors(counts[[1, 2, 0]], config.occupied_share, config.unknown_share)[
        [2, 0, 1]
    ]
    means = torch.zeros_like(counts).index_add_(0, kinds, (sizes * strength).double())
    factors = strength * (shares * counts / means.clamp(min=1e-30)).to(strength)[kinds]
    return factors * (sizes.sum() / (sizes * factors).sum())
