"""Points and lattices in groups that one map answers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

SORTED_AT_ONCE = 1 << 19  # rows


def rows_by_number(numbers: Tensor) -> Iterator[tuple[int, slice | Tensor]]:
    """Each number >= 0 of (N,), once, with the rows that have it, ascending; a run is a slice.

    A counting sort, some rows at a time, of four bytes a row.

    >>> dict(rows_by_number(torch.tensor([4, 4, -1, 2])))
    {2: slice(3, 4, None), 4: slice(0, 2, None)}
    """
    if len(numbers) == 0:
        return
    parts = numbers.split(SORTED_AT_ONCE)
    size = int(numbers.max()) + 2  # -1 is a number, too
    counts = torch.stack([torch.bincount(part + 1, minlength=size) for part in parts]).sum(dim=0)
    ends = counts.cumsum(dim=0)
    order = _counting_sort(parts, ends - counts)
    del numbers, parts  # the caller need not hold them while the groups are answered
    begin = int(counts[0])
    for number in counts[1:].nonzero().squeeze(1).tolist():
        rows = order[begin : int(ends[number + 1])]
        begin += len(rows)
        first, last = int(rows[0]), int(rows[-1])
        yield number, slice(first, last + 1) if last - first + 1 == len(rows) else rows.long()


def _counting_sort(parts: Sequence[Tensor], place: Tensor) -> Tensor:
    """(N,) rows by their number, ascending; those of number n - 1 begin at place[n]."""
    total = sum(len(part) for part in parts)
    dtype = torch.int32 if total < 1 << 31 else torch.int64
    order, start = torch.empty(total, dtype=dtype, device=place.device), 0
    for part in parts:
        ordered, rows = part.sort(stable=True)
        found, lengths = ordered.unique_consecutive(return_counts=True)
        shift = place[found + 1] - (lengths.cumsum(0) - lengths)
        goal = torch.arange(len(part), device=place.device) + shift.repeat_interleave(lengths)
        order[goal] = (rows + start).to(dtype)
        place[found + 1] += lengths
        start += len(part)
    return order


def row_numbers(rows: slice | Tensor, device: torch.device) -> Tensor:
    """(R,) the rows one by one."""
    if isinstance(rows, slice):
        return torch.arange(rows.start, rows.stop, device=device)
    return rows


def lattice_parts(
    axes: Sequence[Tensor], origin: Tensor, edge: float
) -> Iterator[tuple[slice, ...]]:
    """Sub-lattices of a lattice that lie in one cell each of another, of this origin and edge [m]."""
    runs = []
    for axis, start in zip(axes, origin.tolist(), strict=True):
        index = ((axis.double() - start) / edge).floor()
        lengths = index.unique_consecutive(return_counts=True)[1].tolist()
        ends = list(itertools.accumulate(lengths, initial=0))
        runs.append([slice(first, last) for first, last in itertools.pairwise(ends)])
    yield from itertools.product(*runs)
