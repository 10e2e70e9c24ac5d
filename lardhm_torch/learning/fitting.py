"""All samples at once: clusters, then weights by stochastic gradient descent (eq. 2 to 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.clustering import cluster_classes
from lardhm_torch.learning.map_state import MapState, new_rows
from lardhm_torch.learning.unseen import settle_unknown

CHUNK_ROWS = 1 << 21  # points whose features are computed at a time
PASSES, MIN_STEPS = 4, 256  # a few beams make a single batch: four steps would teach nothing
CACHE_BYTES = 1 << 28  # features are kept for all passes up to this size
State = tuple[Tensor, Tensor, Tensor]  # weights, running mean and mean square of the slope
FeaturesOf = Callable[[slice], tuple[Tensor, Tensor]]


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How the weights are trained.

    The defaults train to convergence. The paper's own setting, one pass at a constant rate without
    preconditioner, is ``FitConfig(passes=1, learning_rate=0.1, decay=False, preconditioner=False,
    batch_size=1)``; it leaves log-loss on the table (docs and benchmarks show how much).
    """

    passes: int | None = None  # over all points; None: 4, or as many as make `MIN_STEPS` steps
    batch_size: int | None = None  # points a step; None: N / 128, at least 256
    learning_rate: float = 0.5  # eta of eq. (4)
    decay: bool = True  # eta falls linearly to 0; otherwise constant
    preconditioner: bool = True  # A of eq. (4): running root mean square gradient; else identity
    l2: float = 0.03  # lambda_1 of eq. (2), against the sum of the losses of all points
    l1: float = 0.0  # lambda_2 of eq. (2), by soft thresholding: weights become exactly 0
    balance: bool = True  # the classes share the loss in a fixed way, however few their points
    # The occupied class's share where classes are balanced. More than half, because hits are few
    # and free points many: what is learned of hits carries over to unseen rays less surely.
    occupied_share: float = 0.6
    unknown_share: float = 0.25  # of the unknown points' loss, beside the loss of the two classes

    def rows_a_batch(self, num_points: int) -> int:
        """Points a step: about ``batch_size``, such that all batches of a pass are equally large."""
        wanted = self.batch_size or max(256, num_points // 128)
        return -(-num_points // -(-num_points // wanted)) if num_points else wanted

    def passes_over(self, num_points: int) -> int:
        """Passes over so many points."""
        batches = max(1, -(-num_points // self.rows_a_batch(num_points)))
        return self.passes or max(PASSES, -(-MIN_STEPS // batches))

    def __post_init__(self) -> None:
        if self.passes is not None and self.passes < 1:
            raise ValueError(f"passes must be 1 or more, or None; got {self.passes}")
        if self.batch_size is not None and self.batch_size < 1:
            raise ValueError(f"batch_size must be 1 or more; got {self.batch_size}")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be > 0; got {self.learning_rate}")
        if not 0 < self.occupied_share < 1:
            raise ValueError(f"occupied_share must be in (0, 1); got {self.occupied_share}")
        if not self.unknown_share >= 0:
            raise ValueError(f"unknown_share must be 0 or more; got {self.unknown_share}")
        if self.l1 < 0 or self.l2 < 0:
            raise ValueError(f"l1 and l2 must be 0 or more; got {self.l1} and {self.l2}")


class FitTask(NamedTuple):
    """What a fit needs beside the samples."""

    kernel: Kernel
    config: FitConfig
    rng: torch.Generator
    progress: bool = False


def fit_clusters(
    points: Tensor, labels: Tensor, num_clusters: int | None, task: FitTask
) -> MapState:
    """Clusters of the samples, each class on its own, with trained weights.

    Args:
        points: (N, D) positions in the map's frame [m], in Morton order.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown, of the points' dtype.
        num_clusters: total over both classes; None: chosen from the data.
        task: kernel, settings, random state.

    Source: Guizilini & Ramos 2016, Sections II and III.
    """
    clusters, is_occupied = cluster_classes(points, labels, num_clusters, task.rng)
    state = new_rows(clusters, is_occupied, task.kernel.min_lengthscale)
    columns = settle_unknown(points, labels, state, task.kernel, task.rng)
    points, labels = deal_samples(columns, task.config.rows_a_batch(len(columns[0])), task.rng)
    index = native.build_index(state.centers, task.kernel.num_neighbors)

    def features_of(rows: slice) -> tuple[Tensor, Tensor]:
        centers, factors = state.centers, state.raw_scale_tril
        return native.nearest_features(points[rows], centers, factors, task.kernel, index)

    weights = fit_weights(features_of, labels, state.weights, task.config, task.progress)
    return replace(state, weights=weights)


def deal_samples(
    columns: tuple[Tensor, ...], batch_size: int, rng: torch.Generator
) -> tuple[Tensor, ...]:
    """Samples along a space-filling curve -> the same in the order `fit_weights` should take them.

    They are dealt out to the batches in turn, each round from another random batch on. So every
    batch is a sample of all space, more even than a random one, and its neighbors in space lie next
    to each other in memory.

    Args:
        columns: (N, ...) positions, labels or features of the samples, in the order of `morton_order`.
        batch_size: samples a batch.
        rng: random state.
    """
    count = len(columns[0])
    batches = max(1, -(-count // batch_size))
    rounds = -(-count // batches)
    first = torch.randint(batches, (rounds, 1), generator=rng, device=rng.device)
    turn = torch.randperm(batches, generator=rng, device=rng.device)
    batch = turn[(torch.arange(batches, device=rng.device) + first) % batches].reshape(-1)[:count]
    sizes = torch.bincount(batch, minlength=batches)
    place = (sizes.cumsum(0) - sizes)[batch]
    place += torch.arange(count, device=rng.device) // batches
    # Reading in order and writing to all batches at once is several times faster than a gather.
    return tuple(torch.empty_like(column).index_copy_(0, place, column) for column in columns)


def class_factors(free: Tensor, occupied: Tensor, occupied_share: float = 0.5) -> Tensor:
    """(2,) loss factors of a free and an occupied point, so that the classes share the loss.

    Over all points they have mean 1. With a single class present both are 1.

    Args:
        free: () how many points are free, or what they count.
        occupied: () the same of the occupied points.
        occupied_share: of the loss.
    """
    total = free + occupied
    balanced = total * torch.stack([(1 - occupied_share) / free, occupied_share / occupied])
    return torch.where((occupied > 0) & (free > 0), balanced, torch.ones_like(balanced))


def label_factors(
    labels: Tensor, occupied_share: float = 0.5, unknown_share: float = 0.25
) -> Tensor:
    """(N,) labels -> (3,) loss factors of a free, an unknown and an occupied point, float64.

    Those of `class_factors`; the unknown points together count ``unknown_share`` of the others.
    """
    occupied = (labels > 0.5).sum().double()
    unknown = (labels == 0.5).sum().double()
    known = len(labels) - unknown
    free, hit = class_factors(known - occupied, occupied, occupied_share).unbind()
    return torch.stack([free, unknown_share * known / unknown.clamp(min=1), hit])


def balance_classes(
    labels: Tensor, occupied_share: float = 0.5, unknown_share: float = 0.25
) -> Tensor:
    """(N,) labels -> (N,) loss factors, see `label_factors`."""
    factors = label_factors(labels, occupied_share, unknown_share).to(labels)
    return factors[(2 * labels).long()]


def logistic_loss(log_odds: Tensor, labels: Tensor, factors: Tensor) -> Tensor:
    """Sum of the points' negative log-likelihoods, the data term of eq. (3).

    Eq. (3) as printed lacks the logarithm that eq. (2) asks for; this has it.
    """
    loss = torch.nn.functional.binary_cross_entropy_with_logits
    return loss(log_odds, labels, factors, reduction="sum")


def fit_weights(
    features_of: FeaturesOf,
    labels: Tensor,
    weights: Tensor,
    config: FitConfig,
    progress: bool = False,
    factors: Tensor | None = None,
) -> Tensor:
    """Weights that minimize the regularized loss, from the given start.

    w <- w - eta_t A^-1 g, with g the gradient of a batch scaled to all points. The preconditioner
    A is the running root mean square of g, and g is smoothed over steps (Adam), so that weights of
    rarely seen clusters learn as fast as others. Points are taken in the order given: bring them
    into that of `deal_samples` first. Features are computed once and kept up to `CACHE_BYTES`,
    the others anew for every two passes, which then come at once.

    Args:
        features_of: slice of B rows -> indices (B, K) and kernel values (B, K) of those points.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown, in the order of `deal_samples`.
        weights: (M,) start, left as it is.
        config: passes, rates and regularizer.
        progress: show a bar on a terminal.
        factors: (N,) what each point's loss counts, mean 1; None: as the config says.

    Returns:
        (M,) weights.

    Source: Guizilini & Ramos 2016, eq. (2) to (4).
    """
    if factors is None:
        shares = (config.occupied_share, config.unknown_share)
        factors = balance_classes(labels, *shares) if config.balance else torch.ones_like(labels)
    batch_size = config.rows_a_batch(len(labels))
    passes = config.passes_over(len(labels))
    plan = _Plan(config, batch_size, len(labels), passes * -(-len(labels) // batch_size))
    features = _Features(features_of, batch_size * max(1, CHUNK_ROWS // batch_size))
    state = (weights.clone(), torch.zeros_like(weights), torch.zeros_like(weights))
    step = 0
    for passed in tqdm(range(passes), "weights", disable=None if progress else True):
        for rows in features.chunks(len(labels)):
            if passed % 2 and not features.keeps(rows):
                continue
            chunk = _Chunk(*features[rows], labels[rows], factors[rows])
            steps = _native_steps if native.descends(*chunk[:2]) else _plain_steps
            for _ in range(1 if features.keeps(rows) else min(2, passes - passed)):
                state = steps(chunk, state, step, plan)
                step += -(-len(chunk.labels) // batch_size)
    return state[0]


class _Plan(NamedTuple):
    config: FitConfig
    batch_size: int
    num_points: int
    total_steps: int


class _Chunk(NamedTuple):
    """Some whole batches: (R, K) features, (R,) labels and loss factors."""

    indices: Tensor
    values: Tensor
    labels: Tensor
    factors: Tensor


class _Features:
    """Features of chunks of rows; as many as fit are kept."""

    def __init__(self, features_of: FeaturesOf, chunk_rows: int) -> None:
        self.features_of, self.chunk_rows = features_of, chunk_rows
        self.kept: dict[int, tuple[Tensor, Tensor]] = {}
        self.room = CACHE_BYTES

    def chunks(self, num_rows: int) -> Iterator[slice]:
        """Slices that cover all rows, in order."""
        for start in range(0, num_rows, self.chunk_rows):
            yield slice(start, min(num_rows, start + self.chunk_rows))

    def keeps(self, rows: slice) -> bool:
        """Whether the features of a chunk are at hand."""
        return rows.start in self.kept

    def __getitem__(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Indices and kernel values (R, K) of one chunk."""
        if self.keeps(rows):
            return self.kept[rows.start]
        found = self.features_of(rows)
        size = sum(tensor.numel() * tensor.element_size() for tensor in found)
        if size <= self.room:
            self.kept[rows.start] = found
            self.room -= size
        return found


def _plain_steps(chunk: _Chunk, state: State, step: int, plan: _Plan) -> State:
    """A step for every batch of the chunk: the definition."""
    config = plan.config
    batches = zip(*(tensor.split(plan.batch_size) for tensor in chunk), strict=True)
    for step_now, (indices, values, labels, factors) in enumerate(batches, start=step):
        slope = batch_gradient(indices, values, labels, factors, state[0]) / len(labels)
        rate = config.learning_rate * (1 - step_now / plan.total_steps if config.decay else 1.0)
        state = descend(state, slope, step_now + 1, rate, plan.num_points, config)
    return state


def _native_steps(chunk: _Chunk, state: State, step: int, plan: _Plan) -> State:
    """The same in the native library."""
    config = plan.config
    return torch.ops.lardhm.descent(
        *chunk, *state, plan.num_points, plan.batch_size, step, plan.total_steps,
        config.learning_rate, config.decay, config.preconditioner, config.l1, config.l2,
    )  # fmt: skip


def batch_gradient(
    indices: Tensor, values: Tensor, labels: Tensor, factors: Tensor, weights: Tensor
) -> Tensor:
    """(M,) gradient of the batch's loss with respect to the weights: Phi^T (p - y)."""
    log_odds = (values * weights[indices]).sum(dim=1)
    residuals = factors * (torch.sigmoid(log_odds) - labels)
    pulls = (residuals[:, None] * values).reshape(-1)
    return torch.zeros_like(weights).index_add_(0, indices.reshape(-1), pulls)


def descend(
    state: State, slope: Tensor, step: int, rate: float, num_points: int, config: FitConfig
) -> State:
    """One step of eq. (4) on the mean loss; l1 acts as a soft threshold after it.

    Args:
        state: (M,) weights and the running mean and mean square of the slope.
        slope: (M,) gradient of the batch's mean loss.
        step: number of this step, from 1.
        rate: eta_t.
        num_points: N, over which the regularizer is spread.
        config: regularizer and preconditioner.
    """
    weights, mean, square = state
    slope = slope + 2 * config.l2 / num_points * weights
    if not config.preconditioner:
        moved, reach = weights - rate * slope, torch.full_like(weights, rate)
    else:
        mean = 0.9 * mean + 0.1 * slope
        square = 0.99 * square + 0.01 * slope.square()
        reach = rate / ((square / (1 - 0.99**step)).sqrt() + 1e-10)
        moved = weights - reach * mean / (1 - 0.9**step)
    if config.l1:
        threshold = reach * config.l1 / num_points
        moved = moved.sign() * (moved.abs() - threshold).clamp(min=0)
    return moved, mean, square
