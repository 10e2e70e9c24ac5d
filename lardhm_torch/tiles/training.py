"""One tile from its points: clusters of its core, weights among the clusters of its neighbors.

A tile of a large map is no map of its own. What it takes from the others, so that all together are
as good as one map fitted at once (docs/scale.md has the measurements):

- how many clusters it gets: its share of the number that all points would get (`Budget`);
- how much a point of each class counts in the loss: the same in every tile;
- at its border, the clusters of its neighbors stand in their places while its weights are trained,
  on the points just across the border too; what the neighbors' weights become there is dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, raw_factors
from lardhm_torch.learning.assignment import ordered_features
from lardhm_torch.learning.clustering import (
    MIN_COUNT,
    POINTS_PER_CLUSTER,
    Clusters,
    cluster_each,
    concatenate_clusters,
)
from lardhm_torch.learning.fitting import FitConfig, class_factors, deal_samples, fit_weights
from lardhm_torch.learning.map_state import factor_covariances
from lardhm_torch.points import in_morton_order
from lardhm_torch.tiles.samples import OCCUPIED, Counts, TilePoints

# Clusters of best accuracy lie denser where points do, but less so: where there are twice the
# points, 2^0.8 times the occupied and 2^0.6 times the free clusters.
DENSITY_POWERS = (0.8, 0.6)
LEAST_BATCH = 64  # a tile of few points needs steps enough, too


@dataclass(frozen=True)
class Budget:
    """What a tile's fit takes from the number of points in all tiles.

    Args:
        clusters_a_unit: of each class, occupied first: clusters of a tile with n points are this
            times n to the class's power of density.
        loss_factors: (2,) of a free and of an occupied point.
    """

    clusters_a_unit: tuple[float, float]
    loss_factors: tuple[float, float]

    def num_clusters(self, counts: Counts) -> tuple[int, int]:
        """Of the occupied and of the free points of a tile."""
        occupied, free = (
            min(max(1, n // MIN_COUNT), max(1, round(unit * n**power))) if n else 0
            for n, unit, power in zip(counts, self.clusters_a_unit, DENSITY_POWERS, strict=False)
        )
        return occupied, free


def make_budget(tiles: Mapping[Any, Counts], config: FitConfig) -> Budget:
    """One cluster a class for every `POINTS_PER_CLUSTER` hits of all tiles, shared out by density.

    The classes share the loss over all tiles as they do over all points of one map.
    """
    hits, free = (sum(counts[kind] for counts in tiles.values()) for kind in (0, 1))
    total = max(1.0, (hits or free) / POINTS_PER_CLUSTER)
    units = [
        total / max(1.0, sum(counts[kind] ** power for counts in tiles.values()))
        for kind, power in enumerate(DENSITY_POWERS)
    ]
    factors = torch.ones(2, dtype=torch.double)
    if config.balance:
        counts = torch.tensor([free, hits], dtype=torch.double)
        factors = class_factors(counts[0], counts[1], config.occupied_share)
    return Budget((units[0], units[1]), (float(factors[0]), float(factors[1])))


class TileClusters(NamedTuple):
    """M clusters, and (M,) which of them are occupied."""

    clusters: Clusters
    is_occupied: Tensor


def cluster_tile(
    tile: TilePoints, num_clusters: tuple[int, int], rng: torch.Generator
) -> TileClusters:
    """Both classes of a tile's core, clustered apart; the occupied clusters first.

    Args:
        tile: points of the core, in any order; those of the halo are left out.
        num_clusters: of the occupied and of the free points.
        rng: random state.
    """
    classes = [tile.core_points(label) for label in (OCCUPIED, 0)]
    classes = [in_morton_order(points)[0] if len(points) else points for points in classes]
    return TileClusters(*cluster_each(classes, num_clusters, rng))


def train_tile(
    tile: TilePoints,
    own: TileClusters,
    around: TileClusters,
    budget: Budget,
    task: TrainingTask,
) -> tuple[Tensor, Tensor]:
    """(M,) weights and (M, D, D) raw factors of a tile's own clusters.

    Args:
        tile: points of the core and of the halo, in any order.
        own: M clusters of the core.
        around: the neighbors' clusters that reach into the halo, same frame.
        budget: what a point counts.
        task: kernel, settings, random state.
    """
    clusters = concatenate_clusters([own.clusters, around.clusters])
    raw = raw_factors(factor_covariances(clusters.covariances, task.kernel.min_lengthscale))
    rows = max(LEAST_BATCH, len(tile.points) // 128)
    config = replace(task.config, batch_size=task.config.batch_size or rows)
    size = config.rows_a_batch(len(tile.points))
    points, kind = in_morton_order(*tile)
    order = torch.arange(len(kind), device=kind.device)
    order, kind = deal_samples((order, kind), size, task.rng)
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
    """What the training of every tile needs beside points and clusters."""

    kernel: Kernel
    config: FitConfig
    rng: torch.Generator
