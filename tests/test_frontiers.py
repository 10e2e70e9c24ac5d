import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball, random_map

from lardhm_torch.queries import frontiers as module
from lardhm_torch.queries.frontiers import frontiers
from lardhm_torch.queries.grids import query_grid


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


@pytest.mark.parametrize("dim", [2, 3])
def test_slabs_give_what_one_grid_gives(monkeypatch, dim):
    """The definition, on the whole grid, with the groups of `scipy.ndimage.label`."""
    from scipy.ndimage import binary_dilation, label

    model = random_map(dim, clusters=12, dim=dim).requires_grad_(False)
    lower, upper = [-2.0] * dim, [2.0] * dim
    log_odds = torch.logit(query_grid(model, lower, upper, 0.1).double()).numpy()
    occupied, free = log_odds > 1, log_odds < -1
    whole = np.ones((3,) * dim)
    occupied = binary_dilation(occupied, whole, iterations=2)
    border = free & binary_dilation(~occupied & ~free)
    groups = label(border, whole)[0][border]
    monkeypatch.setattr(module, "POINTS_AT_ONCE", 5 * 41 ** (dim - 1))
    found = frontiers(model, lower, upper, 0.1, wall_margin=0.2)
    places = torch.from_numpy(np.argwhere(border))
    torch.testing.assert_close(found.points, -2 + 0.1 * places.double())
    assert len(places) > 0
    sizes = np.bincount(found.groups)
    assert (np.diff(sizes) <= 0).all()
    assert len(np.unique(np.stack([groups, found.groups]), axis=1).T) == groups.max() == len(sizes)
