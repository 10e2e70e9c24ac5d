import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball, random_map

from lardhm_torch import LardHilbertMap, sample_rays, simulate_room
from lardhm_torch.queries import exploration
from lardhm_torch.queries.exploration import frontiers, information_gain
from lardhm_torch.simulation import true_ranges


def open_box(weight=-6.0):
    """Free in a ball around the origin, unknown beyond."""
    return ball(weight=weight, sigma=0.5)


def test_frontiers_are_the_shell_where_free_space_ends():
    found = frontiers(open_box(), [-2.0] * 3, [2.0] * 3, 0.1)
    radius = 0.5 * math.sqrt(2 * math.log(6))  # log-odds of -1
    distance = found.points.norm(dim=1)
    assert len(found.points) > 100
    assert (distance < radius).all()
    assert (distance > radius - 0.11).all()
    assert (found.groups == 0).all()


def test_the_way_into_a_wall_is_no_frontier():
    free = [[0.0, 0, 0]]
    wall = [[1.2, 0, 0]]
    factors = torch.stack([0.5 * torch.eye(3), torch.diag(torch.tensor([0.1, 1.0, 1.0]))])
    model = GaussianMap(free + wall, factors, [-6.0, 8.0])
    near_wall = frontiers(model, [0.5, -0.3, -0.3], [1.5, 0.3, 0.3], 0.1, wall_margin=0.4)
    assert len(near_wall.points) == 0
    assert len(frontiers(model, [0.5, -0.3, -0.3], [1.5, 0.3, 0.3], 0.1, 0.0).points) > 0


def test_groups_are_connected_and_the_largest_comes_first():
    factors = torch.stack([0.5 * torch.eye(2), 0.3 * torch.eye(2)])
    model = GaussianMap([[0.0, 0.0], [4.0, 0.0]], factors, [-6.0, -6.0])
    found = frontiers(model, [-2.0, -2.0], [6.0, 2.0], 0.1)
    assert found.groups.unique().tolist() == [0, 1]
    assert (found.points[found.groups == 0, 0] < 2).all()
    assert (found.points[found.groups == 1, 0] > 2).all()


def test_a_known_map_has_no_frontier_and_an_unknown_one_neither():
    assert len(frontiers(open_box(), [-0.2] * 3, [0.2] * 3, 0.1).points) == 0
    assert len(frontiers(open_box(), [9.0] * 3, [9.4] * 3, 0.1).points) == 0
    with pytest.raises(ValueError, match="wall_margin must be 0 m or more; got -1"):
        frontiers(open_box(), [0.0] * 3, [1.0] * 3, 0.1, -1)


def test_a_ray_through_the_unknown_gains_a_bit_a_cell_and_cells_count_once():
    nowhere = torch.tensor([50.0, 0.05, 0.05]).double()
    one = information_gain(open_box(), nowhere, torch.tensor([[1.0, 0, 0]]), 2.0, 0.1)
    assert one == pytest.approx(20.0)
    twice = information_gain(open_box(), nowhere, torch.tensor([[1.0, 0, 0]] * 2), 2.0, 0.1)
    assert twice == pytest.approx(20.0)
    assert information_gain(open_box(), nowhere, torch.zeros(0, 3), 2.0) == 0.0


def test_nothing_is_gained_behind_a_wall_or_where_all_is_known():
    wall = torch.diag(torch.tensor([0.2, 5.0, 5.0]))[None]
    model = GaussianMap([[1.0, 0, 0]], wall, [30.0])
    start, toward = torch.zeros(3).double(), torch.tensor([[1.0, 0, 0]])
    before = information_gain(model, start, toward, 1.0)
    assert before > 1
    assert information_gain(model, start, toward, 8.0) == pytest.approx(before, abs=1e-2)
    known = GaussianMap(torch.zeros(1, 3), 5 * torch.eye(3)[None], [-30.0])
    assert information_gain(known, start, toward, 2.0) < 1e-6


def all_around(count):
    """(count, 3) directions spread evenly."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    up, turn = 1 - 2 * number / count, math.pi * (1 + 5**0.5) * number
    flat = (1 - up.square()).sqrt()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), up], dim=1)


def test_the_gain_does_not_depend_on_the_resolution_nor_see_through_walls():
    scans = simulate_room(6000, seed=1)
    samples = sample_rays(scans)
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    place, way = torch.tensor([4.4, 0.8, 1.6]).double(), all_around(1000)
    closed = true_ranges(place.expand_as(way), way).isfinite()
    gains = [information_gain(model, place, way, 8.0, r) for r in (0.2, 0.1, 0.05, 0.02)]
    assert max(gains) < 1.05 * min(gains)
    assert information_gain(model, place, way[closed], 30.0) == pytest.approx(
        information_gain(model, place, way[closed], 8.0), rel=0.05
    )
    unknown = information_gain(LardHilbertMap(), place, way[closed], 30.0)
    assert information_gain(model, place, way[closed], 30.0) < 0.02 * unknown


def test_rays_closer_than_a_cell_share_it():
    """In unknown space, many rays gain the volume that they see, in cells of 0.1 m."""
    dense = information_gain(LardHilbertMap(), torch.zeros(3), all_around(20_000), 2.0)
    volume = 4 / 3 * math.pi * 2**3 / 0.1**3
    assert 0.5 * volume < dense < 1.1 * volume
    few = information_gain(LardHilbertMap(), torch.zeros(3), all_around(20), 2.0)
    assert few == pytest.approx(20 * 20, rel=0.1)


def test_bundles_of_rays_gain_about_what_the_rays_gain(monkeypatch):
    model = random_map(5)
    place, way = torch.tensor([0.3, -0.2, 0.1]).double(), all_around(4000)
    bundled = information_gain(model, place, way, 4.0)
    monkeypatch.setattr(exploration, "_direction_keys", lambda h, edge: torch.arange(len(h)))
    assert bundled == pytest.approx(information_gain(model, place, way, 4.0), rel=0.05)


def test_a_long_winding_frontier_is_one_group_and_found_at_once():
    class Serpentine(GaussianMap):
        """Free on a path that winds through a square of 8 m, unknown beside it."""

        def log_odds(self, points):
            column, row = (points / 0.1).round().long().unbind(dim=-1)
            turn = torch.where((row // 4) % 2 == 0, column == 79, column == 0)
            free = ((row % 4 == 0) | turn) & (row <= 76)
            return torch.where(free, -6.0, 0.0).double()

    model = Serpentine(torch.zeros(1, 2), torch.eye(2)[None], [1.0])
    found = frontiers(model, [0.0, 0.0], [7.9, 7.9], 0.1)
    assert len(found.points) > 1500
    assert (found.groups == 0).all()


def test_arrays_and_lists_are_taken_like_tensors():
    start, toward = np.array([-2.0, 0.0, 0.0]), [[1.0, 0.0, 0.0]]
    gain = information_gain(open_box(), start, toward, 3.0)
    assert gain == information_gain(open_box(), torch.tensor(start), torch.tensor(toward), 3.0)
    found = frontiers(open_box(), np.full(3, -1.5), torch.full((3,), 1.5), 0.25)
    assert torch.equal(found.points, frontiers(open_box(), [-1.5] * 3, [1.5] * 3, 0.25).points)


def test_bad_views_are_refused():
    with pytest.raises(ValueError, match="max_range must be > 0 m"):
        information_gain(open_box(), torch.zeros(3), torch.ones(1, 3), 0.0)
