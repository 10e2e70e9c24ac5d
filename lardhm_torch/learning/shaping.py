"""Shapes of clusters that explain their samples, in the middle of the training of `fit`.

The moments of a cluster tell where its points lie, not where its kernel should end. After half of the
passes over the weights, weights, centers and length scales are trained together, by the steps of
fine-tuning, on a sample of the points. Points are drawn with a probability proportional to their
gradient, and weighted by its reciprocal: the probability of most is right already, and these matter
little. The passes that are left train the weights of the new shapes on all points.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.learning.fine_tuning import TuneConfig, tuned_table
from lardhm_torch.learning.fitting import (
    CHUNK_ROWS,
    Batched,
    FitConfig,
    FitTask,
    fit_weights,
    loss_factors,
)
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.tuning_steps import (
    Batches,
    Moving,
    Plan,
    Table,
    to_rows,
    tuned_features,
    tuning_steps,
)

SHARE = 0.2  # of the points, at most, on which shapes are trained
FLOOR = 0.2  # smallest probability of drawing a point, relative to the mean
FRESH = 0.1  # the features of points that are drawn more often than this are computed again
PASSES, BATCHES = 3, 8  # over the points that are drawn
MIN_BATCH = 256  # points
RATES = TuneConfig(center_rate=0.05, scale_rate=0.05)
WEIGHT_RATE = 0.2  # learning rate of the passes that are left, relative to that of the first


def first_passes(config: FitConfig, num_points: int) -> FitConfig:
    """The settings with the passes over the weights that come before the shapes are trained."""
    return replace(config, passes=-(-config.passes_over(num_points) // 2))


def shaped(
    state: MapState, samples: Batched, task: FitTask, passes: int
) -> tuple[MapState, Batched]:
    """The clusters with trained shapes, and the samples with the features of these.

    The features of points that are right already stay as they are for training; those of the others
    are computed again, with the same neighbors.

    Args:
        state: M clusters with weights.
        samples: that these were trained on, in batches; of many, some are used for the shapes.
        task: kernel, settings, random generator.
        passes: over the weights, at the end.
    """
    config, (points, labels) = task.config, samples[:2]
    size = config.rows_per_batch(len(points))
    rows = slice(0, min(len(points), size * max(1, CHUNK_ROWS // size)))
    factors = loss_factors(labels, config)
    indices, values = samples.features_of(rows)
    given = Batches(points[rows], labels[rows], factors[rows])
    wanted = given.factors * misfits(indices, values, given.labels, state.weights)
    chance = chances(wanted)
    start = to_rows(state.weights, state.centers, state.raw_scale_tril)
    table = tuned_table(start, RATES, task.kernel)
    offsets = _tuned_offsets(given, indices, chance, table, task)
    fresh = (chance > FRESH).nonzero().squeeze(1)
    near = indices.index_select(0, fresh)
    renewed = tuned_features(given.points.index_select(0, fresh), near, table, offsets)
    values.index_copy_(0, fresh, renewed)
    weights, centers, raw = (part.contiguous() for part in table.parameters(offsets))
    index = native.build_index(centers, task.kernel.num_neighbors)

    def features_of(chunk: slice) -> tuple[Tensor, Tensor]:
        if chunk == rows:
            return indices, values
        return native.nearest_features(points[chunk], centers, raw, task.kernel, index)

    rate = WEIGHT_RATE * config.learning_rate
    config = replace(config, passes=max(1, passes), learning_rate=rate)
    weights = fit_weights(features_of, labels, weights, config, task.progress, factors)
    state = replace(state, weights=weights, centers=centers, raw_scale_tril=raw)
    return state, samples._replace(features_of=features_of)


def chances(wanted: Tensor) -> Tensor:
    """(N,) sizes of the gradients of points -> (N,) probabilities of drawing them."""
    wanted = wanted + FLOOR * wanted.mean()
    tiny = torch.finfo(wanted.dtype).tiny
    return (SHARE * wanted / wanted.mean().clamp(min=tiny)).clamp(max=1)


def _tuned_offsets(
    given: Batches, indices: Tensor, chance: Tensor, table: Table, task: FitTask
) -> Tensor:
    """(M, G) offsets of the parameters after training on the points that are drawn."""
    rng = task.rng
    place = torch.rand(len(chance), generator=rng, device=rng.device).to(chance)
    rows = (place < chance).nonzero().squeeze(1)
    moving = Moving.at_start(table.start)
    if len(rows) == 0:
        return moving.offsets
    points, labels, factors = (column.index_select(0, rows) for column in given)
    batches = Batches(points, labels, factors / chance.index_select(0, rows))
    near = indices.index_select(0, rows)
    size = max(MIN_BATCH, -(-len(rows) // BATCHES))
    steps = -(-len(rows) // size)
    plan = Plan(len(rows), size, PASSES * steps)
    for passed in range(PASSES):
        moving = tuning_steps(batches, near, table, moving, passed * steps, plan)
    return moving.offsets


def misfits(indices: Tensor, values: Tensor, labels: Tensor, weights: Tensor) -> Tensor:
    """(N,) how far the probabilities of N samples are from their labels.

    Args:
        indices: (N, K) clusters.
        values: (N, K) kernel values.
        labels: (N,) in [0, 1].
        weights: (M,).
    """
    if native.descends(indices, values):
        return torch.ops.lardhm.errors(indices, values, labels, weights, 1, False)
    return (torch.sigmoid((values * weights[indices]).sum(dim=1)) - labels).abs()
