import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import F64, ball, radius_where, random_map
from tiled_maps import tiled

from lardhm_torch import LardHilbertMap, sample_rays, simulate_room, surface_distance
from lardhm_torch.queries.clearance import clearance
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN


def fitted_map(seed=0):
    """A real map, where k nearest of many clusters answer."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(3000, 3, generator=rng, dtype=torch.float64) * torch.tensor([4.0, 4.0, 2.0])
    labels = ((points[:, 0] - 2).abs() < 0.15).double()
    return LardHilbertMap().fit(points, labels, 120, seed=seed).requires_grad_(False)


def test_clearance_of_a_ball_is_the_distance_to_where_it_is_clearly_occupied():
    points = torch.tensor([[2.0, 0, 0], [0.0, -3.0, 0.0], [0.4, 0, 0]]).double()
    expected = points.norm(dim=1) - radius_where(LOG_ODDS_MARGIN)
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
    assert (model.log_odds(points[:, None] + around)[free] <= LOG_ODDS_MARGIN).all()


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


def test_points_of_the_wrong_dimension_have_no_clearance():
    with pytest.raises(ValueError, match=r"points must be \(\.\.\., 3\); got \(1, 2\)"):
        clearance(ball(), torch.zeros(1, 2))


def test_in_a_room_the_clearance_is_below_the_distance_and_not_far_below():
    samples = sample_rays(simulate_room(20_000))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    scans = simulate_room(2000, seed=4)
    share = torch.rand(len(scans), 1, generator=torch.Generator().manual_seed(0), dtype=F64)
    points = scans.ray_origins + share * (scans.ends - scans.ray_origins)
    rng = torch.Generator().manual_seed(1)
    pick = torch.randint(len(model), (100_000,), generator=rng)
    spread = torch.randn(len(pick), 3, 1, generator=rng)
    around = (model.centers[pick] + (model.scale_tril[pick] @ spread).squeeze(2)).double()
    around += model.origin
    obstacles = around[model.log_odds(around) > LOG_ODDS_MARGIN]
    assert len(obstacles) > 10_000
    true = torch.cat([torch.cdist(p, obstacles).amin(dim=1) for p in points.split(100)])
    found = clearance(model, points)
    assert (found <= true).all()
    assert float((found / true).median()) > 0.7
    assert float((found <= surface_distance(model, points)).double().mean()) > 0.99


def test_a_faded_obstacle_in_free_space_does_not_count():
    model = LardHilbertMap(num_neighbors=4)
    points = 0.2 * torch.randn(800, 3, generator=torch.Generator().manual_seed(0)).double()
    points[400:, 0] += 9
    model.fit(points, torch.ones(len(points)), 12).requires_grad_(False)
    origin = torch.zeros(1, 3).double()
    assert float(clearance(model, origin)) < 0
    model.weights[torch.linalg.vector_norm(model.centers + model.origin, dim=1) < 3] = 0.1
    assert float(clearance(model, origin)) > 5


def test_tiles_have_the_clearance_of_the_whole_map(tmp_path, monkeypatch):
    model = fitted_map().double()
    with torch.no_grad():  # tiles round centers, which can move a face across a threshold
        model.centers.copy_((4096 * model.centers).round() / 4096)
        model.origin.copy_((4096 * model.origin).round() / 4096)
    tiles = tiled(model, tmp_path, monkeypatch, edge=2.0)
    points = 4 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    whole, found = clearance(model, points), clearance(tiles, points)
    torch.testing.assert_close(found, whole, rtol=0, atol=1e-4)
