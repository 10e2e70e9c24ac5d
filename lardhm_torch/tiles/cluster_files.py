"""Clusters of a tile on disk, between the two phases of a fit: written by one rank, read by others.

Two int64, the number of points that the clusters were made of and the number M of clusters, then M
rows of float32 or float64: 1 occupied or 0 free, count, mean, scatter. A tile reads the clusters of
up to 26 neighbors, so reading must take microseconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.tiles.places import Index, tile_name
from lardhm_torch.tiles.training import TileClusters

_HEAD_BYTES = 16
Corner = NDArray[np.float64]
Box = tuple[Corner, Corner]


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
    return _as_clusters(_table(path, like), like)


def load_clusters_near(
    sources: Iterable[tuple[Path, Corner]], box: Box, like: Tensor
) -> TileClusters:
    """The clusters of several files that lie in a box, as one.

    Args:
        sources: files, and where the origin of each file's frame lies (D,) [m].
        box: lower and upper corner (D,) [m].
        like: gives device, dtype and dimension.
    """
    dim = like.shape[-1]
    parts = [np.empty((0, 2 + dim + dim * dim), _kind(like))]
    for path, shift in sources:
        table = _table(path, like)
        inside = np.ones(len(table), dtype=bool)
        for column, low, high in zip(table.T[2:], box[0] - shift, box[1] - shift, strict=False):
            inside &= (column >= low) & (column <= high)
        table = table[inside]
        table[:, 2 : 2 + dim] += shift
        parts.append(table)
    return _as_clusters(np.concatenate(parts), like)


def _as_clusters(table: NDArray[Any], like: Tensor) -> TileClusters:
    dim = like.shape[-1]
    columns = torch.from_numpy(table).to(like.device)
    occupied, counts, means, scatters = columns.split([1, 1, dim, dim * dim], dim=1)
    moments = Clusters(
        counts[:, 0].long(), means.contiguous(), scatters.reshape(-1, dim, dim).contiguous()
    )
    return TileClusters(moments, occupied[:, 0] > 0.5)


def _table(path: Path, like: Tensor) -> NDArray[Any]:
    found = _read(path, like)
    if found is None:
        raise ValueError(f"{path} must hold clusters, whole; it does not. Run the fit again")
    return found[1]


def _kind(like: Tensor) -> str:
    return "<f8" if like.dtype == torch.float64 else "<f4"


def clustered_points(path: Path, like: Tensor) -> int | None:
    """Of how many points the clusters in a file were made; None if there is no such file, whole."""
    found = _read(path, like)
    return None if found is None else found[0]


def _read(path: Path, like: Tensor) -> tuple[int, NDArray[Any]] | None:
    try:
        content = np.fromfile(path, np.uint8)
    except OSError:
        return None
    if len(content) < _HEAD_BYTES:
        return None
    num_points, rows = content[:_HEAD_BYTES].view("<i8").tolist()
    dim = like.shape[-1]
    columns = 2 + dim + dim * dim
    if len(content) != _HEAD_BYTES + rows * columns * like.element_size():
        return None
    return num_points, content[_HEAD_BYTES:].view(_kind(like)).reshape(rows, columns)
