"""A few points of each cell, natively and in plain torch."""

import pytest
import torch
from native_maps import dims, dtypes, make_points

from lardhm_torch import native
from lardhm_torch.native.thinning import PER_CELL, few_per_cell, priorities


@pytest.fixture
def plain(monkeypatch):
    """A function without the native library."""

    def call(function, *given):
        with monkeypatch.context() as context:
            context.setattr(native, "supports", lambda *_: False)
            return function(*given)

    return call


def crowded(dim, dtype, count=3000):
    """Points with many in a cell of 0.5 m, and their groups."""
    points = make_points(count, dim, dtype)
    points[: count // 3] *= 0.1
    return points, torch.arange(count) % 3


@dims
@dtypes
def test_native_rows_are_those_of_the_definition(ops, plain, dtype, dim):
    points, groups = crowded(dim, dtype)
    points[5], points[6, 0], points[7, 1] = torch.nan, torch.inf, -1e30
    chosen = few_per_cell(points, groups, 0.5)
    assert torch.equal(chosen, plain(few_per_cell, points, groups, 0.5))
    assert len(few_per_cell(points[:0], groups[:0], 0.5)) == 0


@dims
def test_every_cell_keeps_as_many_points_as_it_may(dim):
    points, groups = crowded(dim, torch.float64)
    cells = torch.cat([(points / 0.5).floor().long(), groups[:, None]], dim=1)
    chosen = few_per_cell(points, groups, 0.5)
    every, offered = cells.unique(dim=0, return_counts=True)
    kept, sizes = cells[chosen].unique(dim=0, return_counts=True)
    assert torch.equal(kept, every)
    assert torch.equal(sizes, offered.clamp(max=PER_CELL))
    assert offered.max() > PER_CELL


def test_the_choice_depends_on_the_points_alone():
    points, groups = crowded(3, torch.float64)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    chosen = few_per_cell(points, groups, 0.5)
    assert torch.equal(order[few_per_cell(points[order], groups[order], 0.5)].sort().values, chosen)
    again = few_per_cell(points[chosen], groups[chosen], 0.5)
    assert torch.equal(again, torch.arange(len(chosen)))


def test_choices_in_cells_are_independent_of_priorities():
    points, groups = (
        torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)),
        torch.zeros(4000),
    )
    chosen = few_per_cell(points, groups.long(), 0.25)
    ranks = priorities(points).double() / 2**31
    assert len(chosen) < 300
    assert abs(float(ranks[chosen].mean()) - 0.5) < 0.1


def test_opcheck_accepts_the_operator(ops):
    points, groups = crowded(3, torch.float64, 40)
    torch.library.opcheck(ops.few_per_cell.default, (points, groups, 0.5, 2))
