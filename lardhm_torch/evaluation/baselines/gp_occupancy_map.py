"""GP occupancy map: one exact Gaussian process for the whole scene, at cubic cost."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch.evaluation.baselines.gaussian_process import (
    Hyperparameters,
    Kernel,
    condition,
    learn_hyperparameters,
    learn_squash,
    leave_one_out,
    predict,
    squared_exponential,
    squash,
)
from lardhm_torch.learning.points import check_samples

MAX_POINTS = 8000  # the covariance matrix is half a gigabyte, its factor takes 10^11.5 operations
LEARNING_POINTS = 300  # random points from which the hyperparameters are learned
QUERY_ENTRIES = 1 << 24  # covariances of query and training points in memory at a time


class GPOccupancyMap:
    """Gaussian process classification of occupied and free space, for small scenes.

    Args:
        seed: random seed for the points from which the hyperparameters are learned.
        dtype: of the computation.

    Source: O'Callaghan & Ramos 2012, "Gaussian process occupancy maps" (probabilistic
    least-squares classification); named in Guizilini & Ramos 2016, Section I.
    """

    kernel: Kernel = staticmethod(squared_exponential)
    learns_lengthscale = True

    def __init__(self, *, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        self.seed, self.dtype = seed, dtype
        self.origin: Tensor | None = None

    def start(self, local: Tensor) -> Hyperparameters:
        """Initial hyperparameters: the lengthscale is a tenth of the standard deviation of the scene."""
        one = local.new_tensor(1.0)
        return Hyperparameters(0.1 * local.std(dim=0, correction=0).max() + 1e-3, one, 0.1 * one)

    def fit(self, points: Tensor, labels: Tensor) -> GPOccupancyMap:
        """Learn hyperparameters on a random subset, then condition on all points.

        Args:
            points: (N, D) world positions [m], at most 8000.
            labels: (N,) 1 occupied, 0 free.

        Raises:
            ValueError: there are more points, or the samples are invalid (see `LardHilbertMap.fit`).
        """
        points, labels = check_samples(points.double(), labels, points.shape[-1], points.device)
        if len(points) > MAX_POINTS:
            raise ValueError(
                f"points must be at most {MAX_POINTS} for an exact process, whose cost is cubic; "
                f"got {len(points)}. Subsample them, or use LocalGP"
            )
        origin = points.mean(dim=0).round()
        local, targets = (points - origin).to(self.dtype), 2 * labels.to(self.dtype) - 1
        rng = torch.Generator(device=points.device).manual_seed(self.seed)
        few = torch.randperm(len(local), generator=rng, device=rng.device)[:LEARNING_POINTS]
        start = self.start(local)
        batch = _single(local[few], targets[few])
        self.scale = learn_hyperparameters(*batch, self.kernel, start, self.learns_lengthscale)
        batch = _single(local, targets)
        self.posterior = condition(*batch, self.kernel, self.scale)
        mean, variance = leave_one_out(self.posterior, targets[None], self.scale)
        self.steepness = learn_squash(mean[0], variance[0], labels)
        self.origin = origin
        return self

    @torch.no_grad()
    def predict(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, D) world positions [m] -> (N,) mean of the target in [-1, 1] and (N,) its variance.

        Raises:
            RuntimeError: `fit` has not been called.
            ValueError: points are not (N, D).
        """
        if self.origin is None:
            raise RuntimeError("probability needs a process; call fit(points, labels) first")
        if points.ndim != 2 or points.shape[1] != len(self.origin):
            raise ValueError(f"points must be (N, {len(self.origin)}); got {tuple(points.shape)}")
        local = (points.to(torch.float64) - self.origin).to(self.dtype)
        chunk = max(1, QUERY_ENTRIES // self.posterior.points.shape[1])
        parts = [
            predict(self.posterior, part[None], self.kernel, self.scale)
            for part in local.split(chunk)
        ]
        mean, variance = (torch.cat([part[i][0] for part in parts]) for i in (0, 1))
        return mean, variance

    def probability(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) probability of occupancy; 1/2 far from all points."""
        mean, variance = self.predict(points)
        return squash(mean, variance, self.steepness)

    __call__ = probability

    def variance(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) variance of the target."""
        return self.predict(points)[1]


def _single(local: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A batch of one process without padding, as arguments of `condition`."""
    return local[None], targets[None], torch.ones_like(targets, dtype=torch.bool)[None]
