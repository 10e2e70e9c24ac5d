"""Local Gaussian processes: one per cluster; the nearest are averaged by inverse variance."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.evaluation.baselines.gaussian_process import (
    Hyperparameters,
    Posterior,
    condition,
    learn_hyperparameters,
    learn_squash,
    leave_one_out,
    predict,
    squared_exponential,
    squash,
)
from lardhm_torch.learning.kmeans import mini_batch_kmeans
from lardhm_torch.learning.points import check_samples, in_morton_order
from lardhm_torch.native import nearest_centers

LEARNING_CLUSTERS = 32  # random clusters from which the hyperparameters are learned
LEARNING_POINTS = 128  # largest number of points of each of them that is used
MAX_POINTS = 512  # per cluster; larger clusters are subsampled, because the cost is cubic
BATCH_ENTRIES = 1 << 24  # entries of the covariance matrices that are factored at a time


class LocalGP:
    """A Gaussian process for every cluster of points; queries average the k nearest processes.

    Both classes are clustered together, because a process with one label only has no boundary to
    learn. All processes share hyperparameters, which maximize the marginal likelihood of random
    clusters; separate ones for each cluster overfit.

    Args:
        points_per_cluster: average number of points per cluster.
        num_neighbors: number k of nearest processes that are averaged.
        seed: random seed.
        dtype: of the computation.

    Source: Guizilini & Ramos 2016, Section IV.
    """

    def __init__(
        self,
        points_per_cluster: int = 100,
        num_neighbors: int = 5,
        *,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        for name, value in {
            "points_per_cluster": points_per_cluster,
            "num_neighbors": num_neighbors,
        }.items():
            if value < 1:
                raise ValueError(f"{name} must be 1 or more; got {value}")
        self.points_per_cluster, self.num_neighbors = points_per_cluster, num_neighbors
        self.seed, self.dtype = seed, dtype
        self.fitted: _Fitted | None = None

    def fit(self, points: Tensor, labels: Tensor) -> LocalGP:
        """Cluster the points, learn hyperparameters, and condition every process on its cluster.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free.

        Raises:
            ValueError: the samples are invalid (see `LardHilbertMap.fit`).
        """
        points, labels = check_samples(points.double(), labels, points.shape[-1], points.device)
        rng = torch.Generator(device=points.device).manual_seed(self.seed)
        origin = points.mean(dim=0).round()
        local = (points - origin).to(self.dtype)
        local, targets = in_morton_order(local, 2 * labels.to(self.dtype) - 1)
        centers = mini_batch_kmeans(local, max(1, len(local) // self.points_per_cluster), rng)
        members = _members(local, centers, rng)
        centers = centers[
            torch.as_tensor([len(rows) > 0 for rows in members], device=centers.device)
        ]
        members = sorted((rows for rows in members if len(rows)), key=len)
        means = torch.stack([local[rows].mean(dim=0) for rows in members])
        scale, steepness = self._learn(local, targets, members, rng)
        posteriors: list[Posterior] = []
        for batch in _batches(members):
            padded = _pad(local, targets, batch)
            fitted = condition(*padded, squared_exponential, scale)
            for row, rows in enumerate(batch):
                n = len(rows)
                parts = (
                    fitted.points[row, :n],
                    fitted.factor[row, :n, :n],
                    fitted.coefficients[row, :n],
                )
                posteriors.append(Posterior(*(part.clone() for part in parts)))
        self.fitted = _Fitted(means, posteriors, scale, steepness, origin)
        return self

    def _learn(
        self, local: Tensor, targets: Tensor, members: list[Tensor], rng: torch.Generator
    ) -> tuple[Hyperparameters, Tensor]:
        chosen = torch.randperm(len(members), generator=rng, device=rng.device)[:LEARNING_CLUSTERS]
        batch = _pad(local, targets, [members[i][:LEARNING_POINTS] for i in chosen.tolist()])
        points, values, present = batch
        spread = torch.stack(
            [
                points[row][present[row]].std(dim=0, correction=0).mean()
                for row in range(len(points))
            ]
        )
        one = points.new_tensor(1.0)
        start = Hyperparameters(spread.mean().clamp(min=1e-3), one, 0.1 * one)
        scale = learn_hyperparameters(*batch, squared_exponential, start)
        mean, variance = leave_one_out(condition(*batch, squared_exponential, scale), values, scale)
        return scale, learn_squash(mean[present], variance[present], (values[present] + 1) / 2)

    def probability(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) probability of occupancy; 1/2 far from all points.

        Raises:
            RuntimeError: `fit` has not been called.
            ValueError: points are not (N, D).
        """
        mean, variance = self.predict(points)
        return squash(mean, variance, self._ready().steepness)

    __call__ = probability

    @torch.no_grad()
    def predict(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, D) world positions [m] -> (N,) mean of the target in [-1, 1] and (N,) its variance.

        The k nearest processes are weighted by their inverse variances. The variance is their
        harmonic mean: it does not fall with k, because neighboring processes have correlated
        points.
        """
        fitted = self._ready()
        if points.ndim != 2 or points.shape[1] != fitted.means.shape[1]:
            raise ValueError(
                f"points must be (N, {fitted.means.shape[1]}); got {tuple(points.shape)}"
            )
        local = (points.to(torch.float64) - fitted.origin).to(self.dtype)
        nearest = nearest_centers(local, fitted.means, self.num_neighbors)
        k = nearest.shape[1]
        order = nearest.reshape(-1).argsort(stable=True)
        counts = torch.bincount(nearest.reshape(-1), minlength=len(fitted.means)).tolist()
        weighted, total = local.new_zeros(len(local)), local.new_zeros(len(local))
        for posterior, pairs in zip(fitted.posteriors, order.split(counts), strict=True):
            rows = pairs // k
            if len(rows):
                mean, variance = predict(posterior, local[rows], squared_exponential, fitted.scale)
                weighted.index_add_(0, rows, mean / variance)
                total.index_add_(0, rows, 1 / variance)
        return weighted / total, k / total

    def variance(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) variance of the target, see `predict`."""
        return self.predict(points)[1]

    def _ready(self) -> _Fitted:
        if self.fitted is None:
            raise RuntimeError("probability needs processes; call fit(points, labels) first")
        return self.fitted


class _Fitted(NamedTuple):
    means: Tensor  # (M, D) [m], frame of origin
    posteriors: list[Posterior]
    scale: Hyperparameters
    steepness: Tensor
    origin: Tensor  # (D,) float64 [m]


def _members(local: Tensor, centers: Tensor, rng: torch.Generator) -> list[Tensor]:
    """Rows of the points of each center, at most `MAX_POINTS`, drawn at random."""
    labels = nearest_centers(local, centers, 1).squeeze(1)
    shuffled = torch.randperm(len(local), generator=rng, device=rng.device)
    order = shuffled[labels[shuffled].argsort(stable=True)]
    counts = torch.bincount(labels, minlength=len(centers)).tolist()
    return [rows[:MAX_POINTS] for rows in order.split(counts)]


def _batches(members: list[Tensor]) -> list[list[Tensor]]:
    """Split clusters, sorted by size, into batches of limited total size of covariance matrices."""
    batches: list[list[Tensor]] = [[]]
    for rows in members:
        if (len(batches[-1]) + 1) * len(rows) ** 2 > BATCH_ENTRIES and batches[-1]:
            batches.append([])
        batches[-1].append(rows)
    return batches


def _pad(local: Tensor, targets: Tensor, batch: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """(B, n, D) points, (B, n) targets and (B, n) bool, False for padding."""
    pad = torch.nn.utils.rnn.pad_sequence
    present = pad([torch.ones_like(rows, dtype=torch.bool) for rows in batch], batch_first=True)
    rows = pad(batch, batch_first=True)
    return local[rows], targets[rows], present
