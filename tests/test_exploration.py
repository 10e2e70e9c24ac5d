import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball

from lardhm_torch.queries.exploration import frontiers, information_gain


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
