"""Length-scales, centers and weights learned together, by backpropagation."""

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
from lardhm_torch.points import check_samples, to_map_frame
from lardhm_torch.sampling import Samples, seeded_generator

WARM_UP_STEPS = 20  # over which the rates rise to their full value
MAX_BATCH = 1 << 15  # points a step where none is asked for: memory does not grow with N
State = dict[str, Any]  # tensors and plain values: `torch.save` it, `torch.load` it, give it back
JUDGED_POINTS = 1 << 16  # whose loss is told after each epoch


def fine_tune(
    model: MapParameters,
    points: Tensor,
    labels: Tensor,
    *,
    ray_id: Tensor | None = None,
    resample: Callable[[int], Samples] | None = None,
    config: TuneConfig | None = None,
    seed: int = 0,
    state: State | None = None,
    after_epoch: Callable[[State], None] | None = None,
    progress: bool = False,
) -> list[float]:
    """Move centers, length-scales and weights of a fitted map downhill on the balanced log-loss.

    Adam with a short warm-up and rates falling to 0. Centers move in units of their cluster's mean
    length-scale and factors by the logarithm of their diagonal, so the rates need no scene and
    every factor stays valid. The neighbors of every point are found anew in every step, and points
    are streamed, so memory does not grow with their number. With ``hold_out`` a share of the rays
    does not train, and the epoch that predicts it best is kept; the given map is no candidate,
    because `fit` has seen those rays. If anything fails the map is as it was.

    Args:
        model: a fitted map, changed in place.
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free.
        ray_id: (N,) which ray a point lies on, so that whole rays are held out (`Samples.ray_id`);
            None: points are held out one by one.
        resample: number of the epoch, from 1, -> fresh samples of the same rays for it. New free
            points every epoch cannot be learned by heart:
            ``lambda epoch: sample_rays(scans, seed=seed + epoch)``.
        config: rates, epochs and what is tuned.
        seed: of the hold-out and the batches.
        state: what ``after_epoch`` was given; tuning goes on from there, and ends as if it had
            never been interrupted. All other arguments must be the same again.
        after_epoch: called with the state after every epoch, to be saved.
        progress: show a bar with the loss on a terminal.

    Returns:
        Mean balanced log-loss of held-out points (of training points if none are held out), before
        the first epoch and after each.

    Raises:
        ValueError: the map is empty, nothing is to be tuned, the samples are bad (see `fit`), or
            the state is of another map or config.
    """
    config = config or TuneConfig()
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
    train, judged = _divide(samples, held_rays)
    run = TuningRun(model, config, rng)
    run.load(state) if state else run.losses.append(run.judge(judged))
    with tqdm(total=config.epochs, initial=run.epoch, disable=None if progress else True) as bar:
        while run.epoch < config.epochs and not run.stalled():
            if resample and run.epoch:
                fresh = resample(run.epoch)
                fresh_samples = _check(model, fresh.points, fresh.labels, fresh.ray_id)
                train = _divide(fresh_samples, held_rays)[0]
            run.train(train)
            run.keep_best(run.judge(judged))
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
    points, labels = check_samples(
        points, labels, model.dim, model.origin.device, keep_unknown=True
    )
    if ray_id is not None:
        ray_id = torch.as_tensor(ray_id, device=points.device)
        if ray_id.shape != labels.shape:
            raise ValueError(
                f"ray_id must be ({len(labels)},), one per point; got {tuple(ray_id.shape)}"
            )
    return LabelledPoints(points, labels, ray_id)


def _hold_out(samples: LabelledPoints, share: float, rng: torch.Generator) -> Tensor | None:
    """A random share of the rays, by their id (of the points, by their row); None for none."""
    if not share:
        return None
    rays = samples.ray_id
    ids = torch.arange(len(samples.labels), device=rng.device) if rays is None else rays.unique()
    held = ids[torch.rand(len(ids), generator=rng, device=rng.device) < share]
    return held if 0 < len(held) < len(ids) else None


def _divide(
    samples: LabelledPoints, held_rays: Tensor | None
) -> tuple[LabelledPoints, LabelledPoints]:
    """What trains, and what is judged: the held-out points, or a part of the training points."""
    if held_rays is None:
        train = judged = samples
    else:
        positions, labels, rays = samples
        rays = torch.arange(len(labels), device=labels.device) if rays is None else rays
        held = torch.isin(rays, held_rays)
        train = LabelledPoints(positions[~held], labels[~held], None)
        judged = LabelledPoints(positions[held], labels[held], None)
    every = -(-len(judged.labels) // JUDGED_POINTS)
    return train, LabelledPoints(judged.positions[::every], judged.labels[::every], None)


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """How a map is fine-tuned. Rates are in units of each cluster, so they fit every scene.

    ``l2`` and ``stiffness`` stand against the sum of the losses of all points.
    """

    epochs: int = 12
    batch_size: int | None = None  # points a step; None: N / 64, 1024 to `MAX_BATCH`
    weight_rate: float = 0.1
    center_rate: float = 0.02  # of the cluster's mean length-scale, a step
    scale_rate: float = 0.02  # of the logarithm of the length-scales, a step
    l2: float = 0.25  # on the weights
    stiffness: float = 0.8  # on how far centers and scales have moved, in units of the cluster
    occupied_share: float = 0.6  # of the loss, see `fitting.FitConfig`
    hold_out: float = 0.0  # share of the rays that chooses the best epoch; 0 keeps the last
    patience: int | None = None  # stop after so many epochs without a better held-out loss
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
    """(N, D) world positions, (N,) labels and (N,) rays, or None where every point is its own."""

    positions: Tensor
    labels: Tensor
    ray_id: Tensor | None


class TuningRun:
    """A map's parameters as offsets in units of each cluster, which is what Adam moves."""

    def __init__(self, model: MapParameters, config: TuneConfig, rng: torch.Generator) -> None:
        self.model, self.config, self.rng = model, config, rng
        self.epoch, self.step, self.losses = 0, 0, list[float]()
        self._start_from([value.detach().clone() for value in self.parameters_of_map()])

    def _start_from(self, start: list[Tensor]) -> None:
        self.start = self.best = start
        size = start[2].diagonal(dim1=-2, dim2=-1).mean(dim=1).exp()[:, None]
        size = self.model.covariance_scale**0.5 * size.clamp(min=self.model.min_lengthscale)
        eye = torch.eye(self.model.dim, dtype=torch.bool, device=size.device)
        self.units = [  # (M, 1) is the mean length-scale of a cluster's kernel [m]
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
        """The map's own tensors, in the order of the offsets."""
        return self.model.weights, self.model.centers, self.model.raw_scale_tril

    def current(self) -> list[Tensor]:
        """Weights, centers and raw factors where the offsets have moved them."""
        rows = zip(self.start, self.units, self.offsets, strict=True)
        return [start + unit * offset for start, unit, offset in rows]

    def log_odds(self, points: Tensor, weights: Tensor, centers: Tensor, raw: Tensor) -> Tensor:
        """(B, D) world positions -> (B,) logits of the map with these parameters."""
        local = to_map_frame(points, self.model.origin, centers.dtype)
        return native.occupancy(local, centers, raw, weights, self.model.kernel, probability=False)

    def train(self, samples: LabelledPoints) -> None:
        """One epoch over the points."""
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
                group["lr"] = group["full_rate"] * _rate_share(self.step, total_steps)
            self.optimizer.step()
            self.step += 1
        self.epoch += 1

    @torch.no_grad()
    def judge(self, samples: LabelledPoints) -> float:
        """Mean balanced log-loss of the points."""
        current = self.current()
        chunks = samples.positions.split(MAX_BATCH)
        answer = torch.cat([self.log_odds(chunk, *current) for chunk in chunks])
        labels = samples.labels.to(answer.dtype)
        return float(logistic_loss(answer, labels, balance_classes(labels))) / len(answer)

    def keep_best(self, loss: float) -> None:
        """Note the loss of the epoch, and its parameters if no epoch was better."""
        self.losses.append(loss)
        if not self.config.hold_out or loss <= min(self.losses[1:]):
            self.best = [value.detach().clone() for value in self.current()]

    def stalled(self) -> bool:
        """Whether the last ``patience`` epochs brought nothing better."""
        patience, losses = self.config.patience, self.losses[1:]
        return patience is not None and len(losses) - 1 - _last_best(losses) >= patience

    def state(self) -> State:
        """All that a run is, as tensors and plain values."""
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
        """Go on where a state was taken."""
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
    """Every row once, in batches that each hold one row of every stretch of the rows.

    Samples come hits first and ray by ray, so each batch sees both classes and the whole scene in
    fair shares; and nothing as long as the rows is held.
    """
    steps = -(-count // batch_size)
    first = torch.arange(0, count, steps, device=rng.device)  # of each stretch of `steps` rows
    shift = torch.randint(steps, first.shape, generator=rng, device=rng.device)
    for turn in torch.randperm(steps, generator=rng, device=rng.device):
        rows = first + (shift + turn) % steps
        yield rows[rows < count]


def _rate_share(step: int, total_steps: int) -> float:
    """Share of the full rate: a short rise, then down to 0."""
    return min(1.0, (step + 1) / WARM_UP_STEPS) * max(0.0, 1 - step / total_steps)
