import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import ball, radius_where, random_map

from lardhm_torch import LardHilbertMap
from lardhm_torch.queries import bounds
from lardhm_torch.queries.bounds import ceiling_box, cover_cells, log_odds_ceiling
from lardhm_torch.queries.collision import clearance
from lardhm_torch.queries.grids import EVIDENCE


def fitted_map(seed=0):
    """A real map, where k nearest of many clusters answer."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(3000, 3, generator=rng, dtype=torch.float64) * torch.tensor([4.0, 4.0, 2.0])
    labels = ((points[:, 0] - 2).abs() < 0.15).double()
    return LardHilbertMap().fit(points, labels, 120, seed=seed).requires_grad_(False)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**31 - 1), dim=st.integers(1, 3), sign=st.sampled_from([1.0, -1.0]))
def test_no_point_of_a_cell_or_near_it_exceeds_its_ceiling(seed, dim, sign):
    model = random_map(seed=seed, dim=dim)
    lower = torch.full((dim,), -3.0, dtype=torch.float64)
    cells = cover_cells(lower, -lower, 0.3, 1 << 15)
    ceiling = log_odds_ceiling(model, cells, 0.5, sign, margin=0.1)
    assert ceiling.shape == cells.shape
    rng = torch.Generator().manual_seed(seed)
    inside = torch.rand(2000, dim, generator=rng, dtype=torch.float64)
    cell = (inside * torch.tensor(cells.shape)).long()
    points = cells.corner + cells.edge * (cell + torch.rand(2000, dim, generator=rng).double())
    points += 0.2 * torch.rand(2000, dim, generator=rng).double() - 0.1
    assert (sign * model.log_odds(points) <= ceiling[tuple(cell.T)]).all()


def test_ceilings_hold_for_a_map_of_k_nearest_clusters_and_tell_empty_cells(monkeypatch):
    model = fitted_map()
    monkeypatch.setattr(bounds, "CHUNK_PAIRS", 5000)
    box = ceiling_box(model, 1.0)
    cells = cover_cells(*box, 0.1, 1 << 20)
    ceiling = log_odds_ceiling(model, cells, 1.0)
    points = box[0] + torch.rand(20_000, 3, dtype=torch.float64) * (box[1] - box[0])
    cell = ((points - cells.corner) / cells.edge).long()
    assert (model.log_odds(points) <= ceiling[tuple(cell.T)]).all()
    assert 0.02 < float((ceiling > 1).double().mean()) < 0.6


def test_outside_of_the_box_nothing_exceeds_the_target():
    model = random_map(seed=5)
    lower, upper = ceiling_box(model, 0.5)
    points = 12 * torch.rand(5000, 3, dtype=torch.float64) - 6
    outside = ((points < lower) | (points > upper)).any(dim=1)
    assert outside.any()
    assert (model.log_odds(points)[outside] < 0.5).all()
    assert ceiling_box(ball(weight=-1.0), 0.5) is None


def test_cells_cover_the_box_and_are_no_more_than_allowed():
    lower, upper = torch.zeros(3).double(), torch.tensor([4.0, 2.0, 0.0]).double()
    cells = cover_cells(lower, upper, 0.1, 200)
    assert math.prod(cells.shape) <= 200
    assert (cells.edge * torch.tensor(cells.shape) >= upper - 1e-9).all()
    assert cover_cells(lower, upper, 0.1, 10_000).shape == (40, 20, 1)


def test_clearance_of_a_ball_is_the_distance_to_where_it_is_clearly_occupied():
    points = torch.tensor([[2.0, 0, 0], [0.0, -3.0, 0.0], [0.4, 0, 0]]).double()
    expected = points.norm(dim=1) - radius_where(EVIDENCE)
    torch.testing.assert_close(clearance(ball(), points).detach(), expected)


def test_nothing_clearly_occupied_is_nearer_than_the_clearance():
    model = fitted_map()
    rng = torch.Generator().manual_seed(3)
    points = torch.rand(300, 3, generator=rng, dtype=torch.float64) * 4
    distance = clearance(model, points)
    free = distance > 0
    assert free.sum() > 50
    around = torch.randn(300, 200, 3, generator=rng, dtype=torch.float64)
    around = around / around.norm(dim=2, keepdim=True) * distance.clamp(min=0)[:, None, None]
    assert (model.log_odds(points[:, None] + around)[free] <= EVIDENCE).all()


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1))
def test_clearance_changes_by_no_more_than_the_way_gone(seed):
    rng = torch.Generator().manual_seed(seed)
    model = random_map(seed=seed)
    model.weights.data.abs_().add_(0.5)
    here, there = 3 * torch.randn(2, 200, 3, generator=rng, dtype=torch.float64)
    change = (clearance(model, here) - clearance(model, there)).abs()
    assert (change <= (here - there).norm(dim=1) + 1e-9).all()


def test_gradients_of_the_clearance_pass_gradcheck():
    model = random_map(seed=2)
    points = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: clearance(model, x), (points,))


def test_without_occupied_clusters_the_clearance_is_infinite():
    assert clearance(ball(weight=-1.0), torch.zeros(2, 3)).tolist() == [math.inf, math.inf]


def test_a_threshold_that_no_evidence_separates_from_unknown_is_refused():
    with pytest.raises(ValueError, match=r"between 0\.27 and 1; got 0\.2"):
        clearance(ball(), torch.zeros(1, 3), threshold=0.2)
