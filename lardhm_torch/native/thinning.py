"""Random choices that depend on the points alone: priorities, and a few points of each cell.

The same points give the same choice, in whatever order and at whatever time they come.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import native

MULTIPLIERS = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)  # of the hash: xxHash's primes
BITS = 31  # of a priority
FARTHEST = 1e15  # numbers of cells are limited to this; those of NaN, too
CELLS = 0x27D4EB2F  # start of the hash that chooses points of a cell: independent of the others
PER_CELL = 4  # points of a cell


def priorities(points: Tensor, start: int = 0) -> Tensor:
    """(N, D) positions -> (N,) int64 hashes of the coordinates in float32, below 2^31.

    Different ``start`` values below 2^32 give different hashes.
    """
    words = points.float().view(torch.int32).long() & 0xFFFFFFFF
    mixed = torch.full_like(words[:, 0], start)
    for axis in range(points.shape[1]):
        mixed = (mixed ^ words[:, axis]) * MULTIPLIERS[axis % 3] & 0xFFFFFFFF
        mixed = mixed ^ (mixed >> 15)
    mixed = mixed * MULTIPLIERS[1] & 0xFFFFFFFF
    return mixed >> (32 - BITS)


def few_per_cell(points: Tensor, groups: Tensor, edge: float) -> Tensor:
    """Ascending rows of at most `PER_CELL` random points of each group in each cell of a lattice.

    Args:
        points: (N, D) positions [m].
        groups: (N,) int64; points of different groups do not compete for a cell.
        edge: of the cells [m].
    """
    if native.supports(points):
        return torch.ops.lardhm.few_per_cell(points.detach(), groups, edge, PER_CELL)
    cells = (points / edge).floor().clamp(-FARTHEST, FARTHEST).nan_to_num(FARTHEST).long()
    _, owners = torch.cat([cells, groups[:, None]], dim=1).unique(dim=0, return_inverse=True)
    order = priorities(points, CELLS).argsort(stable=True)
    order = order[owners[order].argsort(stable=True)]
    sizes = torch.bincount(owners)
    place = torch.arange(len(order), device=order.device)
    place -= (sizes.cumsum(0) - sizes)[owners[order]]
    return order[place < PER_CELL].sort().values
