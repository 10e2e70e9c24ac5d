"""Clusters of a tile on disk, between the two phases of a fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.clustering import Clusters
from lardhm_torch.files import replaced_file
from lardhm_torch.tiles.training import TileClusters


def save_clusters(path: Path, found: TileClusters, num_points: int) -> None:
    """Clusters as one array, a row each, behind the number of points they were made of."""
    clusters = found.clusters
    columns = [
        found.is_occupied[:, None].to(clusters.means),
        clusters.counts[:, None].to(clusters.means),
        clusters.means,
        clusters.scatters.flatten(1),
    ]
    with replaced_file(path) as partial, open(partial, "wb") as file:
        np.save(file, np.int64(num_points))
        np.save(file, torch.cat(columns, dim=1).cpu().numpy())


def load_clusters(path: Path, dim: int, like: Tensor) -> TileClusters:
    """What `save_clusters` wrote, on the device and of the dtype of a tensor.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        with open(path, "rb") as file:
            np.load(file)
            table = torch.from_numpy(np.load(file)).to(like)
        kind, counts, means, scatters = table.split([1, 1, dim, dim * dim], dim=1)
    except (ValueError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path} must hold clusters, whole; {error}. Remove it") from error
    moments = Clusters(counts[:, 0].long(), means, scatters.unflatten(1, (dim, dim)))
    return TileClusters(moments, kind[:, 0] > 0.5)


def clustered_points(path: Path) -> int | None:
    """Of how many points the clusters in a file were made; None where there are none."""
    try:
        with open(path, "rb") as file:
            return int(np.load(file))
    except (OSError, ValueError, EOFError):
        return None
