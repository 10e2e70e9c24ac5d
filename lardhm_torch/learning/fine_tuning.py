"""Joint optimization of length-scales, centers and weights by backpropagation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import native
from lardhm_torch.learning.fitting import balance_classes, label_factors, logistic_loss
from lardhm_torch.learning.parameters import MapParameters
from lardhm_torch.points import UNKNOWN, as_tensor, check_samples, to_map_frame
from lardhm_torch.sampling import Samples, seeded_generator

WARM_UP_STEPS = 20  # number of steps of the learning rate warm-up
MAX_BATCH = 1 << 15  # upper bound on the default batch size, to limit memory
State = dict[str, Any]  # tensors and plain values, for `torch.save` and `torch.load`
EVALUATION_POINTS = 1 << 16  # number of points used to evaluate the loss after each epoch


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
    """Optimize centers, length-scales and weights of a fitted map on the balanced log-loss.

    The optimizer is Adam with a short warm-up and a linear decay of the learning rates to 0. Offsets
    of centers are in units of the mean length-scale of their cluster, and the diagonals of factors
    are optimized as logarithms. Learning rates are therefore independent of the scene, and every
    factor remains valid. Neighbors are searched anew in every step. Points are processed in batches,
    so memory does not grow with their number. With ``hold_out``, a fraction of the rays is excluded
    from training, and the parameters of the epoch with the smallest loss on them are kept. The
    initial map is not a candidate, because `fit` has used those rays. If anything fails, the map is
    unchanged.

    Args:
        model: a fitted map, changed in place.
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free; unknown points (1/2) are left out.
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
        ValueError: the map is empty, no parameter is to be optimized, the samples are invalid (see
            `fit`), or the state belongs to a different map or config.
    """
    config = config or TuneConfig()
    model.check_learns()
    if len(model) == 0:
        raise ValueError("model must be fitted before it is tuned; it is empty. Call fit first")
    if not (config.tune_weights or config.tune_centers or config.tune_scales):
        raise ValueError("config must leave weights, centers or scales to tune; it freezes all")
    samples = _check(model, points, labels, ray_id)
    if resample and config.hold_out and ray_id is None:
        raise ValueError(
            "ray_id must be given where held-out rays are to be sampled anew; got none"
        )
    rng = seeded_generator(seed, "fine_tune", model.origin.device)
    held_rays = _hold_out(samples, config.hold_out, rng)
    train, evaluation = _divide(samples, held_rays)
    run = TuningRun(model, config, rng)
    run.load(state) if state else run.losses.append(run.evaluate(evaluation))
    with tqdm(total=config.epochs, initial=run.epoch, disable=None if progress else True) as bar:
        while run.epoch < config.epochs and not run.stalled():
            if resample and run.epoch:
                fresh = resample(run.epoch)
                fresh_samples = _check(model, fresh.points, fresh.labels, fresh.ray_id)
                train = _divide(fresh_samples, held_rays)[0]
            run.train(train)
            run.keep_best(run.evaluate(evaluation))
            bar.set_postfix(loss=f"{run.losses[-1]:.4f}")
            bar.update()
            if after_epoch:
                after_epoch(run.state())
    with torch.no_grad():
        for parameter, value in zip(run.parameters_of_map(), run.best, strict=True):
            parameter.copy_(value)
    return run.losses


def _check(
    model: MapParameters, points: Tensor, labels: Tensor, ray_id: Tensor | None
) -> LabelledPoints:
    """The occupied and free samples, checked.

    Unknown points are left out: `fit` has made the map say 1/2 there, and tuning on them costs
    log-loss on held-out rays.
    """
    device = model.origin.device
    is_known = as_tensor(labels, "labels", device) != UNKNOWN
    points, labels = check_samples(points, labels, model.dim, device)
    if ray_id is not None:
        ray_id = torch.as_tensor(ray_id, device=device)
        if ray_id.shape != is_known.shape:
            raise ValueError(
                f"ray_id must be ({len(is_known)},), one per point; got {tuple(ray_id.shape)}"
            )
        ray_id = ray_id[is_known]
    return LabelledPoints(points, labels, ray_id)


def _hold_out(samples: LabelledPoints, fraction: float, rng: torch.Generator) -> Tensor | None:
    """IDs of a random fraction of the rays, or rows of points without ray IDs; None if none or all."""
    if not fraction:
        return None
    rays = samples.ray_id
    ids = torch.arange(len(samples.labels), device=rng.device) if rays is None else rays.unique()
    held = ids[torch.rand(len(ids), generator=rng, device=rng.device) < fraction]
    return held if 0 < len(held) < len(ids) else None


def _divide(
    samples: LabelledPoints, held_rays: Tensor | None
) -> tuple[LabelledPoints, LabelledPoints]:
    """Training points, and evaluation points: held-out points, or a subset of the training points."""
    if held_rays is None:
        train = evaluation = samples
    else:
        positions, labels, rays = samples
        rays = torch.arange(len(labels), device=labels.device) if rays is None else rays
        held = torch.isin(rays, held_rays)
        train = LabelledPoints(positions[~held], labels[~held], None)
        evaluation = LabelledPoints(positions[held], labels[held], None)
    every = -(-len(evaluation.labels) // EVALUATION_POINTS)
    return train, LabelledPoints(evaluation.positions[::every], evaluation.labels[::every], None)


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """Settings of fine-tuning. Learning rates are relative to the size of each cluster.

    ``l2`` and ``stiffness`` are relative to the summed loss of all points.
    """

    epochs: int = 12
    batch_size: int | None = None  # points per step; None: N / 64, between 1024 and `MAX_BATCH`
    weight_rate: float = 0.1
    center_rate: float = 0.02  # per step, relative to the mean length-scale of the cluster
    scale_rate: float = 0.02  # per step, of the logarithm of the length-scales
    l2: float = 0.25  # penalty on squared weights
    stiffness: float = 0.8  # penalty on squared offsets of centers and length-scales
    occupied_share: float = 0.6  # class weight of occupied points, see `fitting.FitConfig`
    hold_out: float = 0.0  # fraction of rays used to select the best epoch; 0: keep the last
    patience: int | None = None  # stop after this many epochs without improvement
    tune_weights: bool = True
    tune_centers: bool = True
    tune_scales: bool = True

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size", "patience"):
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
        if not 0 < self.occupied_share < 1:
            raise ValueError(f"occupied_share must be in (0, 1); got {self.occupied_share}")
        if not 0 <= self.hold_out < 1:
            raise ValueError(f"hold_out must be at least 0 and below 1; got {self.hold_out}")
        if self.patience is not None and not self.hold_out:
            raise ValueError(f"patience needs held-out rays; got hold_out = {self.hold_out}")


class LabelledPoints(NamedTuple):
    """(N, D) world positions [m], (N,) labels, and (N,) ray IDs or None."""

    positions: Tensor
    labels: Tensor
    ray_id: Tensor | None


class TuningRun:
    """State of an optimization run. Adam optimizes offsets in units of the cluster size."""

    def __init__(self, model: MapParameters, config: TuneConfig, rng: torch.Generator) -> None:
        self.model, self.config, self.rng = model, config, rng
        self.epoch, self.step, self.losses = 0, 0, list[float]()
        self._start_from([value.detach().clone() for value in self.parameters_of_map()])

    def _start_from(self, start: list[Tensor]) -> None:
        self.start = self.best = start
        size = start[2].diagonal(dim1=-2, dim2=-1).mean(dim=1).exp()[:, None]
        size = self.model.covariance_scale**0.5 * size.clamp(min=self.model.min_lengthscale)
        eye = torch.eye(self.model.dim, dtype=torch.bool, device=size.device)
        self.units = [  # size: (M, 1) mean length-scale of the kernels [m]
            torch.ones_like(start[0]),
            size,
            torch.where(eye, torch.ones_like(size)[..., None], size[..., None]),
        ]
        config = self.config
        moves = (config.tune_weights, config.tune_centers, config.tune_scales)
        rates = (config.weight_rate, config.center_rate, config.scale_rate)
        self.offsets = [
            torch.zeros_like(value).requires_grad_(move)
            for value, move in zip(start, moves, strict=True)
        ]
        groups = [
            {"params": [offset], "lr": rate, "full_rate": rate}
            for offset, rate in zip(self.offsets, rates, strict=True)
            if offset.requires_grad
        ]
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))

    def parameters_of_map(self) -> tuple[Tensor, Tensor, Tensor]:
        """The parameters of the map, in the order of the offsets."""
        return self.model.weights, self.model.centers, self.model.raw_scale_tril

    def current(self) -> list[Tensor]:
        """Weights, centers and raw factors with the current offsets applied."""
        rows = zip(self.start, self.units, self.offsets, strict=True)
        return [start + unit * offset for start, unit, offset in rows]

    def log_odds(self, points: Tensor, weights: Tensor, centers: Tensor, raw: Tensor) -> Tensor:
        """(B, D) world positions [m] -> (B,) log-odds of the map with the given parameters."""
        local = to_map_frame(points, self.model.origin, centers.dtype)
        return native.occupancy(local, centers, raw, weights, self.model.kernel, probability=False)

    def train(self, samples: LabelledPoints) -> None:
        """Train for one epoch over the points."""
        config, count = self.config, len(samples.labels)
        batch_size = config.batch_size or min(MAX_BATCH, max(1024, count // 64))
        factors = label_factors(samples.labels, config.occupied_share).to(self.start[0])
        steps_left = (config.epochs - self.epoch) * -(-count // batch_size)
        total_steps = self.step + steps_left
        for rows in batches(count, batch_size, self.rng):
            weights, centers, raw = self.current()
            labels = samples.labels[rows].to(weights.dtype)
            answer = self.log_odds(samples.positions[rows], weights, centers, raw)
            loss = logistic_loss(answer, labels, factors[(2 * labels).long()]) / len(rows)
            moved = sum(offset.square().sum() for offset in self.offsets[1:])
            penalty = config.l2 * weights.square().sum() + config.stiffness * moved
            self.optimizer.zero_grad()
            (loss + penalty / count).backward()
            for group in self.optimizer.param_groups:
                group["lr"] = group["full_rate"] * _rate_fraction(self.step, total_steps)
            self.optimizer.step()
            self.step += 1
        self.epoch += 1

    @torch.no_grad()
    def evaluate(self, samples: LabelledPoints) -> float:
        """Mean balanced log-loss on the points."""
        current = self.current()
        chunks = samples.positions.split(MAX_BATCH)
        answer = torch.cat([self.log_odds(chunk, *current) for chunk in chunks])
        labels = samples.labels.to(answer.dtype)
        return float(logistic_loss(answer, labels, balance_classes(labels))) / len(answer)

    def keep_best(self, loss: float) -> None:
        """Record the loss of the epoch, and its parameters if the loss is the smallest so far."""
        self.losses.append(loss)
        if not self.config.hold_out or loss <= min(self.losses[1:]):
            self.best = [value.detach().clone() for value in self.current()]

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
            "start": self.start,
            "offsets": [offset.detach().clone() for offset in self.offsets],
            "best": self.best,
            "optimizer": self.optimizer.state_dict(),
            "rng": self.rng.get_state(),
        }

    def load(self, state: State) -> None:
        """Resume from a state."""
        if state["config"] != asdict(self.config):
            raise ValueError(f"state must be of this config; got one of {state['config']}")
        shapes = [value.shape for value in state["start"]]
        if shapes != [value.shape for value in self.start]:
            raise ValueError(
                f"state must be of a map with {len(self.start[0])} clusters; got {shapes[0][0]}"
            )
        self._start_from(
            [value.to(own) for value, own in zip(state["start"], self.start, strict=True)]
        )
        with torch.no_grad():
            for offset, value in zip(self.offsets, state["offsets"], strict=True):
                offset.copy_(value)
        self.epoch, self.step, self.losses = state["epoch"], state["step"], list(state["losses"])
        self.best = [value.to(own) for value, own in zip(state["best"], self.start, strict=True)]
        self.optimizer.load_state_dict(state["optimizer"])
        self.rng.set_state(state["rng"])


def _last_best(losses: list[float]) -> int:
    return max((row for row, loss in enumerate(losses) if loss <= min(losses)), default=0)


def batches(count: int, batch_size: int, rng: torch.Generator) -> Iterator[Tensor]:
    """Yield stratified batches that together contain every row once.

    The rows are divided into runs of consecutive rows, and each batch contains one row of every run.
    Samples are ordered by class and ray, so each batch represents both classes and the whole scene in
    proportion. No index tensor of the length of the data is created.
    """
    steps = -(-count // batch_size)
    first = torch.arange(0, count, steps, device=rng.device)  # first row of each run
    shift = torch.randint(steps, first.shape, generator=rng, device=rng.device)
    for turn in torch.randperm(steps, generator=rng, device=rng.device):
        rows = first + (shift + turn) % steps
        yield rows[rows < count]


def _rate_fraction(step: int, total_steps: int) -> float:
    """Fraction of the full learning rate: a short warm-up, and a linear decay to 0."""
    return min(1.0, (step + 1) / WARM_UP_STEPS) * max(0.0, 1 - step / total_steps)
