"""Clusters and weights of one tile.

Three things depend on the other tiles, so that all together are as accurate as one map that is
fitted at once (measurements are in docs/scale.md):

- the number of clusters: a tile gets a part of the number for all points (`Budget`);
- the weight of each class in the loss, which is the same in every tile;
- the clusters of the neighbors near the border: they are included while the weights are trained,
  and so are the points just outside the tile. The weights that the neighbors' clusters get here are
  discarded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, raw_factors
from lardhm_torch.learning.assignment import ordered_features
from lardhm_torch.learning.class_balance import class_factors
from lardhm_torch.learning.clustering import (
    MIN_COUNT,
    POINTS_PER_CLUSTER,
    Clusters,
    cluster_each,
    concatenate_clusters,
)
from lardhm_torch.learning.fitting import FitConfig, fit_weights, stratified_batches
from lardhm_torch.learning.map_state import factor_covariances
from lardhm_torch.learning.points import blurred_hits, in_morton_order
from lardhm_torch.tiles.indexing import Index
from lardhm_torch.tiles.ledger import Counts
from lardhm_torch.tiles.records import OCCUPIED, TilePoints

# The number of clusters that gives the best accuracy grows more slowly than the number of points:
# for twice the points, 2^0.8 times the occupied and 2^0.6 times the free clusters.
DENSITY_POWERS = (0.8, 0.6)
LEAST_BATCH = 64  # a larger tile has 128 batches


@dataclass(frozen=True)
class Budget:
    """Numbers that depend on the training points of all tiles and are needed to fit each.

    Args:
        cluster_factors: factors f for the occupied and the free class. A tile with n points of a
            class gets f n^p clusters, with the power p of `DENSITY_POWERS`.
        loss_factors: weights of a free and of an occupied point in the loss.
    """

    cluster_factors: tuple[float, float]
    loss_factors: tuple[float, float]

    def num_clusters(self, counts: Counts) -> tuple[int, int]:
        """Number of occupied and of free clusters of a tile."""
        occupied, free = (
            min(max(1, n // MIN_COUNT), max(1, round(factor * n**power))) if n else 0
            for n, factor, power in zip(counts, self.cluster_factors, DENSITY_POWERS, strict=False)
        )
        return occupied, free


def make_budget(tiles: Mapping[Index, Counts], config: FitConfig) -> Budget:
    """The budget of a folder.

    Over all tiles, each class gets one cluster for every `POINTS_PER_CLUSTER` hits, and the class
    weights of the loss are those of one map of all points.

    Args:
        tiles: numbers of training points of all tiles.
        config: class weights.
    """
    hits, free = (sum(counts[kind] for counts in tiles.values()) for kind in (0, 1))
    total = max(1.0, (hits or free) / POINTS_PER_CLUSTER)
    cluster_factors = [
        total / max(1.0, sum(counts[kind] ** power for counts in tiles.values()))
        for kind, power in enumerate(DENSITY_POWERS)
    ]
    factors = torch.ones(2, dtype=torch.double)
    if config.balance:
        counts = torch.tensor([free, hits], dtype=torch.double)
        factors = class_factors(counts[0], counts[1], config.occupied_share)
    return Budget((cluster_factors[0], cluster_factors[1]), (float(factors[0]), float(factors[1])))


class TileClusters(NamedTuple):
    """M clusters, and whether each is occupied, (M,) bool."""

    clusters: Clusters
    is_occupied: Tensor


def cluster_tile(
    tile: TilePoints, num_clusters: tuple[int, int], rng: torch.Generator
) -> TileClusters:
    """Cluster each class of the points inside a tile; the occupied clusters come first.

    Args:
        tile: points in any order; copies in the halo are ignored.
        num_clusters: number of occupied and of free clusters.
        rng: random state.
    """
    classes = [tile.core_points(label) for label in (OCCUPIED, 0)]
    classes = [in_morton_order(points)[0] if len(points) else points for points in classes]
    return TileClusters(*cluster_each(classes, num_clusters, rng)[:2])


def train_tile(
    tile: TilePoints,
    own: TileClusters,
    around: TileClusters,
    budget: Budget,
    task: TrainingTask,
) -> tuple[Tensor, Tensor]:
    """Train the weights of a tile.

    Args:
        tile: points inside the tile and in its halo, in any order.
        own: M clusters of the tile.
        around: clusters of the neighbors near the border, in the same frame.
        budget: class weights.
        task: kernel, settings, random state.

    Returns:
        (M,) weights and (M, D, D) raw factors of the tile's own clusters.
    """
    clusters = concatenate_clusters([own.clusters, around.clusters])
    raw = raw_factors(factor_covariances(clusters.covariances, task.kernel.min_lengthscale))
    rows = max(LEAST_BATCH, len(tile.points) // 128)
    config = replace(task.config, batch_size=task.config.batch_size or rows)
    size = config.rows_per_batch(len(tile.points))
    points, kind = in_morton_order(*tile)
    points = blurred_hits(points, (kind & OCCUPIED).to(points), config.hit_noise, task.rng)
    order = torch.arange(len(kind), device=kind.device)
    order, kind = stratified_batches((order, kind), size, task.rng)
    index = native.build_index(clusters.means, task.kernel.num_neighbors)

    def features_of(part: slice) -> tuple[Tensor, Tensor]:
        rows, given = order[part], (clusters.means, raw, task.kernel, index)
        if len(rows) == len(points):
            return ordered_features(points, rows, *given)
        return native.nearest_features(points.index_select(0, rows), *given)

    labels = (kind & OCCUPIED).to(points)
    start = clusters.means.new_zeros(len(clusters))
    free, occupied = labels.new_tensor(budget.loss_factors)
    factors = torch.where(labels > 0, occupied, free)
    weights = fit_weights(features_of, labels, start, config, factors=factors)
    return weights[: len(own.clusters)], raw[: len(own.clusters)]


class TrainingTask(NamedTuple):
    """Settings of the training, and its random state."""

    kernel: Kernel
    config: FitConfig
    rng: torch.Generator
