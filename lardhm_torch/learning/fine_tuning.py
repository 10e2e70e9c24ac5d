"""Joint optimization of length scales, centers and weights by backpropagation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.changes import changes_map
from lardhm_torch.learning.class_balance import balance_classes
from lardhm_torch.learning.fitting import logistic_loss, stratified_batches
from lardhm_torch.learning.parameters import MapParameters, read_state
from lardhm_torch.learning.points import (
    blurred_hits,
    check_noise,
    check_samples,
    in_morton_order,
    to_map_frame,
)
from lardhm_torch.learning.tuning_steps import (
    Batches,
    Moving,
    Plan,
    Table,
    from_rows,
    to_rows,
    tuning_steps,
)
from lardhm_torch.learning.unseen import settle_unknown
from lardhm_torch.sampling import UNKNOWN, Samples
from lardhm_torch.scans import seeded_generator

MAX_BATCH = 1 << 15  # upper bound on the default batch size
GROUP_ROWS = 1 << 21  # number of points whose neighbors are in memory at a time
State = dict[str, Any]  # tensors and plain values, for `torch.save` and `torch.load`
EVALUATION_POINTS = 1 << 16  # number of points used to evaluate the loss after each epoch


@changes_map
def fine_tune(
    model: MapParameters,
    points: Tensor,
    labels: Tensor,
    *,
    ray_id: Tensor | None = None,
    resample: Callable[[int], Samples] | None = None,
    seed: int = 0,
    state: State | None = None,
    after_epoch: Callable[[State], None] | None = None,
    progress: bool = False,
    config: TuneConfig | None = None,
) -> list[float]:
    """Optimize centers, length scales and weights of a fitted map on the balanced log-loss.

    The optimizer is Adam with a short warm-up and a linear decay of the learning rates to 0. Offsets
    of centers are in units of the mean length scale of their cluster, and the diagonals of factors
    are optimized as logarithms. Learning rates are therefore independent of the scene, and every
    factor remains valid. In each epoch the neighbors are searched once, and several passes over the
    points are made in groups, so that the memory for neighbors does not grow with the number of
    points. With ``hold_out``, a fraction of the rays is excluded from training, and the parameters of
    the epoch with the smallest loss on them are kept. The initial map is not a candidate, because
    `fit` has used those rays. If anything fails, the map is unchanged.

    Args:
        model: a fitted map, changed in place.
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free, 1/2 unknown. If there are unknown points, more are drawn in the
            tails of the kernels in every epoch, as in `fit`, so kernels do not extend into unknown space.
        ray_id: (N,) ray of each point, so that complete rays are held out (`Samples.ray_id`);
            None: points are held out individually.
        resample: function that returns new samples of the same rays, given the number of the epoch
            (from 1). New free points in every epoch reduce overfitting:
            ``lambda epoch: sample_rays(scans, seed=seed + epoch)``.
        seed: random seed of the hold-out and the batches.
        state: state passed to ``after_epoch`` in an earlier run, which is resumed. The result is that
            of an uninterrupted run if all other arguments are the same.
        after_epoch: callback that receives the state after every epoch, e.g. to save it.
        progress: show a progress bar on a terminal.
        config: learning rates, epochs and parameters to optimize; None: the defaults.

    Returns:
        Mean balanced log-loss on held-out points (on training points if none are held out), before
        the first epoch and after each epoch.

    Raises:
        ValueError: the map is empty or packed, no parameter is to be optimized, the samples are
            invalid (see `fit`), or the state belongs to a different map or config.
    """
    config = config or TuneConfig()
    _check_task(model, config, resample is not None and ray_id is None)
    with_unknown = config.unknown_share > 0
    samples = _check(model, points, labels, ray_id, with_unknown)
    rng = seeded_generator(seed, "fine_tune", model.origin.device)
    held_rays = _hold_out(samples, config.hold_out, rng)
    train, evaluation = _divide(samples, held_rays)
    seen = blurred_hits(evaluation.positions, evaluation.labels, config.hit_noise, rng)
    evaluation = evaluation._replace(positions=seen)
    run = TuningRun(model, config, rng, evaluation)
    run.load(state) if state else run.losses.append(run.evaluate())
    for epoch in run.epochs(progress):
        if resample and epoch:
            fresh = resample(epoch)
            drawn = _check(model, fresh.points, fresh.labels, fresh.ray_id, with_unknown)
            train = _divide(drawn, held_rays)[0]
        run.train(train)
        if after_epoch:
            after_epoch(run.state())
    with torch.no_grad(), model.lock.writing():
        for parameter, value in zip(run.parameters_of_map(), from_rows(run.best), strict=True):
            parameter.copy_(value)
    return run.losses


def _check_task(model: MapParameters, config: TuneConfig, rays_are_unknown: bool) -> None:
    model.check_learns()
    if len(model) == 0:
        raise ValueError("model must be fitted before it is tuned; it is empty. Call fit first")
    if not (config.tune_weights or config.tune_centers or config.tune_scales):
        raise ValueError("config must leave weights, centers or scales to tune; it freezes all")
    if config.hold_out and rays_are_unknown:
        raise ValueError("ray_id must be given if held-out rays are sampled again; got none")


def _check(
    model: MapParameters,
    points: Tensor,
    labels: Tensor,
    ray_id: Tensor | None,
    with_unknown: bool = True,
) -> LabelledPoints:
    """The samples, checked, in the map's frame and in Morton order."""
    device, dtype = model.origin.device, model.centers.dtype
    points, labels = check_samples(points, labels, model.dim, device, keep_unknown=True)
    known = labels != UNKNOWN
    if not bool(known.any()):
        raise ValueError("labels must hold 0 or 1; all are 1/2 (unknown)")
    rays = torch.arange(len(points), device=device)
    if ray_id is not None:
        rays = torch.as_tensor(ray_id, device=device)
        if rays.shape != labels.shape:
            raise ValueError(
                f"ray_id must be ({len(labels)},), one per point; got {tuple(rays.shape)}"
            )
    if not with_unknown:
        points, labels, rays = points[known], labels[known], rays[known]
    local = to_map_frame(points, model.origin, dtype)
    return LabelledPoints(*in_morton_order(local, labels.to(dtype), rays))


def _hold_out(samples: LabelledPoints, fraction: float, rng: torch.Generator) -> Tensor | None:
    """IDs of a random fraction of the rays; None if none or all."""
    if not fraction:
        return None
    ids = samples.ray_id.unique()
    held = ids[torch.rand(len(ids), generator=rng, device=rng.device) < fraction]
    return held if 0 < len(held) < len(ids) else None


def _divide(
    samples: LabelledPoints, held_rays: Tensor | None
) -> tuple[LabelledPoints, LabelledPoints]:
    """Training points, and evaluation points: held-out ones, or a subset of the training points.

    Unknown points are not evaluated.
    """
    train = evaluation = samples
    if held_rays is not None:
        held = torch.isin(samples.ray_id, held_rays)
        train, evaluation = (
            LabelledPoints(*(column[rows] for column in samples)) for rows in (~held, held)
        )
    evaluation = LabelledPoints(*(part[evaluation.labels != UNKNOWN] for part in evaluation))
    every = max(1, -(-len(evaluation.labels) // EVALUATION_POINTS))
    return train, LabelledPoints(*(column[::every] for column in evaluation))


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Settings of fine-tuning. Learning rates are relative to the size of each cluster.

    ``l2`` and ``stiffness`` are relative to the summed loss of all points.
    """

    epochs: int = 4  # number of epochs; neighbors, and samples with ``resample``, are new in each
    passes: int = 3  # passes over the samples in each epoch
    batch_size: int | None = None  # points per step; None: N / 64, between 1024 and `MAX_BATCH`
    weight_rate: float = 0.1
    center_rate: float = 0.02  # learning rate of centers, relative to the mean length scale
    scale_rate: float = 0.02  # learning rate of the logarithm of the length scales
    l2: float = 0.25  # penalty on squared weights
    stiffness: float = 0.8  # penalty on squared offsets of centers and length scales
    occupied_share: float = 0.6  # class weight of occupied points, see `fitting.FitConfig`
    hit_noise: float = 0.0  # [m] random displacement of hits in training, see `FitConfig`
    unknown_share: float = 0.1  # relative loss of unknown points, see `FitConfig`; 0: omit them
    hold_out: float = 0.0  # fraction of rays used to select the best epoch; 0: keep the last
    patience: int | None = None  # stop after this many epochs without improvement
    tune_weights: bool = True
    tune_centers: bool = True
    tune_scales: bool = True

    def __post_init__(self) -> None:
        for name in ("epochs", "passes", "batch_size", "patience"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be 1 or more; got {value}")
        rates = (self.weight_rate, self.center_rate, self.scale_rate)
        if not min(rates) > 0:
            raise ValueError(f"rates must be > 0; got {rates}")
        if not min(self.l2, self.stiffness) >= 0:
            raise ValueError(
                f"l2 and stiffness must be 0 or more; got {self.l2} and {self.stiffness}"
            )
        check_noise(self.hit_noise)
        if not 0 < self.occupied_share < 1:
            raise ValueError(f"occupied_share must be in (0, 1); got {self.occupied_share}")
        if not self.unknown_share >= 0:
            raise ValueError(f"unknown_share must be 0 or more; got {self.unknown_share}")
        if not 0 <= self.hold_out < 1:
            raise ValueError(f"hold_out must be at least 0 and below 1; got {self.hold_out}")
        if self.patience is not None and not self.hold_out:
            raise ValueError(f"patience needs held-out rays; got hold_out = {self.hold_out}")


def tuned_table(start: Tensor, config: TuneConfig, kernel: Kernel) -> Table:
    """What stays the same during a run: units relative to the cluster sizes, rates and penalties.

    Args:
        start: (M, G) parameters before tuning, see `to_rows`.
        config: rates and penalties.
        kernel: settings of the map.
    """
    _, centers, raw = from_rows(start)
    dim = centers.shape[1]
    size = raw.diagonal(dim1=-2, dim2=-1).mean(dim=1).exp()[:, None]
    size = kernel.covariance_scale**0.5 * size.clamp(min=kernel.min_lengthscale)
    eye = torch.eye(dim, dtype=torch.bool, device=size.device)
    unit = to_rows(  # size: (M, 1) mean length scale of the kernels [m]
        torch.ones_like(size[:, 0]),
        size.expand(-1, dim),
        torch.where(eye, torch.ones_like(size)[..., None], size[..., None]),
    )

    def per_column(weight: float, center: float, scale: float) -> Tensor:
        values = [weight] + dim * [center] + dim * (dim + 1) // 2 * [scale]
        return torch.tensor(values, dtype=torch.float64, device=start.device)

    rates = per_column(
        config.weight_rate * config.tune_weights,
        config.center_rate * config.tune_centers,
        config.scale_rate * config.tune_scales,
    )
    penalties = per_column(config.l2, config.stiffness, config.stiffness)
    return Table(start, unit, rates, penalties, kernel)


class LabelledPoints(NamedTuple):
    """(N, D) positions in the map's frame [m], (N,) labels, and (N,) ray IDs."""

    positions: Tensor
    labels: Tensor
    ray_id: Tensor


class TuningRun:
    """State of an optimization run. Offsets of parameters are in units of the cluster size."""

    def __init__(
        self,
        model: MapParameters,
        config: TuneConfig,
        rng: torch.Generator,
        evaluation: LabelledPoints,
    ) -> None:
        self.model, self.config, self.rng, self.evaluation = model, config, rng, evaluation
        self.epoch, self.step, self.losses = 0, 0, list[float]()
        self._start_from(to_rows(*(value.detach() for value in self.parameters_of_map())))

    def _start_from(self, start: Tensor) -> None:
        self.best, self.table = start, tuned_table(start, self.config, self.model.kernel)
        self.moving = Moving.at_start(start)

    def parameters_of_map(self) -> tuple[Tensor, Tensor, Tensor]:
        """Weights, centers and raw factors of the map."""
        return self.model.weights, self.model.centers, self.model.raw_scale_tril

    def epochs(self, progress: bool) -> Iterator[int]:
        """Numbers of the epochs to train; the loss is evaluated after each of them."""
        config, left = self.config, None if progress else True
        with tqdm(total=config.epochs, initial=self.epoch, disable=left) as bar:
            while self.epoch < config.epochs and not self.stalled():
                yield self.epoch
                bar.set_postfix(loss=f"{self.losses[-1]:.4f}")
                bar.update()

    def train(self, samples: LabelledPoints) -> None:
        """Train for one epoch over the points, and keep the parameters if they are the best."""
        positions, targets = self._with_unknown(samples)
        config, count = self.config, len(targets)
        groups = -(-count // GROUP_ROWS)
        wanted = config.batch_size or min(MAX_BATCH, max(1024, count // 64))
        batch_size = -(-count // (groups * -(-count // (groups * wanted))))
        steps = [-(-len(range(group, count, groups)) // batch_size) for group in range(groups)]
        total = self.step + (config.epochs - self.epoch) * config.passes * sum(steps)
        plan = Plan(count, batch_size, total)
        factors = balance_classes(targets, config.occupied_share, config.unknown_share)
        for group, steps_per_pass in enumerate(steps):
            columns = (positions, targets, factors)
            points, labels, weights = (column[group::groups].contiguous() for column in columns)
            points = blurred_hits(points, labels, config.hit_noise, self.rng)
            near = self._neighbors(points)
            *batches, near = stratified_batches(
                (points, labels, weights, near), batch_size, self.rng
            )
            for _ in range(config.passes):
                self.moving = tuning_steps(
                    Batches(*batches), near, self.table, self.moving, self.step, plan
                )
                self.step += steps_per_pass
        self.epoch += 1
        self._keep_best(self.evaluate())

    def _with_unknown(self, samples: LabelledPoints) -> tuple[Tensor, Tensor]:
        """Positions and labels of the samples, with unknown points where `fit` places them."""
        positions, labels, _ = samples
        _, centers, raw = self.table.parameters(self.moving.offsets)
        state = replace(read_state(self.model), centers=centers, raw_scale_tril=raw)
        return settle_unknown(positions, labels, state, self.model.kernel, self.rng)

    def _neighbors(self, points: Tensor) -> Tensor:
        _, centers, raw = self.table.parameters(self.moving.offsets)
        index = native.build_index(centers, self.model.num_neighbors)
        return native.nearest_features(points, centers, raw, self.model.kernel, index)[0]

    @torch.no_grad()
    def evaluate(self) -> float:
        """Mean balanced log-loss on the evaluation points."""
        points, labels, _ = self.evaluation
        weights, centers, raw = self.table.parameters(self.moving.offsets)
        answer = native.occupancy(
            points, centers, raw, weights, self.model.kernel, probability=False
        )
        return float(logistic_loss(answer, labels, balance_classes(labels))) / len(answer)

    def _keep_best(self, loss: float) -> None:
        """Record the loss of the epoch, and its parameters if the loss is the smallest so far."""
        self.losses.append(loss)
        if not self.config.hold_out or loss <= min(self.losses[1:]):
            self.best = self.table.start + self.table.unit * self.moving.offsets

    def stalled(self) -> bool:
        """Whether the loss has not improved for ``patience`` epochs."""
        patience, losses = self.config.patience, self.losses[1:]
        return patience is not None and len(losses) - 1 - _last_best(losses) >= patience

    def state(self) -> State:
        """State of the run as tensors and plain Python values."""
        return {
            "config": asdict(self.config),
            "epoch": self.epoch,
            "step": self.step,
            "losses": list(self.losses),
            "start": self.table.start,
            **self.moving._asdict(),
            "best": self.best,
            "rng": self.rng.get_state(),
        }

    def load(self, state: State) -> None:
        """Resume from a state."""
        if state["config"] != asdict(self.config):
            raise ValueError(f"state must belong to this config; got {state['config']}")
        start = self.table.start
        if state["start"].shape != start.shape:
            raise ValueError(
                f"state must be of a map with {len(start)} clusters; got {len(state['start'])}"
            )
        self._start_from(state["start"].to(start))
        self.moving = Moving(*(state[name].to(start) for name in Moving._fields))
        self.epoch, self.step, self.losses = state["epoch"], state["step"], list(state["losses"])
        self.best = state["best"].to(start)
        self.rng.set_state(state["rng"])


def _last_best(losses: list[float]) -> int:
    return max((row for row, loss in enumerate(losses) if loss <= min(losses)), default=0)
