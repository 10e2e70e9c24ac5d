"""Files that hold the clusters of a tile between the two phases of a fit.

One process writes the file of a tile and several read it: a tile needs the clusters of up to 26
neighbors, so that reading must take microseconds. Three int64: the number of points that were
clustered, the number M of clusters, and the CRC-32 of what follows: M rows of float32 or float64,
each 1 (occupied) or 0 (free), count, mean and scatter.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.tiles.training import TileClusters

_HEAD_BYTES = 24
Corner = NDArray[np.float64]
Box = tuple[Corner, Corner]


def save_clusters(path: Path, found: TileClusters, num_points: int) -> None:
    """Write the clusters of a tile atomically.

    Args:
        path: the file.
        found: the clusters.
        num_points: number of points that were clustered.
    """
    clusters = found.clusters
    columns = [
        found.is_occupied[:, None].to(clusters.means),
        clusters.counts[:, None].to(clusters.means),
        clusters.means,
        clusters.scatters.flatten(1),
    ]
    table = torch.cat(columns, dim=1).cpu().numpy().tobytes()
    head = np.array([num_points, len(found.is_occupied), zlib.crc32(table)], "<i8")
    # Without fsync: a file that a power failure truncates is recognized and written again.
    with replaced_file(path, durable=False) as partial:
        partial.write_bytes(head.tobytes() + table)


def load_clusters(path: Path, like: Tensor) -> TileClusters:
    """Read the clusters of a tile, with the device and dtype of a tensor (..., D).

    Raises:
        ValueError: the file is missing or damaged.
    """
    return _as_clusters(_table(path, like), like)


def load_clusters_near(
    sources: Iterable[tuple[Path, Corner]], box: Box, like: Tensor
) -> TileClusters:
    """Read the clusters of several tiles whose means lie in a box.

    Args:
        sources: files, and the offset (D,) [m] that moves the means of each to a common frame.
        box: lower and upper corner (D,) in that frame [m].
        like: tensor (..., D) that gives device and dtype.

    Raises:
        ValueError: a file is missing or damaged.
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


def clustered_points(path: Path, like: Tensor) -> int | None:
    """Number of points whose clusters a file holds; None if it is missing or damaged."""
    found = _read(path, like)
    return None if found is None else found[0]


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
        raise ValueError(f"{path} must hold all clusters of a tile: fit the tiles again")
    return found[1]


def _kind(like: Tensor) -> str:
    return "<f8" if like.dtype == torch.float64 else "<f4"


def _read(path: Path, like: Tensor) -> tuple[int, NDArray[Any]] | None:
    """Number of points and (M, ...) rows; None if the file is missing or damaged."""
    try:
        content = np.fromfile(path, np.uint8)
    except OSError:
        return None
    if len(content) < _HEAD_BYTES:
        return None
    num_points, rows, checksum = content[:_HEAD_BYTES].view("<i8").tolist()
    dim = like.shape[-1]
    columns = 2 + dim + dim * dim
    body = content[_HEAD_BYTES:]
    if len(body) != rows * columns * like.element_size() or zlib.crc32(body.data) != checksum:
        return None
    table = body.view(_kind(like)).reshape(rows, columns)
    return (num_points, table) if np.isfinite(table).all() and (table[:, 1] >= 0).all() else None
