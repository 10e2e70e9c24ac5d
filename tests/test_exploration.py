import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball, random_map

from lardhm_torch import LardHilbertMap, sample_rays, simulate_room
from lardhm_torch.queries import exploration
from lardhm_torch.queries.exploration import information_gain
from lardhm_torch.queries.frontiers import frontiers
from lardhm_torch.simulation import true_ranges


def open_box(weight=-6.0):
    """Free in a ball around the origin, unknown beyond."""
    return ball(weight=weight, sigma=0.5)


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


def test_arrays_and_lists_are_taken_like_tensors():
    start, toward = np.array([-2.0, 0.0, 0.0]), [[1.0, 0.0, 0.0]]
    gain = information_gain(open_box(), start, toward, 3.0)
    assert gain == information_gain(open_box(), torch.tensor(start), torch.tensor(toward), 3.0)
    found = frontiers(open_box(), np.full(3, -1.5), torch.full((3,), 1.5), 0.25)
    assert torch.equal(found.points, frontiers(open_box(), [-1.5] * 3, [1.5] * 3, 0.25).points)


def test_bad_views_are_refused():
    with pytest.raises(ValueError, match="max_range must be > 0 m"):
        information_gain(open_box(), torch.zeros(3), torch.ones(1, 3), 0.0)
