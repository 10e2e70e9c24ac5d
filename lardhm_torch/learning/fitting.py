"""Batch training of a map: clustering, then stochastic gradient descent on the weights (eq. 2-4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import ordered_features
from lardhm_torch.learning.bridging import bridged
from lardhm_torch.learning.class_balance import balance_classes
from lardhm_torch.learning.clustering import ITERATIONS_OF, ROUGH_ITERATIONS, group_classes
from lardhm_torch.learning.evidence import fitted_evidence
from lardhm_torch.learning.map_state import MapState, new_rows
from lardhm_torch.learning.points import blurred_hits, check_noise
from lardhm_torch.learning.unseen import even_kernels, settle_unknown

CHUNK_ROWS = 1 << 21  # number of points whose features are computed at a time
PASSES, MIN_STEPS = 4, 256  # small data sets need more passes for enough steps
CACHE_BYTES = 1 << 28  # upper bound on the size of the feature cache
State = tuple[Tensor, Tensor, Tensor]  # weights, running mean and mean square of the gradient
FeaturesOf = Callable[[slice], tuple[Tensor, Tensor]]


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Training settings of the weights.

    The defaults train to convergence. The settings of the paper, one pass at a constant learning rate
    without preconditioner, are ``FitConfig(passes=1, learning_rate=0.1, decay=False,
    preconditioner=False, batch_size=1)``; the log-loss is then higher (see docs and benchmarks).
    """

    passes: int | None = None  # passes over all points; None: 4, or more to reach `MIN_STEPS` steps
    batch_size: int | None = None  # points per step; None: N / 128, at least 256
    learning_rate: float = 0.5  # eta in eq. (4)
    decay: bool = True  # eta falls linearly to 0; otherwise constant
    preconditioner: bool = True  # A in eq. (4): running root mean square gradient; else identity
    l2: float = 0.03  # lambda_1 in eq. (2), relative to the summed loss of all points
    l1: float = 0.0  # lambda_2 in eq. (2), by soft thresholding, so weights can be exactly 0
    balance: bool = True  # weight the classes independently of their numbers of points
    # Class weight of occupied points, as a fraction of the loss, if classes are balanced. It exceeds
    # one half because hits are fewer than free points, so they generalize less well to unseen rays.
    occupied_share: float = 0.6
    unknown_share: float = 0.25  # weight of the loss of unknown points, relative to all others
    bridge_gaps: bool = True  # extend surfaces across gaps that no ray crossed (`bridging`)
    # [m] standard deviation of random displacements of hits while the weights are trained. Surfaces are
    # then as thick as scans disagree (`scan_disagreement`), for queries at the poses of other scans.
    hit_noise: float = 0.0
    # passes that train the shapes of a small map, about a third of the default: the number of clusters
    # is chosen by the held-out loss of a coarse map (`scene_clusters`). Probabilities are as accurate,
    # but ranges and meshes are less exact. 4 is recommended; 0: off.
    shape_passes: int = 0
    # also train centers and length scales (`shaping`): lower log-loss, but updates lose thin poles
    adapt_shapes: bool = False

    def rows_per_batch(self, num_points: int) -> int:
        """Points per step: about ``batch_size``, with equally large batches in each pass."""
        wanted = self.batch_size or max(256, num_points // 128)
        return -(-num_points // -(-num_points // wanted)) if num_points else wanted

    def passes_over(self, num_points: int) -> int:
        """Number of passes over ``num_points`` points."""
        batches = max(1, -(-num_points // self.rows_per_batch(num_points)))
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
        for name in ("unknown_share", "shape_passes", "l1", "l2"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be 0 or more; got {getattr(self, name)}")
        check_noise(self.hit_noise)


class FitTask(NamedTuple):
    """Settings and random generator of a fit."""

    kernel: Kernel
    config: FitConfig
    rng: torch.Generator
    progress: bool = False


class Batched(NamedTuple):
    """(N, D) points [m] and (N,) labels in the order of `stratified_batches`, and their features."""

    points: Tensor
    labels: Tensor
    features_of: FeaturesOf


def fit_clusters(
    points: Tensor,
    labels: Tensor,
    num_clusters: int | Sequence[int] | None,
    task: FitTask,
    refine: Callable[[MapState, Batched, FitTask], MapState] | None = None,
) -> MapState:
    """Cluster each class of the samples separately and train the weights.

    Args:
        points: (N, D) positions in the map's frame [m], in Morton order.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown, of the points' dtype.
        num_clusters: total over all classes, or one number for each; None: chosen from the data.
        task: kernel, settings, random generator.
        refine: continues the training, with the samples in batches.

    Source: Guizilini & Ramos 2016, Sections II and III.
    """
    floor = task.kernel.min_lengthscale
    iterations = ROUGH_ITERATIONS if task.config.adapt_shapes else ITERATIONS_OF
    grouped = group_classes(points, labels, num_clusters, task.rng, iterations)
    state = even_kernels(new_rows(*grouped[:2], floor, fitted_evidence(grouped)), floor)
    if task.config.bridge_gaps:
        state, points, labels = bridged(state, points, labels, task.kernel, task.rng)
    points, labels = settle_unknown(points, labels, state, task.kernel, task.rng)
    points = blurred_hits(points, labels, task.config.hit_noise, task.rng)
    order = torch.arange(len(points), device=points.device)
    batch_size = task.config.rows_per_batch(len(points))
    order, mixed, labels = stratified_batches((order, points, labels), batch_size, task.rng)
    index = native.build_index(state.centers, task.kernel.num_neighbors)

    def compute(rows: slice) -> tuple[Tensor, Tensor]:
        given = (state.centers, state.raw_scale_tril, task.kernel, index)
        if len(order[rows]) == len(points):
            return ordered_features(points, order, *given)
        return native.nearest_features(mixed[rows], *given)

    features_of = _LastFeatures(compute)
    weights = fit_weights(features_of, labels, state.weights, task.config, task.progress)
    state = replace(state, weights=weights)
    if refine is None:
        return state
    return refine(state, Batched(mixed, labels, features_of), task)


class _LastFeatures:
    """A function of rows that keeps its last result, which serves two kinds of training."""

    def __init__(self, features_of: FeaturesOf) -> None:
        self.features_of = features_of
        self.rows, self.found = slice(0), (torch.empty(0), torch.empty(0))

    def __call__(self, rows: slice) -> tuple[Tensor, Tensor]:
        if rows != self.rows:
            self.rows, self.found = rows, self.features_of(rows)
        return self.found


def stratified_batches(
    columns: tuple[Tensor, ...], batch_size: int, rng: torch.Generator
) -> tuple[Tensor, ...]:
    """Reorder samples from Morton order into consecutive stratified mini-batches, for `fit_weights`.

    With B batches, each run of B consecutive samples contributes one sample to every batch, with a
    random rotation per run. Every batch therefore covers all space, more evenly than a random sample,
    and within a batch samples that are close in space are close in memory.

    Args:
        columns: (N, ...) positions, labels or features of the samples, in the order of `morton_order`.
        batch_size: samples per batch.
        rng: random generator.

    Returns:
        (N, ...) the same columns, batch after batch.
    """
    count = len(columns[0])
    batches = max(1, -(-count // batch_size))
    rounds = -(-count // batches)
    first = torch.randint(batches, (rounds, 1), generator=rng, device=rng.device)
    turn = torch.randperm(batches, generator=rng, device=rng.device)
    batch = torch.cat([turn, turn])[torch.arange(batches, device=rng.device) + first]  # (rounds, B)
    last = batch.reshape(-1)[count // batches * batches : count]
    sizes = count // batches + torch.bincount(last, minlength=batches)
    place = (sizes.cumsum(0) - sizes)[batch] + torch.arange(rounds, device=rng.device)[:, None]
    # Sequential reads with scattered writes are several times faster than a gather.
    place = place.reshape(-1)[:count]
    return tuple(torch.empty_like(column).index_copy_(0, place, column) for column in columns)


def loss_factors(labels: Tensor, config: FitConfig) -> Tensor:
    """(N,) labels -> (N,) loss factors with the class weights of the settings."""
    shares = (config.occupied_share, config.unknown_share)
    return balance_classes(labels, *shares) if config.balance else torch.ones_like(labels)


def logistic_loss(log_odds: Tensor, labels: Tensor, factors: Tensor) -> Tensor:
    """Sum of the points' negative log-likelihoods, the data term of eq. (3).

    Eq. (3) as printed lacks the logarithm required by eq. (2); it is included here.
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
    """Minimize the regularized loss by stochastic gradient descent from the given weights.

    w <- w - eta_t A^-1 g, where g is the gradient of a batch scaled to all points. The preconditioner
    A is the running root mean square of g, and g is averaged over steps (Adam), so that weights of
    rarely observed clusters converge as fast as others. Points are used in the given order, which
    should be that of `stratified_batches`. Features are cached up to `CACHE_BYTES`. For chunks that
    do not fit, features are computed once per two passes, which are then run back to back.

    Args:
        features_of: function of a slice of B rows that returns (B, K) indices and kernel values.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown, in the order of `stratified_batches`.
        weights: (M,) initial weights; not modified.
        config: passes, rates and regularizer.
        progress: show a progress bar on a terminal.
        factors: (N,) loss factor of each point, mean 1; None: determined by ``config``.

    Returns:
        (M,) weights.

    Source: Guizilini & Ramos 2016, eq. (2) to (4).
    """
    factors = loss_factors(labels, config) if factors is None else factors
    batch_size = config.rows_per_batch(len(labels))
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
    """A number of complete batches: (R, K) features, (R,) labels and loss factors."""

    indices: Tensor
    values: Tensor
    labels: Tensor
    factors: Tensor


class _Features:
    """Features of chunks of rows, with a cache of bounded size."""

    def __init__(self, features_of: FeaturesOf, chunk_rows: int) -> None:
        self.features_of, self.chunk_rows = features_of, chunk_rows
        self.cache: dict[int, tuple[Tensor, Tensor]] = {}
        self.free_bytes = CACHE_BYTES

    def chunks(self, num_rows: int) -> Iterator[slice]:
        """Slices that cover all rows, in order."""
        for start in range(0, num_rows, self.chunk_rows):
            yield slice(start, min(num_rows, start + self.chunk_rows))

    def keeps(self, rows: slice) -> bool:
        """Whether the features of a chunk are cached."""
        return rows.start in self.cache

    def __getitem__(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Indices and kernel values (R, K) of one chunk."""
        if self.keeps(rows):
            return self.cache[rows.start]
        found = self.features_of(rows)
        size = sum(tensor.numel() * tensor.element_size() for tensor in found)
        if size <= self.free_bytes:
            self.cache[rows.start] = found
            self.free_bytes -= size
        return found


def _plain_steps(chunk: _Chunk, state: State, step: int, plan: _Plan) -> State:
    """One step for every batch of the chunk, in plain torch."""
    config = plan.config
    batches = zip(*(tensor.split(plan.batch_size) for tensor in chunk), strict=True)
    for step_now, (indices, values, labels, factors) in enumerate(batches, start=step):
        slope = batch_gradient(indices, values, labels, factors, state[0]) / len(labels)
        rate = config.learning_rate * (1 - step_now / plan.total_steps if config.decay else 1.0)
        state = descend(state, slope, step_now + 1, rate, plan.num_points, config)
    return state


def _native_steps(chunk: _Chunk, state: State, step: int, plan: _Plan) -> State:
    """The same as `_plain_steps`, in the native library."""
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
    terms = (residuals[:, None] * values).reshape(-1)
    return torch.zeros_like(weights).index_add_(0, indices.reshape(-1), terms)


def descend(
    state: State, slope: Tensor, step: int, rate: float, num_points: int, config: FitConfig
) -> State:
    """One step of eq. (4) on the mean loss, followed by a soft threshold if ``l1`` > 0.

    Args:
        state: (M,) weights, running mean and running mean square of the gradient.
        slope: (M,) gradient of the batch's mean loss.
        step: number of this step, from 1.
        rate: eta_t.
        num_points: N; the regularizer is divided by it.
        config: regularizer and preconditioner.
    """
    weights, mean, square = state
    slope = slope + 2 * config.l2 / num_points * weights
    if not config.preconditioner:
        moved, step_size = weights - rate * slope, torch.full_like(weights, rate)
    else:
        mean = 0.9 * mean + 0.1 * slope
        square = 0.99 * square + 0.01 * slope.square()
        step_size = rate / ((square / (1 - 0.99**step)).sqrt() + 1e-10)
        moved = weights - step_size * mean / (1 - 0.9**step)
    if config.l1:
        threshold = step_size * config.l1 / num_points
        moved = moved.sign() * (moved.abs() - threshold).clamp(min=0)
    return moved, mean, square
