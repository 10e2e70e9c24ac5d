"""Batches of small exact Gaussian processes, the basis of three baselines.

Classes are regressed as targets -1 and +1 and squashed to a probability afterwards (Rasmussen &
Williams 2006, Section 6.5), so that everything except the hyperparameters is in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

LEARNING_STEPS = 40
LEARNING_RATE = 0.15  # of Adam, for the logarithms
NOISE_FLOOR = 1e-3  # variance; keeps Cholesky factors stable in float32
SQUASHES = (0.1, 100.0, 61)  # first, last and number of candidates for the steepness

Kernel = Callable[[Tensor, Tensor], Tensor]  # distances [m], lengthscale [m] -> correlation


class Hyperparameters(NamedTuple):
    """Scalars: lengthscale [m], variance of the function, variance of the noise."""

    lengthscale: Tensor
    signal: Tensor
    noise: Tensor


class Posterior(NamedTuple):
    """Gaussian processes conditioned on their own points; padding has ``coefficients`` 0.

    ``points`` (B, n, D) [m]; ``factor`` (B, n, n) lower Cholesky factor of covariance plus noise;
    ``coefficients`` (B, n), the inverse of this matrix times the targets.
    """

    points: Tensor
    factor: Tensor
    coefficients: Tensor


def squared_exponential(distances: Tensor, lengthscale: Tensor) -> Tensor:
    """Correlation exp(-r^2 / (2 l^2)) at distance r.

    Source: Guizilini & Ramos 2016, eq. (8) with one lengthscale.
    """
    return torch.exp(-0.5 * (distances / lengthscale).square())


def thin_plate(distances: Tensor, lengthscale: Tensor) -> Tensor:
    """Thin-plate covariance (2 r^3 - 3 R r^2 + R^3) / R^3; 0 beyond R, the size of the scene.

    Source: Williams & Fitzgibbon 2006, "Gaussian process implicit surfaces", eq. (9).
    """
    ratio = (distances / lengthscale).clamp(max=1.0)
    return 2 * ratio**3 - 3 * ratio.square() + 1


def condition(
    points: Tensor, targets: Tensor, present: Tensor, kernel: Kernel, scale: Hyperparameters
) -> Posterior:
    """Exact posterior of B processes.

    Args:
        points: (B, n, D) [m]; padding may have any finite value.
        targets: (B, n) regressed values.
        present: (B, n) bool; False for padding, which has no effect.
        kernel: correlation as a function of distance and lengthscale.
        scale: shared by all processes.

    Source: Rasmussen & Williams 2006, Algorithm 2.1.
    """
    targets = targets * present
    pairs = present[:, :, None] & present[:, None, :]
    covariance = scale.signal * kernel(_distances(points, points), scale.lengthscale) * pairs
    diagonal = torch.where(present, scale.noise, torch.ones_like(targets))
    factor = torch.linalg.cholesky(covariance + torch.diag_embed(diagonal))
    return Posterior(points, factor, torch.cholesky_solve(targets[..., None], factor)[..., 0])


def predict(
    posterior: Posterior, queries: Tensor, kernel: Kernel, scale: Hyperparameters
) -> tuple[Tensor, Tensor]:
    """(B, Q, D) positions [m] -> (B, Q) mean and (B, Q) variance of the noise-free function.

    Source: Rasmussen & Williams 2006, Algorithm 2.1.
    """
    cross = scale.signal * kernel(_distances(posterior.points, queries), scale.lengthscale)
    present = posterior.factor.diagonal(dim1=-2, dim2=-1) != 1  # padding has no covariance
    cross = cross * present[..., None]
    mean = (cross * posterior.coefficients[..., None]).sum(dim=-2)
    whitened = torch.linalg.solve_triangular(posterior.factor, cross, upper=False)
    return mean, (scale.signal - whitened.square().sum(dim=-2)).clamp(min=1e-9)


def learn_hyperparameters(
    points: Tensor,
    targets: Tensor,
    present: Tensor,
    kernel: Kernel,
    start: Hyperparameters,
    learn_lengthscale: bool = True,
) -> Hyperparameters:
    """Lengthscale, signal and noise that maximize the sum of the marginal likelihoods.

    Args:
        points: (B, n, D) [m].
        targets: (B, n) regressed values.
        present: (B, n) bool, see `condition`.
        kernel: correlation as a function of distance and lengthscale.
        start: initial values; Adam optimizes their logarithms.
        learn_lengthscale: False keeps the initial lengthscale.

    Source: Rasmussen & Williams 2006, eq. (5.8).
    """
    logs = torch.stack(list(start)).log().detach().requires_grad_()
    optimizer = torch.optim.Adam([logs], lr=LEARNING_RATE)
    with torch.enable_grad():
        for _ in range(LEARNING_STEPS):
            lengthscale, signal, noise = logs.exp()
            if not learn_lengthscale:
                lengthscale = start.lengthscale
            scale = Hyperparameters(lengthscale, signal, noise + NOISE_FLOOR)
            fitted = condition(points, targets, present, kernel, scale)
            misfit = 0.5 * (targets * present * fitted.coefficients).sum()
            volume = fitted.factor.diagonal(dim1=-2, dim2=-1).log().sum()
            optimizer.zero_grad()
            (misfit + volume).backward()
            optimizer.step()
    lengthscale, signal, noise = logs.detach().exp()
    final = lengthscale if learn_lengthscale else start.lengthscale
    return Hyperparameters(final, signal, noise + NOISE_FLOOR)


def leave_one_out(
    posterior: Posterior, targets: Tensor, scale: Hyperparameters
) -> tuple[Tensor, Tensor]:
    """(B, n) leave-one-out mean and variance of the function at every point.

    Source: Rasmussen & Williams 2006, eq. (5.12).
    """
    precision = torch.cholesky_inverse(posterior.factor).diagonal(dim1=-2, dim2=-1)
    mean = targets - posterior.coefficients / precision
    return mean, (1 / precision - scale.noise).clamp(min=1e-9)


def squash(mean: Tensor, variance: Tensor, steepness: Tensor) -> Tensor:
    """Probability of the class +1: Phi(a mu / sqrt(1 + a^2 v)); 1/2 where the mean is 0.

    Source: Rasmussen & Williams 2006, eq. (6.43), without its offset.
    """
    return torch.special.ndtr(steepness * mean / (1 + steepness.square() * variance).sqrt())


def learn_squash(mean: Tensor, variance: Tensor, labels: Tensor) -> Tensor:
    """Steepness of `squash` with the lowest class-balanced log-loss on left-out points.

    Args:
        mean: (N,) predictions, see `leave_one_out`.
        variance: (N,) of the predictions.
        labels: (N,) 1 occupied, 0 free.
    """
    first, last, count = SQUASHES
    candidates = first * (last / first) ** (torch.arange(count, device=mean.device) / (count - 1))
    losses = []
    for steepness in candidates.to(mean.dtype):
        p = squash(mean, variance, steepness).clamp(1e-6, 1 - 1e-6)
        classes = [-p[labels > 0.5].log(), -(1 - p[labels <= 0.5]).log()]
        losses.append(sum(part.mean() for part in classes if len(part)))
    return candidates[int(torch.stack([torch.as_tensor(loss) for loss in losses]).argmin())].to(
        mean
    )


def _distances(a: Tensor, b: Tensor) -> Tensor:
    """(..., n, m) distances [m]; the expanded form is inaccurate for near points."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
