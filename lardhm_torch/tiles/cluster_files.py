"""Clusters of a tile on disk, between the two phases of a fit: written by one rank, read by others.

Two int64, the number of points that the clusters were made of and the number M of clusters, then M
rows of float32 or float64: 1 occupied or 0 free, count, mean, scatter. A tile reads the clusters of
up to 26 neighbors, so reading must take microseconds.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.clustering import Clusters
from lardhm_torch.files import replaced_file
from lardhm_torch.tiles.manifest import Index, tile_name
from lardhm_torch.tiles.training import TileClusters

_HEAD_BYTES = 16


def clusters_path(folder: str | os.PathLike[str], index: Index) -> Path:
    """The clusters of a tile's core."""
    return Path(folder) / "clusters" / tile_name(index)


def save_clusters(path: Path, found: TileClusters, num_points: int) -> None:
    """Write the clusters of a tile's ``num_points`` points, in one step."""
    clusters = found.clusters
    columns = [
        found.is_occupied[:, None].to(clusters.means),
        clusters.counts[:, None].to(clusters.means),
        clusters.means,
        clusters.scatters.flatten(1),
    ]
    table = torch.cat(columns, dim=1).cpu().numpy()
    # Not durable: what a power failure cuts is seen by its size, and made anew.
    with replaced_file(path, durable=False) as partial, open(partial, "wb") as file:
        file.write(np.array([num_points, len(table)], "<i8").tobytes())
        file.write(table.tobytes())


def load_clusters(path: Path, like: Tensor) -> TileClusters:
    """What `save_clusters` wrote, on the device and of the dtype of a tensor (..., D).

    Raises:
        ValueError: the file is damaged.
    """
    dim = like.shape[-1]
    kind = np.float64 if like.dtype == torch.float64 else np.float32
    if clustered_points(path, like) is None:
        raise ValueError(f"{path} must hold clusters, whole; it does not. Run the fit again")
    values = np.fromfile(path, kind, offset=_HEAD_BYTES)
    table = torch.from_numpy(values).to(like.device).reshape(-1, 2 + dim + dim * dim)
    occupied, counts, means, scatters = table.split([1, 1, dim, dim * dim], dim=1)
    moments = Clusters(
        counts[:, 0].long(), means.contiguous(), scatters.reshape(-1, dim, dim).contiguous()
    )
    return TileClusters(moments, occupied[:, 0] > 0.5)


def clustered_points(path: Path, like: Tensor) -> int | None:
    """Of how many points the clusters in a file were made; None if there is no such file, whole."""
    try:
        num_points, rows = np.fromfile(path, "<i8", 2).tolist()
        size = path.stat().st_size
    except (OSError, ValueError):
        return None
    dim = like.shape[-1]
    row_bytes = like.element_size() * (2 + dim + dim * dim)
    return num_points if size == _HEAD_BYTES + rows * row_bytes else None
