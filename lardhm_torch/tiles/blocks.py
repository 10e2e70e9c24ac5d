"""Blocks of tiles: cubes of a few tiles, each queried as one map; points are grouped by block."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.tiles.layout import Layout, support_boxes

SORTED_AT_ONCE = 1 << 19  # rows


class Blocks(NamedTuple):
    """The B blocks in which any tile contributes, numbered in the lattice that contains them all.

    Args:
        first: (D,) index of the lowest block.
        shape: numbers of blocks of the lattice along each axis.
        keys: (B,) int64, ascending: position of each block in the flattened lattice.
    """

    first: Tensor
    shape: tuple[int, ...]
    keys: Tensor

    def indices(self) -> Tensor:
        """(B, D) index of each block."""
        steps = torch.unravel_index(self.keys, self.shape)
        return torch.stack(steps, dim=1) + self.first

    def find(self, blocks: Tensor) -> Tensor:
        """(N, D) indices of blocks -> (N,) int32 number of each among the B, or -1."""
        shape = torch.tensor(self.shape, device=blocks.device)
        steps = blocks - self.first.to(blocks.device)
        inside = ((steps >= 0) & (steps < shape)).all(dim=1)
        key = torch.zeros_like(steps[:, 0])
        for axis, count in enumerate(self.shape):
            key = key * count + steps[:, axis]
        keys = self.keys.to(blocks.device)
        number = torch.searchsorted(keys, key).clamp(max=max(0, len(keys) - 1))
        inside &= (keys[number] == key) if len(keys) else torch.zeros_like(inside)
        return torch.where(inside, number, -1).to(torch.int32)


def blocks_of(layout: Layout) -> Blocks:
    """The blocks that intersect the support of any tile.

    Raises:
        ValueError: the tiles are so far apart that their blocks cannot be numbered.
    """
    dim = len(layout.origin)
    if not layout.indices:
        empty = torch.zeros(0, dtype=torch.long)
        return Blocks(torch.zeros(dim, dtype=torch.long), (1,) * dim, empty)
    first, last = (
        ((corner - layout.origin) / layout.block_edge).floor().long()
        for corner in support_boxes(layout)
    )
    lowest = first.amin(dim=0)
    shape = tuple(int(n) for n in last.amax(dim=0) - lowest + 1)
    if math.prod(shape) >= 1 << 62:
        raise ValueError(f"tiles must be closer together; they span {shape} blocks")
    keys = []
    for low, high in zip((first - lowest).tolist(), (last - lowest).tolist(), strict=True):
        axes = [torch.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
        key = torch.zeros(1, dtype=torch.long)
        for axis, count in zip(axes, shape, strict=True):
            key = (key[:, None] * count + axis).reshape(-1)
        keys.append(key)
    return Blocks(lowest, shape, torch.cat(keys).unique())


def block_box(layout: Layout, block: Tensor) -> tuple[Tensor, Tensor]:
    """Corners (D,) and (D,) of the block with this index, world frame [m]."""
    lower = layout.origin + layout.block_edge * block.double()
    return lower, lower + layout.block_edge


def rows_by_number(numbers: Tensor) -> Iterator[tuple[int, slice | Tensor]]:
    """Each number >= 0 of (N,), once, with its rows in ascending order.

    Consecutive rows are given as a slice. The counting sort needs four bytes for each row.

    >>> dict(rows_by_number(torch.tensor([4, 4, -1, 2])))
    {2: slice(3, 4, None), 4: slice(0, 2, None)}
    """
    if len(numbers) == 0:
        return
    parts = numbers.split(SORTED_AT_ONCE)
    size = int(numbers.max()) + 2  # -1 is counted, too
    counts = torch.stack([torch.bincount(part + 1, minlength=size) for part in parts]).sum(dim=0)
    ends = counts.cumsum(dim=0)
    order = _counting_sort(parts, ends - counts)
    del numbers, parts  # frees their memory while the groups are used, unless the caller holds them
    begin = int(counts[0])
    for number in counts[1:].nonzero().squeeze(1).tolist():
        rows = order[begin : int(ends[number + 1])]
        begin += len(rows)
        first, last = int(rows[0]), int(rows[-1])
        yield number, slice(first, last + 1) if last - first + 1 == len(rows) else rows.long()


def _counting_sort(parts: Sequence[Tensor], starts: Tensor) -> Tensor:
    """(N,) rows in ascending order of their number; those of number n - 1 begin at starts[n].

    Overwrites ``starts``.
    """
    total = sum(len(part) for part in parts)
    dtype = torch.int32 if total < 1 << 31 else torch.int64
    order, start = torch.empty(total, dtype=dtype, device=starts.device), 0
    for part in parts:
        ordered, rows = part.sort(stable=True)
        found, lengths = ordered.unique_consecutive(return_counts=True)
        shift = starts[found + 1] - (lengths.cumsum(0) - lengths)
        goal = torch.arange(len(part), device=starts.device) + shift.repeat_interleave(lengths)
        order[goal] = (rows + start).to(dtype)
        starts[found + 1] += lengths
        start += len(part)
    return order


def row_numbers(rows: slice | Tensor, device: torch.device) -> Tensor:
    """(R,) the rows of a slice or tensor as a tensor."""
    if isinstance(rows, slice):
        return torch.arange(rows.start, rows.stop, device=device)
    return rows


def lattice_parts(axes: Sequence[Tensor], layout: Layout) -> Iterator[tuple[slice, ...]]:
    """Slices of the axes of a lattice, such that the points of each part lie in one block."""
    runs = []
    for axis, start in zip(axes, layout.origin.tolist(), strict=True):
        index = ((axis.double() - start) / layout.block_edge).floor()
        lengths = index.unique_consecutive(return_counts=True)[1].tolist()
        ends = list(itertools.accumulate(lengths, initial=0))
        runs.append([slice(first, last) for first, last in itertools.pairwise(ends)])
    yield from itertools.product(*runs)
