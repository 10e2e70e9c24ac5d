"""Training points of tiles as records: assigned to tiles, appended to files, read as tensors.

A record is a position relative to the lower corner of the tile (float32: micrometers in a tile of
20 m) and one byte of bits: `OCCUPIED` for a hit, `HALO` for a copy of a point that lies outside the
tile, within the halo.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lardhm_torch.learning.clustering import points_where
from lardhm_torch.tiles.indexing import Folder, Index, samples_path, tile_indices

OCCUPIED, HALO = 1, 2  # bits of a record's last byte
DENSE_CELLS = 1 << 16  # a box of at most so many tiles is sorted by 16-bit keys
Records = NDArray[Any]


class Grid(NamedTuple):
    """Corner (D,) of tile (0, ..., 0), edge length and halo of the tiles [m]."""

    origin: tuple[float, ...]
    edge: float
    halo: float


class TilePoints(NamedTuple):
    """Training points of a tile: positions (N, D) [m] and the bits of their records, (N,) uint8."""

    points: Tensor
    kind: Tensor

    @property
    def labels(self) -> Tensor:
        """(N,) 1 occupied, 0 free, in the points' dtype."""
        return (self.kind & OCCUPIED).to(self.points)

    @property
    def in_core(self) -> Tensor:
        """(N,) bool, False for copies in the halo."""
        return self.kind < HALO

    def core_points(self, label: int) -> Tensor:
        """(C, D) points inside the tile with this label."""
        return points_where(self.points, self.kind == label)


def record_type(dim: int) -> np.dtype[Any]:
    """The NumPy dtype of a record."""
    return np.dtype([("position", "<f4", (dim,)), ("kind", "u1")])


def route(points: Tensor, labels: Tensor, grid: Grid) -> Iterator[tuple[Index, Records]]:
    """Records of labeled points for each tile that contains them or has them in its halo.

    Args:
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free.
        grid: the tiles.

    Yields:
        Index and records of each tile, in order of the index. Records are in the order of the
        points, those of the halo last.
    """
    index = tile_indices(points, grid.origin, grid.edge)
    corner = torch.tensor(grid.origin, dtype=torch.float64, device=points.device)
    inside = points.double() - corner - index * grid.edge
    parts = [(index, inside, labels.to(torch.uint8))]
    side = (inside >= grid.edge - grid.halo).long() - (inside < grid.halo).long()
    for axes in itertools.product((0, 1), repeat=points.shape[1]):
        if not any(axes):
            continue
        mask = torch.tensor(axes, dtype=torch.bool, device=points.device)
        rows = (side[:, mask] != 0).all(dim=1).nonzero().squeeze(1)
        step = side[rows] * mask
        copies = inside[rows] - step * grid.edge
        parts.append((index[rows] + step, copies, labels[rows].to(torch.uint8) | HALO))
    columns = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    records = np.empty(len(columns[0]), record_type(points.shape[1]))
    records["position"], records["kind"] = columns[1], columns[2]
    yield from _by_tile(columns[0], records)


def _by_tile(index: NDArray[np.int64], records: Records) -> Iterator[tuple[Index, Records]]:
    """Groups of records with the same tile, given the (N, D) tile of each."""
    lower = index.min(axis=0)
    shape = index.max(axis=0) - lower + 1
    if np.prod(shape.astype(float)) <= DENSE_CELLS:  # NumPy sorts 16-bit keys in linear time
        key = np.ravel_multi_index(tuple((index - lower).T), tuple(shape)).astype(np.uint16)
    else:
        key = np.unique(index, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order].astype(np.int64)) != 0])
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        rows = order[start:end]
        yield tuple(map(int, index[rows[0]])), records[rows]


def append_records(folder: Folder, index: Index, records: Records) -> None:
    """Append records to the file of a tile; they count once the ledger is written."""
    with open(samples_path(folder, index), "ab") as file:
        file.write(records.tobytes())


def read_records(folder: Folder, index: Index, total: int, dim: int, limit: int) -> Records:
    """The first ``total`` records of a tile; if these are more than ``limit``, evenly spaced ones.

    Raises:
        ValueError: the file is missing or shorter than that.
    """
    path, kind = samples_path(folder, index), record_type(dim)
    held = path.stat().st_size if path.is_file() else 0
    if held < total * kind.itemsize:
        raise ValueError(
            f"{path} must hold {total} points; it has {held} bytes: tile the scans again"
        )
    if total <= limit:
        return np.fromfile(path, kind, total)
    rows = np.arange(limit, dtype=np.int64) * total // limit
    return np.memmap(path, kind, "r", shape=(total,))[rows]


def unpack(
    records: Records,
    device: torch.device,
    dtype: torch.dtype,
    shift: NDArray[np.float64] | float = 0.0,
) -> TilePoints:
    """Records as tensors; ``shift`` (D,) [m] is added to the positions."""
    size = records.dtype["position"].itemsize
    blocks = np.dtype(
        {"names": ["position"], "formats": [f"V{size}"], "itemsize": records.itemsize}
    )
    # Copying the positions as opaque blocks is twice as fast as copying single numbers.
    positions = records.view(blocks)["position"].copy().view("<f4").reshape(len(records), -1)
    points = torch.from_numpy(positions)
    points += torch.as_tensor(shift, dtype=torch.float32)
    kind = torch.from_numpy(records["kind"].copy())
    return TilePoints(points.to(device, dtype), kind.to(device))
