"""The native march of rays through cells: equal to the plain one, bit for bit."""

import pytest
import torch
from native_maps import dims
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.native.crossings import PRIMES, TABLE_BITS, never_crossed, unmarked_cells

F64 = torch.float64
MIXED = {"short": 0.3, "long": 300.0}


def make_rays(count: int, dim: int, reach: float, one_start: bool) -> tuple[Tensor, ...]:
    """Starts, directions and lengths [m], some of them zero, some along an axis."""
    rng = torch.Generator().manual_seed(count + dim)
    starts = 5 * torch.randn(1 if one_start else count, dim, generator=rng, dtype=F64)
    ahead = torch.randn(count, dim, generator=rng, dtype=F64)
    ahead[::7, 1:] = 0
    lengths = reach * torch.rand(count, generator=rng, dtype=F64)
    lengths[::11] = 0
    return starts, torch.nn.functional.normalize(ahead, dim=1), lengths


def points_along(starts: Tensor, ahead: Tensor, reach: Tensor) -> Tensor:
    """Places on the rays, some past their ends, and others far from all of them."""
    rng = torch.Generator().manual_seed(3)
    on = starts + 1.3 * torch.rand(len(ahead), 1, generator=rng, dtype=F64) * reach[:, None] * ahead
    far = 1e9 * torch.randn(50, ahead.shape[1], generator=rng, dtype=F64)
    return torch.cat([on, far, on[:20] + 0.25])


@pytest.fixture
def plain(monkeypatch):
    """`never_crossed` without the native library."""

    def run(*given) -> Tensor:
        with monkeypatch.context() as patch:
            patch.setattr(native, "supports", lambda points: False)
            return never_crossed(*given)

    return run


@dims
@pytest.mark.parametrize("one_start", [True, False])
@pytest.mark.parametrize("reach", MIXED)
@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_native_and_plain_find_the_same_cells(ops, plain, dim, one_start, reach, offset):
    starts, ahead, lengths = make_rays(400, dim, MIXED[reach], one_start)
    starts = starts + offset
    points = points_along(starts, ahead, lengths)
    found = never_crossed(points, starts, ahead, lengths, 0.1)
    assert torch.equal(found, plain(points, starts, ahead, lengths, 0.1))
    assert 0 < int(found.sum()) < len(points)


@dims
def test_without_rays_or_points_nothing_is_crossed(ops, plain, dim):
    starts, ahead, lengths = make_rays(3, dim, 5.0, False)
    points = points_along(starts, ahead, lengths)
    none = (starts[:0], ahead[:0], lengths[:0], 0.1)
    assert never_crossed(points, *none).all()
    assert plain(points, *none).all()
    assert never_crossed(points[:0], starts, ahead, lengths, 0.1).shape == (0,)


def test_places_that_share_an_entry_are_both_crossed(ops):
    period = 1 << TABLE_BITS  # in units of a cell: PRIMES are odd
    assert all(prime % 2 for prime in PRIMES)
    cells = torch.tensor([[3, 0, 0], [3 + period, 0, 0], [4, 0, 0]])
    one = torch.zeros(1, 3)
    rays = (one.long(), one + 0.5, torch.tensor([[1.0, 0, 0]]), torch.tensor([3]))
    for march in (ops.unmarked_cells, unmarked_cells):
        assert march(cells, *rays).tolist() == [False, False, True]


@pytest.mark.parametrize("dim", [1, 4])
def test_other_dimensions_are_followed_too(dim):
    start, ahead = torch.zeros(1, dim, dtype=F64), torch.zeros(1, dim, dtype=F64)
    ahead[0, 0] = 1
    points = torch.zeros(3, dim, dtype=F64)
    points[:, 0] = torch.tensor([0.55, 1.95, 2.25])
    found = never_crossed(points, start, ahead, torch.tensor([2.0], dtype=F64), 0.1)
    assert found.tolist() == [False, False, True]


@pytest.mark.parametrize("apart", [1e4, 1e7])
def test_sensors_far_apart_lose_no_digit(apart):
    starts = torch.tensor([[-apart, 0.0, 0], [apart, 0.0, 0]], dtype=F64)
    ahead = torch.tensor([[0.0, 1, 0], [0.0, 1, 0]], dtype=F64)
    offsets = torch.tensor([[0.05, 1.05, 0.05], [0.35, 1.05, 0.05]], dtype=F64)
    points = (starts[:, None] + offsets).flatten(0, 1)
    found = never_crossed(points, starts, ahead, torch.tensor([2.0, 2.0], dtype=F64), 0.1)
    assert found.tolist() == [False, True, False, True]


def test_tensors_that_do_not_fit_are_refused(ops):
    cells, inside = torch.zeros(1, 3).long(), torch.zeros(1, 3)
    ways, steps = torch.ones(2, 3), torch.ones(2).long()
    for given in (
        (cells, cells, inside.double(), ways, steps),
        (cells, cells.repeat(3, 1), inside, ways, steps),
        (cells, cells, inside, ways, steps[:1]),
        (cells[:, :2], cells, inside, ways, steps),
    ):
        with pytest.raises(RuntimeError, match="must be"):
            ops.unmarked_cells(*given)
