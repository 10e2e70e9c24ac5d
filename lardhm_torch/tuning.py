"""Length-scales, centers and weights learned together, by backpropagation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import native
from lardhm_torch.fitting import balance_classes, logistic_loss
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.sampling import check_samples

WARM_UP_STEPS = 20  # over which the rates rise to their full value


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """How a map is fine-tuned. Rates are in units of each cluster, so they fit every scene."""

    epochs: int = 8
    batch_size: int | None = None  # points a step; None: N / 64, at least 1024
    weight_rate: float = 0.1
    center_rate: float = 0.03  # of the cluster's mean length-scale, a step
    scale_rate: float = 0.03  # of the logarithm of the length-scales, a step
    l2: float = 0.1  # on the weights, against the sum of the losses of all points
    hold_out: float = 0.0  # share of the rays that chooses the best epoch; 0 keeps the last
    tune_weights: bool = True
    tune_centers: bool = True
    tune_scales: bool = True

    def __post_init__(self) -> None:
        if self.epochs < 1:
            raise ValueError(f"epochs must be 1 or more; got {self.epochs}")
        if self.batch_size is not None and self.batch_size < 1:
            raise ValueError(f"batch_size must be 1 or more; got {self.batch_size}")
        rates = (self.weight_rate, self.center_rate, self.scale_rate)
        if not min(rates) > 0 or not self.l2 >= 0:
            raise ValueError(f"rates must be > 0 and l2 0 or more; got {rates} and {self.l2}")
        if not 0 <= self.hold_out < 1:
            raise ValueError(f"hold_out must be at least 0 and below 1; got {self.hold_out}")


def fine_tune(
    model: LardHilbertMap,
    points: Tensor,
    labels: Tensor,
    *,
    ray_id: Tensor | None = None,
    config: TuneConfig | None = None,
    seed: int = 0,
    progress: bool = False,
) -> list[float]:
    """Move centers, length-scales and weights of a fitted map downhill on the balanced log-loss.

    Adam with a short warm-up and rates falling to 0. Centers move in units of their cluster's mean
    length-scale and factors by the logarithm of their diagonal, so the rates need no scene and
    every factor stays valid. The neighbors of every point are found anew in every step. With
    ``hold_out`` a share of the rays does not train, and the epoch that predicts it best is kept;
    the given map is no candidate, because `fit` has seen those rays. If anything fails the map is
    as it was.

    Args:
        model: a fitted map, changed in place.
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free.
        ray_id: (N,) which ray a point lies on, so that whole rays are held out (`Samples.ray_id`);
            None: points are held out one by one.
        config: rates, epochs and what is tuned.
        seed: of the hold-out and the batches.
        progress: show a bar with the held-out loss on a terminal.

    Returns:
        Mean balanced log-loss of the held-out points (of the training points if none are held
        out), before the first epoch and after each.

    Raises:
        ValueError: the map is empty, nothing is to be tuned, or the samples are bad (see `fit`).
    """
    config = config or TuneConfig()
    if len(model) == 0:
        raise ValueError("model must be fitted before it is tuned; it is empty. Call fit first")
    if not (config.tune_weights or config.tune_centers or config.tune_scales):
        raise ValueError("config must leave weights, centers or scales to tune; it freezes all")
    points, labels = check_samples(points, labels, model.dim, model.origin.device)
    local, labels = model._to_map_frame(points), labels.to(model.centers.dtype)
    rng = torch.Generator(device=local.device).manual_seed(seed)
    held = _hold_out(len(local), ray_id, config.hold_out, rng)
    tuned = _Tunable(model, config)
    judged = held if bool(held.any()) else ~held

    def judge() -> float:
        with torch.no_grad():
            answer = tuned.log_odds(local[judged])
        factors = balance_classes(labels[judged])
        return float(logistic_loss(answer, labels[judged], factors)) / len(answer)

    losses, best = [judge()], tuned.start
    train = (local[~held], labels[~held])
    with tqdm(total=config.epochs, desc="tuning", disable=None if progress else True) as bar:
        for _ in tuned.epochs(*train, config, rng):
            losses.append(judge())
            if losses[-1] <= min(losses[1:]) or not bool(held.any()):
                best = tuned.snapshot()
            bar.set_postfix(loss=f"{losses[-1]:.4f}")
            bar.update()
    with torch.no_grad():
        for parameter, value in zip(tuned.parameters_of_map(), best, strict=True):
            parameter.copy_(value)
    return losses


def _hold_out(count: int, ray_id: Tensor | None, share: float, rng: torch.Generator) -> Tensor:
    """(N,) bool: the points of a random share of the rays."""
    if ray_id is None:
        return torch.rand(count, generator=rng, device=rng.device) < share
    ray_id = torch.as_tensor(ray_id, device=rng.device)
    if ray_id.shape != (count,):
        raise ValueError(f"ray_id must be ({count},), one per point; got {tuple(ray_id.shape)}")
    rays, which = ray_id.unique(return_inverse=True)
    return (torch.rand(len(rays), generator=rng, device=rng.device) < share)[which]


class _Tunable:
    """A map's parameters as offsets in units of each cluster, which is what Adam moves."""

    def __init__(self, model: LardHilbertMap, config: TuneConfig) -> None:
        self.model = model
        self.start = [parameter.detach().clone() for parameter in self.parameters_of_map()]
        diagonal = model.scale_tril.detach().diagonal(dim1=-2, dim2=-1)
        size = diagonal.log().mean(dim=1).exp()[:, None]  # (M, 1) mean length-scale [m]
        eye = torch.eye(model.dim, dtype=torch.bool, device=size.device)
        self.units = [
            torch.ones_like(self.start[0]),
            size,
            torch.where(eye, torch.ones_like(size)[..., None], size[..., None]),
        ]
        moves = (config.tune_weights, config.tune_centers, config.tune_scales)
        self.offsets = [
            torch.zeros_like(start).requires_grad_(move)
            for start, move in zip(self.start, moves, strict=True)
        ]

    def parameters_of_map(self) -> tuple[Tensor, Tensor, Tensor]:
        """The map's own tensors, in the order of the offsets."""
        return self.model.weights, self.model.centers, self.model.raw_scale_tril

    def current(self) -> list[Tensor]:
        """Weights, centers and raw factors where the offsets have moved them."""
        rows = zip(self.start, self.units, self.offsets, strict=True)
        return [start + unit * offset for start, unit, offset in rows]

    def snapshot(self) -> list[Tensor]:
        """Copies of `current`."""
        return [value.detach().clone() for value in self.current()]

    def log_odds(self, local: Tensor) -> Tensor:
        """(N, D) positions in the map frame -> (N,) logits under the current parameters."""
        weights, centers, raw = self.current()
        return native.occupancy(local, centers, raw, weights, self.model.kernel, probability=False)

    def epochs(
        self, local: Tensor, labels: Tensor, config: TuneConfig, rng: torch.Generator
    ) -> Iterator[None]:
        """Train epoch after epoch; yields after each."""
        rates = (config.weight_rate, config.center_rate, config.scale_rate)
        groups = [
            {"params": [offset], "lr": rate}
            for offset, rate in zip(self.offsets, rates, strict=True)
            if offset.requires_grad
        ]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
        batch_size = config.batch_size or max(1024, len(local) // 64)
        steps = config.epochs * -(-len(local) // batch_size)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, _rate_schedule(steps))
        factors = balance_classes(labels)
        for _ in range(config.epochs):
            order = torch.randperm(len(local), generator=rng, device=rng.device)
            for rows in order.split(batch_size):
                loss = logistic_loss(self.log_odds(local[rows]), labels[rows], factors[rows])
                penalty = config.l2 / len(local) * self.current()[0].square().sum()
                optimizer.zero_grad()
                (loss / len(rows) + penalty).backward()
                optimizer.step()
                schedule.step()
            yield


def _rate_schedule(steps: int) -> Callable[[int], float]:
    return lambda step: min(1.0, (step + 1) / WARM_UP_STEPS) * max(0.0, 1 - step / steps)
