"""Labelled points to the records of the tiles that they lie in, and of those that they lie next to."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.tiles.places import Index, tile_indices
from lardhm_torch.tiles.samples import HALO, Records, record_type

DENSE_CELLS = 1 << 16  # of a box of tiles whose cells are sorted by 16-bit numbers


class Grid(NamedTuple):
    """Where the tiles are: a corner (D,), the edge and the halo [m]."""

    origin: tuple[float, ...]
    edge: float
    halo: float


def grid_origin(near: Tensor, edge: float) -> tuple[float, ...]:
    """(D,) a position [m] -> the nearest corner of tiles that begin at odd multiples of edge / 2."""
    return tuple(edge * (round(float(x) / edge) - 0.5) for x in near)


def route(points: Tensor, labels: Tensor, grid: Grid) -> Iterator[tuple[Index, Records]]:
    """Labelled points to records of the tiles: one in each tile's core, and copies in halos.

    Args:
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free.
        grid: the tiles.

    Yields:
        (index, records) of each tile, in order; within a tile in the order of the points, copies
        last.
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


def _by_tile(index: np.ndarray, records: Records) -> Iterator[tuple[Index, Records]]:
    """Records of each tile, given the (N, D) tile of each."""
    lower = index.min(axis=0)
    shape = index.max(axis=0) - lower + 1
    if np.prod(shape.astype(float)) <= DENSE_CELLS:  # sorted by radix, in linear time
        key = np.ravel_multi_index(tuple((index - lower).T), tuple(shape)).astype(np.uint16)
    else:
        key = np.unique(index, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order].astype(np.int64)) != 0])
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        rows = order[start:end]
        yield tuple(map(int, index[rows[0]])), records[rows]
