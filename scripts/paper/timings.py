"""Tables I and II: stages of LARD-HM, and four methods, on the paper's task of 82,842 points."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    SamplingConfig,
    Scans,
    load_scans,
    native,
    sample_rays,
)
from lardhm_torch.evaluation.baselines.local_gp import LocalGP
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.baselines.original_hilbert_map import OriginalHilbertMap
from lardhm_torch.features import raw_factors
from lardhm_torch.io.octrees import to_array
from lardhm_torch.learning.clustering import clusters_from_moments
from lardhm_torch.learning.fitting import fit_weights, stratified_batches
from lardhm_torch.learning.kmeans import mini_batch_kmeans
from lardhm_torch.learning.map_state import factor_covariances
from lardhm_torch.learning.points import in_morton_order

NUM_CLUSTERS, NUM_NEIGHBORS, RESOLUTION = 500, 5, 0.05
NUM_POINTS, NUM_QUERIES = 82_842, 638_683
RUNS, SLOW_RUNS = 10, 3
ONE_FREE_POINT = SamplingConfig(
    min_range=0.0, free_samples=1, near_samples=0, passing_samples=0, behind_samples=0
)
ONE_PASS = FitConfig(passes=1)
GRID_CELL = 0.2  # [m] of Original HM: 15,750 nodes over the room, as the authors' program
POINTS_PER_PROCESS = NUM_POINTS // NUM_CLUSTERS  # as many processes as clusters


class Task(NamedTuple):
    """(N, 3) points [m] and (N,) labels, (Q, 3) grid [m], and the rays they come from."""

    points: Tensor
    labels: Tensor
    grid: Tensor
    scans: Scans


def load_task(data: Path) -> Task:
    """One hit and one free point of each of 41,421 rays; the grid of the paper's Table II."""
    path = data / "paper_virtual" / "scans.npz"
    scans = load_scans(path)
    samples = sample_rays(scans, ONE_FREE_POINT, seed=0)
    with np.load(path) as arrays:
        lower, shape = arrays["grid_lower"], arrays["grid_shape"].tolist()
        axes = [
            low + arrays["grid_step"] * np.arange(n) for low, n in zip(lower, shape, strict=True)
        ]
    grid = torch.cartesian_prod(*(torch.as_tensor(axis) for axis in axes)).float()
    if (len(samples), len(grid)) != (NUM_POINTS, NUM_QUERIES):
        raise ValueError(f"the task must have {NUM_POINTS} and {NUM_QUERIES} points; got others")
    return Task(samples.points.float(), samples.labels.float(), grid, scans)


def table_one(data: Path, folder: Path) -> dict[str, Any]:
    """Milliseconds of every stage: mean and standard deviation of 10 runs, after one to warm up."""
    task = load_task(data)
    origin = task.points.mean(dim=0).round()
    local, grid = task.points - origin, task.grid - origin
    runs: dict[str, list[float]] = {}
    for run in range(RUNS + 1):
        for name, seconds in _stages(local, task.labels, grid, run).items():
            if run:
                runs.setdefault(name, []).append(1e3 * seconds)
    return {name: _spread(values) for name, values in runs.items()}


def _stages(local: Tensor, labels: Tensor, grid: Tensor, seed: int) -> dict[str, float]:
    rng, took = torch.Generator().manual_seed(seed), {}
    kernel = LardHilbertMap(num_neighbors=NUM_NEIGHBORS).kernel

    def timed(name: str, run: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = run()
        took[name] = took.get(name, 0.0) + time.perf_counter() - start
        return result

    local, labels = timed("clustering", lambda: in_morton_order(local, labels))
    parts = []
    for members in (local[labels > 0.5], local[labels <= 0.5]):
        count = NUM_CLUSTERS // 2
        means = timed("clustering", lambda m=members, c=count: mini_batch_kmeans(m, c, rng))

        def moments(members: Tensor = members, means: Tensor = means) -> tuple[Tensor, Tensor]:
            clusters = clusters_from_moments(means, *native.assign(members, means)[1:])
            factors = factor_covariances(clusters.covariances, kernel.min_lengthscale)
            return clusters.means, raw_factors(factors)

        parts.append(timed("length-scales", moments))
    centers, factors = (torch.cat([part[i] for part in parts]) for i in (0, 1))

    def features(points: Tensor) -> tuple[Tensor, Tensor]:
        index = native.build_index(centers, NUM_NEIGHBORS)
        return native.nearest_features(points, centers, factors, kernel, index)

    local, labels = stratified_batches((local, labels), FitConfig().rows_per_batch(len(local)), rng)
    indices, values = timed("training features", lambda: features(local))

    def trained(config: FitConfig) -> Tensor:
        start = torch.zeros(len(centers))
        return fit_weights(lambda rows: (indices[rows], values[rows]), labels, start, config)

    timed("SGD, one pass", lambda: trained(ONE_PASS))
    weights = timed("SGD, as `fit`", lambda: trained(FitConfig()))
    indices_of_grid, values_of_grid = timed("grid features", lambda: features(grid))
    timed(
        "grid query",
        lambda: torch.sigmoid((values_of_grid * weights[indices_of_grid]).sum(dim=1)),
    )
    index = native.build_index(centers, NUM_NEIGHBORS)
    timed(
        "grid features and query, fused",
        lambda: native.occupancy(
            grid, centers, factors, weights, kernel, probability=True, index=index
        ),
    )
    return took


def table_two(data: Path, folder: Path) -> dict[str, Any]:
    """Milliseconds to train and to query, methods in turn; the slow ones in 3 rounds of the 10."""
    task = load_task(data)
    runs: dict[str, dict[str, list[float]]] = {}
    contenders = _contenders(task)
    for name in ("LARD-HM", "OctoMap"):  # one to warm up
        _once(contenders[name])
    for round_number in range(RUNS):
        for name, contender in contenders.items():
            if round_number < SLOW_RUNS or name in ("LARD-HM", "OctoMap"):
                train, query = _once(contender)
                times = runs.setdefault(name, {"train": [], "query": []})
                times["train"].append(1e3 * train)
                times["query"].append(1e3 * query)
    return {
        name: {stage: _spread(values) for stage, values in times.items()}
        for name, times in runs.items()
    }


def _contenders(task: Task) -> dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]]:
    """Two calls for each method: train, and query the trained one."""
    points, labels, grid = task.points, task.labels, task.grid

    def lard() -> LardHilbertMap:
        model = LardHilbertMap(num_neighbors=NUM_NEIGHBORS)
        return model.fit(points, labels, num_clusters=NUM_CLUSTERS)

    def get_labels(model: OctoMapBaseline) -> Any:
        return model.tree.getLabels(to_array(grid.double() - model.origin))

    return {
        "LARD-HM": (lard, lambda model: model(grid)),
        "OctoMap": (lambda: OctoMapBaseline(RESOLUTION).fit(task.scans), get_labels),
        "Original HM": (
            lambda: OriginalHilbertMap(GRID_CELL).fit(points, labels),
            lambda model: model(grid),
        ),
        "Local GP": (
            lambda: LocalGP(POINTS_PER_PROCESS, NUM_NEIGHBORS).fit(points, labels),
            lambda model: model(grid),
        ),
    }


@torch.no_grad()
def _once(contender: tuple[Callable[[], Any], Callable[[Any], Any]]) -> tuple[float, float]:
    train, query = contender
    start = time.perf_counter()
    model = train()
    trained = time.perf_counter()
    query(model)
    return trained - start, time.perf_counter() - trained


def _spread(values: list[float]) -> dict[str, float]:
    return {
        "mean": statistics.fmean(values),
        "std": statistics.stdev(values),
        "median": statistics.median(values),
        "runs": len(values),
    }
