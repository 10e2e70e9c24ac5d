"""Steps of fine-tuning: Adam on weights, centers and length scales at once, with fixed neighbors.

The parameters of a cluster are one row of a table, so that a step is the same arithmetic for all of
them. `plain_steps` is the definition; the native library does the same in one pass per batch.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, kernel_factors, lard_kernel, neighbor_fade
from lardhm_torch.learning.fitting import logistic_loss

WARM_UP_STEPS = 20  # number of steps of the learning rate warm-up
BETAS = (0.9, 0.99)
EPSILON = 1e-8


class Moving(NamedTuple):
    """(M, G) offsets of the parameters from their start, and Adam's running moments of the gradient."""

    offsets: Tensor
    mean: Tensor
    square: Tensor

    @classmethod
    def at_start(cls, start: Tensor) -> Moving:
        """Before the first step from (M, G) parameters."""
        return cls(*(torch.zeros_like(start) for _ in cls._fields))


class Table(NamedTuple):
    """What stays the same during a run.

    Args:
        start: (M, G) parameters before tuning, see `to_rows`.
        unit: (M, G) of one unit of the offsets: parameters are ``start + unit * offsets``.
        rates: (G,) float64 full learning rates.
        penalties: (G,) float64 factors on squared weights (first column) and squared offsets.
        kernel: settings of the map.
    """

    start: Tensor
    unit: Tensor
    rates: Tensor
    penalties: Tensor
    kernel: Kernel

    def parameters(self, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weights, centers and raw factors with offsets applied."""
        return from_rows(self.start + self.unit * offsets)


class Batches(NamedTuple):
    """Training samples, batch after batch: (N, D) points [m], (N,) labels and loss factors."""

    points: Tensor
    labels: Tensor
    factors: Tensor


class Plan(NamedTuple):
    """Sizes that determine the schedule of the learning rates."""

    num_points: int
    batch_size: int
    total_steps: int

    def rate_fraction(self, step: int) -> float:
        """Fraction of the full learning rate: a short warm-up, and a linear decay to 0."""
        return min(1.0, (step + 1) / WARM_UP_STEPS) * max(0.0, 1 - step / self.total_steps)


def to_rows(weights: Tensor, centers: Tensor, raw: Tensor) -> Tensor:
    """(M,), (M, D) and (M, D, D) -> (M, G) weight, center, lower triangle row by row."""
    rows, columns = torch.tril_indices(*raw.shape[1:], device=raw.device)
    return torch.cat([weights[:, None], centers, raw[:, rows, columns]], dim=1)


def from_rows(table: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The reverse of `to_rows`."""
    dim = round((2 * table.shape[1] + 0.25) ** 0.5 - 1.5)  # G = (D + 1) (D + 2) / 2
    rows, columns = torch.tril_indices(dim, dim, device=table.device)
    raw = table.new_zeros(len(table), dim, dim)
    raw[:, rows, columns] = table[:, 1 + dim :]
    return table[:, 0], table[:, 1 : 1 + dim], raw


def tuning_steps(
    batches: Batches, indices: Tensor, table: Table, moving: Moving, step: int, plan: Plan
) -> Moving:
    """One step of Adam for every batch of the samples.

    Args:
        batches: R samples, a whole number of batches except at the end of the data.
        indices: (R, K) int32 clusters near each sample. They need not be the nearest ones any more.
        table: parameters before tuning.
        moving: offsets and moments; not modified.
        step: number of the first step, from 0.
        plan: sizes.
    """
    if not native.supports(batches.points) or indices.shape[1] == 0:
        return plain_steps(batches, indices, table, moving, step, plan)
    result = torch.ops.lardhm.tuning_steps(
        batches.points, indices, batches.labels, batches.factors, table.start, table.unit, *moving,
        table.rates, table.penalties, plan.num_points, plan.batch_size, step, plan.total_steps,
        WARM_UP_STEPS, *table.kernel[1:],
    )  # fmt: skip
    return Moving(*result)


def tuned_features(points: Tensor, indices: Tensor, table: Table, offsets: Tensor) -> Tensor:
    """(N, K) kernel values of the neighbors that were used for tuning, times the fade.

    Args:
        points: (N, D) positions [m].
        indices: (N, K) clusters near each.
        table: parameters before tuning.
        offsets: (M, G) of the parameters.
    """
    if native.supports(points) and indices.shape[1] > 0:
        given = (points, indices, table.start, table.unit, offsets)
        return torch.ops.lardhm.tuned_features(*given, *table.kernel[1:])
    _, centers, raw = table.parameters(offsets)
    near = indices.long()
    values = lard_kernel(points, centers, kernel_factors(raw, table.kernel), near)
    return values * neighbor_fade(points, centers, near)


def plain_steps(
    batches: Batches, indices: Tensor, table: Table, moving: Moving, step: int, plan: Plan
) -> Moving:
    """The same as `tuning_steps`, in plain torch."""
    columns = (*batches, indices.long())
    parts = zip(*(column.split(plan.batch_size) for column in columns), strict=True)
    for now, (points, labels, factors, near) in enumerate(parts, start=step):
        offsets = moving.offsets.detach().requires_grad_()
        with torch.enable_grad():
            loss = _loss(Batches(points, labels, factors), near, table, offsets, plan)
            (slope,) = torch.autograd.grad(loss, offsets)
        moving = _adam(moving, slope, now, plan.rate_fraction(now) * table.rates)
    return moving


def _loss(batch: Batches, near: Tensor, table: Table, offsets: Tensor, plan: Plan) -> Tensor:
    """Mean loss of a batch, and its part of the penalty."""
    weights, centers, raw = table.parameters(offsets)
    values = lard_kernel(batch.points, centers, kernel_factors(raw, table.kernel), near)
    values = values * neighbor_fade(batch.points, centers, near)
    chosen = weights.index_select(0, near.reshape(-1)).reshape(near.shape)
    log_odds = (values * chosen).sum(dim=1)
    moved = torch.cat([weights[:, None], offsets[:, 1:]], dim=1)
    penalty = (table.penalties.to(moved) * moved.square()).sum() / plan.num_points
    return logistic_loss(log_odds, batch.labels, batch.factors) / len(near) + penalty


def _adam(moving: Moving, slope: Tensor, step: int, rates: Tensor) -> Moving:
    """One step of Adam with (G,) learning rates."""
    first, second = BETAS
    mean = first * moving.mean + (1 - first) * slope
    square = second * moving.square + (1 - second) * slope.square()
    size = square.sqrt() / (1 - second ** (step + 1)) ** 0.5 + EPSILON
    reach = (rates / (1 - first ** (step + 1))).to(mean)
    return Moving(moving.offsets - reach * mean / size, mean, square)
