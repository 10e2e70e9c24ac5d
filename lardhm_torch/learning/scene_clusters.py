"""Maps with as many clusters as their scene needs.

A coarse map is trained on a sample of the points. Its log-loss on other points, scaled to all points,
measures how much is still to be explained. The map gets one cluster for every `NATS_PER_PARAMETER` of
this loss times the number of parameters of a cluster. A large empty room needs few clusters, even with
many points; sparse scans of a street need thousands. Weights, centers and length scales are then trained
together, so that few clusters are enough.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from lardhm_torch import native
from lardhm_torch.learning.class_balance import balance_classes
from lardhm_torch.learning.clearing import cleared
from lardhm_torch.learning.clustering import (
    POINTS_PER_CLUSTER,
    most_clusters,
)
from lardhm_torch.learning.fine_tuning import TuneConfig, tuned_table
from lardhm_torch.learning.fitting import (
    CHUNK_ROWS,
    Batched,
    FitTask,
    fit_clusters,
    logistic_loss,
)
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.shaping import first_passes, shaped
from lardhm_torch.learning.tuning_steps import (
    Batches,
    Moving,
    Plan,
    to_rows,
    tuning_steps,
)
from lardhm_torch.native.crossings import Lines
from lardhm_torch.sampling import UNKNOWN, spread_rows

NATS_PER_PARAMETER = 2.8  # summed loss of the coarse map that is worth a parameter
COARSE_POINTS = 1000  # known points of the scene per cluster of the coarse map ...
COARSE_SAMPLE = 128  # ... and those that it is trained on
LOSS_POINTS = 1 << 16  # on which its loss is measured
MIN_COARSE = 16  # with fewer clusters, its loss says little: see `clustering.choose_num_clusters`
START_PASSES = 2  # of the weights alone, before centers and length scales move
UNKNOWN_FACTOR = 0.6  # on `FitConfig.unknown_share`: few clusters get more unknown points each
CLASS_RATIOS = (5, 3, 1)  # numbers of occupied, free and unknown clusters


def fit_scene(
    points: Tensor,
    labels: Tensor,
    num_clusters: int | None,
    task: FitTask,
    rays: Lines | None = None,
) -> MapState:
    """Fit a map; None: as many clusters as the scene needs.

    A number that is given, few points, points of one class, and ``FitConfig(shape_passes=0)`` give
    what `fit_clusters` does, followed by `shaped` and, with ``rays``, by `cleared`.

    Args:
        points: (N, D) positions in the map's frame [m], in Morton order.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown, of the points' dtype.
        num_clusters: total over all classes, or None.
        task: kernel, settings, random generator.
        rays: of the points, in the map's frame, that the map should not end early; None: any.
    """
    if num_clusters is None and is_learnable(labels, task):
        return fit_shapes(points, labels, needed_clusters(points, labels, task), task)
    if not task.config.adapt_shapes:
        refine = None if rays is None else partial(cleared, rays=rays)
        return fit_clusters(points, labels, num_clusters, task, refine)
    first = first_passes(task.config, len(points))
    left = task.config.passes_over(len(points)) - first.passes_over(len(points))

    def refined(state: MapState, samples: Batched, task: FitTask) -> MapState:
        state, samples = shaped(state, samples, task, left)
        return state if rays is None else cleared(state, samples, task, rays)

    return fit_clusters(points, labels, num_clusters, task._replace(config=first), refined)


def is_learnable(labels: Tensor, task: FitTask) -> bool:
    """Whether there are enough points of both classes to learn the number of clusters."""
    counts = [int((labels == label).sum()) for label in (0, 1)]
    return task.config.shape_passes > 0 and min(counts) > 0 and _coarse(sum(counts)) >= MIN_COARSE


def _coarse(num_known: int) -> int:
    return num_known // COARSE_POINTS


def needed_clusters(points: Tensor, labels: Tensor, task: FitTask) -> int:
    """Number of clusters that a scene needs, over all classes.

    Args:
        points: (N, D) positions of samples of the scene [m], in Morton order.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        task: kernel, settings, random generator.
    """
    known = labels != UNKNOWN
    count = int(known.sum())
    wanted = COARSE_SAMPLE * _coarse(count)
    rows = spread_rows(len(points), wanted, task.rng)
    task = task._replace(progress=False)
    coarse = fit_shapes(points[rows], labels[rows], _coarse(count), task)
    known[rows] = False
    others = known.nonzero().squeeze(1)
    others = others[:: max(1, len(others) // LOSS_POINTS)]
    loss = known_loss(coarse, points[others], labels[others], task)
    dim = points.shape[1]
    parameters = (dim + 1) * (dim + 2) // 2  # of a cluster: weight, center, factor
    return max(1, round(count * loss / (NATS_PER_PARAMETER * parameters)))


def known_loss(state: MapState, points: Tensor, labels: Tensor, task: FitTask) -> float:
    """Mean log-loss of occupied and free points; both classes have the same weight."""
    tensors = (state.centers, state.raw_scale_tril, state.weights)
    log_odds = native.occupancy(points, *tensors, task.kernel, probability=False)
    return float(logistic_loss(log_odds, labels, balance_classes(labels))) / len(labels)


def class_totals(labels: Tensor, num_clusters: int) -> list[int]:
    """Numbers of occupied, free and unknown clusters, at most those that their points allow.

    Most clusters are occupied ones: they decide how well surfaces are resolved.

    Args:
        labels: (N,) of the samples.
        num_clusters: total.
    """
    sizes = [int((labels == label).sum()) for label in (1, 0, UNKNOWN)]
    ratios = [ratio if size else 0 for ratio, size in zip(CLASS_RATIOS, sizes, strict=True)]
    limits = [min(most_clusters(size), max(1, size // POINTS_PER_CLUSTER)) for size in sizes]
    wanted = [max(1, num_clusters * ratio // sum(ratios)) if ratio else 0 for ratio in ratios]
    return [min(pair) for pair in zip(wanted, limits, strict=True)]


def fit_shapes(points: Tensor, labels: Tensor, num_clusters: int, task: FitTask) -> MapState:
    """Cluster the samples, train the weights, then weights, centers and length scales together."""
    config = replace(
        task.config,
        passes=task.config.passes or START_PASSES,
        unknown_share=UNKNOWN_FACTOR * task.config.unknown_share,
    )
    totals = class_totals(labels, num_clusters)
    return fit_clusters(points, labels, totals, task._replace(config=config), train_shapes)


def train_shapes(state: MapState, samples: Batched, task: FitTask) -> MapState:
    """Continue the training with centers and length scales, over the neighbors that `fit` has found.

    The steps are those of `fine_tune`; unknown points take part.

    Args:
        state: M clusters with trained weights.
        samples: in batches.
        task: kernel and settings.
    """
    config, points = task.config, samples.points
    batch_size = config.rows_per_batch(len(points))
    chunk = batch_size * max(1, CHUNK_ROWS // batch_size)
    steps = -(-len(points) // batch_size)
    plan = Plan(len(points), batch_size, config.shape_passes * steps)
    start = to_rows(state.weights, state.centers, state.raw_scale_tril)
    table = tuned_table(start, TuneConfig(occupied_share=config.occupied_share), task.kernel)
    factors = balance_classes(samples.labels, config.occupied_share, config.unknown_share)
    moving, step = Moving.at_start(start), 0
    for first in range(0, len(points), chunk):
        rows = slice(first, min(len(points), first + chunk))
        near = samples.features_of(rows)[0]
        batches = Batches(points[rows], samples.labels[rows], factors[rows])
        for _ in range(config.shape_passes):
            moving = tuning_steps(batches, near, table, moving, step, plan)
            step += -(-len(batches.labels) // batch_size)
    weights, centers, raw = table.parameters(moving.offsets)
    return replace(state, weights=weights.contiguous(), centers=centers.contiguous(),
                   raw_scale_tril=raw)  # fmt: skip
