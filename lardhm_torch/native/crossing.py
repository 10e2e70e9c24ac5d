"""Cells of space that rays crossed, in a hash table: the definition and its choice."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import native

TABLE_BITS = 24  # of a table of cells: a place shares its entry with few others
PRIMES = (73856093, 19349669, 83492791)  # of the hash; Teschner et al. 2003


def table_entry(cells: Tensor) -> Tensor:
    """(..., D) numbers of cells, int64 -> (...) entry of the table that each has, int64."""
    entry = cells[..., 0] * PRIMES[0]
    for axis in range(1, cells.shape[-1]):
        entry = entry ^ (cells[..., axis] * PRIMES[axis % len(PRIMES)])
    return entry & ((1 << TABLE_BITS) - 1)


def never_crossed(
    points: Tensor, starts: Tensor, ahead: Tensor, reach: Tensor, edge: float
) -> Tensor:
    """(N, D) positions -> (N,) bool: no ray went through the cell.

    Each ray is followed in steps of a cell's edge. Cells that a ray cuts by less than a corner may
    be missed, and a place that shares its entry of the table with a crossed cell is held to be
    crossed: that is rare, and costs a sample.

    Args:
        points: (N, D) positions [m].
        starts: (R, D), or (1, D) where all are one, origins of the rays [m].
        ahead: (R, D) their directions, of length 1.
        reach: (R,) how far each was seen to go [m].
        edge: of the cells [m].
    """
    if len(reach) == 0:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    corner = starts.mean(dim=0)
    cells = ((points - corner) / edge).floor().long()
    begins = (starts - corner) / edge
    whole = begins.floor()
    # float32 serves along a ray: it counts from the border of the cell where the ray begins
    rays = (whole.long(), (begins - whole).float(), ahead.float(), (reach / edge).long() + 1)
    if native.supports(points):
        return torch.ops.lardhm.unmarked_cells(cells, *rays)
    return unmarked_cells(cells, *rays)


def unmarked_cells(
    cells: Tensor, starts: Tensor, inside: Tensor, ways: Tensor, steps: Tensor
) -> Tensor:
    """(N, D) numbers of cells -> (N,) bool: no ray marked the cell's entry of the table.

    Args:
        cells: (N, D) int64.
        starts: (R, D) or (1, D) int64, cells where the rays begin.
        inside: of the same shape, float32, where in them, in units of a cell.
        ways: (R, D) float32 directions, of length 1.
        steps: (R,) int64, how many cells on each ray is followed.
    """
    marked = torch.zeros(1 << TABLE_BITS, dtype=torch.bool, device=cells.device)
    order = steps.argsort()
    ends, ways = steps[order], ways[order]
    if len(starts) > 1:
        starts, inside = starts[order], inside[order]
    first = torch.searchsorted(ends, torch.arange(int(ends[-1]), device=ends.device), right=True)
    for step, begin in enumerate(first.tolist()):  # the rays that go farther
        rows = slice(begin if len(starts) > 1 else 0, None)
        along = inside[rows] + ways[begin:] * (step + 0.5)  # two roundings, everywhere the same
        marked[table_entry(starts[rows] + along.floor().long())] = True
    return ~marked[table_entry(cells)]
