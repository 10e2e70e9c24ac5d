"""Points and lattices in groups that one map answers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor


def rows_by_number(numbers: Tensor) -> Iterator[tuple[int, slice | Tensor]]:
    """Each number >= 0 of (N,), once, with the rows that have it; runs of rows stay runs.

    >>> dict(rows_by_number(torch.tensor([4, 4, -1, 2])))
    {2: slice(3, 4, None), 4: slice(0, 2, None)}
    """
    values, lengths = numbers.unique_consecutive(return_counts=True)
    begins = lengths.cumsum(0) - lengths
    order = values.argsort(stable=True)
    for runs in order.split(values.unique(return_counts=True)[1].tolist()):
        number, first = int(values[runs[0]]), int(begins[runs[0]])
        if number < 0:
            continue
        if len(runs) == 1:
            yield number, slice(first, first + int(lengths[runs[0]]))
        else:
            yield number, _spread(begins[runs], lengths[runs])


def _spread(begins: Tensor, lengths: Tensor) -> Tensor:
    """Begins and lengths (R,) of runs -> all rows in them."""
    owner = torch.repeat_interleave(lengths)
    ends = lengths.cumsum(0)
    within = torch.arange(len(owner), device=owner.device) - (ends - lengths)[owner]
    return begins[owner] + within


def shifted(rows: slice | Tensor, start: int) -> slice | Tensor:
    """The same rows of something that begins ``start`` rows earlier."""
    if isinstance(rows, slice):
        return slice(rows.start + start, rows.stop + start)
    return rows + start


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
