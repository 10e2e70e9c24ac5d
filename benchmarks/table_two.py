"""The task of Table II of the paper for this package, OctoMap and plain Python libraries.

82,842 training points (one hit and one free point of each of 41,421 rays), 500 clusters, 5
neighbors, a grid of 638,683 query points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lardhm_torch import LardHilbertMap, SamplingConfig, Scans, load_scans, sample_rays

NUM_CLUSTERS, NUM_NEIGHBORS, RESOLUTION = 500, 5, 0.05
NUM_POINTS, NUM_QUERIES = 82_842, 638_683
ONE_FREE_POINT = SamplingConfig(
    min_range=0.0, free_samples=1, near_samples=0, passing_samples=0, behind_samples=0
)


class Task(NamedTuple):
    """What is timed, in memory: (N, 3) points [m], (N,) labels, (Q, 3) grid, its axes, the rays."""

    points: Tensor
    labels: Tensor
    grid: Tensor
    shuffled: Tensor
    axes: list[Tensor]
    scans: Scans


def load_task(folder: Path) -> Task:
    """The task, made from ``paper_virtual`` in the data folder."""
    path = folder / "paper_virtual" / "scans.npz"
    scans = load_scans(path)
    samples = sample_rays(scans, ONE_FREE_POINT, seed=0)
    with np.load(path) as arrays:
        lower, shape = arrays["grid_lower"], arrays["grid_shape"].tolist()
        axes = [
            low + arrays["grid_step"] * np.arange(n) for low, n in zip(lower, shape, strict=True)
        ]
    axes = [torch.as_tensor(axis) for axis in axes]
    grid = torch.cartesian_prod(*axes).float()
    assert (len(samples), len(grid)) == (NUM_POINTS, NUM_QUERIES)
    order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))
    return Task(samples.points.float(), samples.labels.float(), grid, grid[order], axes, scans)


def fit_map(task: Task) -> LardHilbertMap:
    """Fit a map with the public interface: points in memory to a fitted map."""
    model = LardHilbertMap(dim=3, num_neighbors=NUM_NEIGHBORS)
    return model.fit(task.points, task.labels, num_clusters=NUM_CLUSTERS, seed=0)


# --- OctoMap ---


def load_octomap(name: str) -> Any | None:
    """The module of octomap-python or pyoctomap; None if it is not installed."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def scan_arrays(scans: Scans) -> list[tuple[np.ndarray, np.ndarray]]:
    """(ends, origin) of every scan as the contiguous float64 arrays OctoMap wants."""
    return [
        (np.ascontiguousarray(scans.ends[scans.scan_id == scan]), np.asarray(scans.origins[scan]))
        for scan in range(scans.num_scans)
    ]


def insert(library: Any, rays: list[tuple[np.ndarray, np.ndarray]], discretize: bool) -> Any:
    """Insert the rays into a tree; ``discretize`` keeps one ray per voxel, an option of OctoMap."""
    tree = library.OcTree(RESOLUTION)
    for ends, origin in rays:
        tree.insertPointCloud(ends, origin, discretize=discretize)
    return tree


# --- the same map from plain Python libraries ---


class PlainLibraries:
    """LARD Hilbert Map from scikit-learn's k-means, SciPy's k-d tree and an SGD loop in torch.

    Passes and batches of the SGD are those of ours, so that the same work is timed.
    """

    @torch.enable_grad()
    def fit(self, points: Tensor, labels: Tensor, passes: int, batch_size: int) -> PlainLibraries:
        """Clusters of both classes, precisions, features, weights."""
        rounds = [self._moments(points[labels == value].numpy()) for value in (1, 0)]
        self.centers = torch.cat([centers for centers, _ in rounds])
        self.precisions = torch.cat([precisions for _, precisions in rounds])
        self.tree = cKDTree(self.centers.numpy())
        indices, values = self.features(points)
        weights = torch.zeros(len(self.centers), requires_grad=True)
        optimizer = torch.optim.SGD([weights], lr=10.0)
        for _ in range(passes):
            for rows in torch.randperm(len(points)).split(batch_size):
                log_odds = (values[rows] * weights[indices[rows]]).sum(dim=1)
                loss = torch.nn.functional.binary_cross_entropy_with_logits(log_odds, labels[rows])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        self.weights = weights.detach()
        return self

    def _moments(self, points: np.ndarray) -> tuple[Tensor, Tensor]:
        labels = sklearn_kmeans(points, NUM_CLUSTERS // 2).labels_
        members = [points[labels == cluster] for cluster in range(NUM_CLUSTERS // 2)]
        members = [m for m in members if len(m) >= 5]
        covariances = np.stack([np.cov(m.T) for m in members]) * 4 + 1e-4 * np.eye(3)
        centers = np.stack([m.mean(axis=0) for m in members])
        return torch.as_tensor(centers).float(), torch.as_tensor(np.linalg.inv(covariances)).float()

    def features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, D) -> (N, K) nearest clusters and kernel values."""
        threads = torch.get_num_threads()
        indices = torch.as_tensor(self.tree.query(points, k=NUM_NEIGHBORS, workers=threads)[1])
        offsets = points[:, None] - self.centers[indices]
        squared = torch.einsum("nki,nkij,nkj->nk", offsets, self.precisions[indices], offsets)
        return indices, torch.exp(-0.5 * squared)

    def query(self, points: Tensor) -> Tensor:
        """(N, D) -> (N,) probability of occupancy."""
        indices, values = self.features(points)
        return torch.sigmoid((values * self.weights[indices]).sum(dim=1))


def sklearn_kmeans(points: np.ndarray, num_clusters: int) -> Any:
    """scikit-learn's MiniBatchKMeans with its defaults, on one OpenMP thread: its fastest."""
    from sklearn.cluster import MiniBatchKMeans
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        return MiniBatchKMeans(num_clusters, random_state=0).fit(points)


def inertia(points: Tensor, centers: Tensor) -> float:
    """Sum of squared distances of the points to their nearest centers [m^2]."""
    distances, _ = cKDTree(centers.double().numpy()).query(points.double().numpy())
    return float(np.square(distances).sum())
