"""The map and its own rays: edges, few beams, units, strays."""

import pytest
import torch

from lardhm_torch import LardHilbertMap, Scans, sample_rays, simulate_room
from lardhm_torch.sampling import UNKNOWN, NoUsableRayError

F64 = torch.float64


def ring(beams):
    """A sonar ring in the middle of a square room of 10 m."""
    angle = torch.arange(beams, dtype=F64) * 2 * torch.pi / beams + 0.1
    ahead = torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1)
    return Scans(torch.zeros(1, 3), ahead * (5 / ahead.abs().amax(dim=1))[:, None])


@pytest.mark.parametrize("beams", [1, 2, 8, 24, 36, 72])
def test_a_few_beams_leave_the_space_they_crossed_free_and_their_hits_occupied(beams):
    samples = sample_rays(ring(beams))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    known = samples.labels != UNKNOWN
    answers = model(samples.points[known]) > 0.5
    assert (answers == (samples.labels[known] > 0.5)).double().mean() >= 0.95


@pytest.mark.parametrize(("factor", "limit"), [(0.01, "min_range"), (100.0, "max_range")])
def test_coordinates_in_other_units_are_an_error(factor, limit):
    room = simulate_room(300)
    scaled = Scans(room.origins * factor, room.ends * factor, room.scan_id, room.is_return)
    with pytest.raises(NoUsableRayError, match=f"must be in meters.*{limit}"):
        sample_rays(scaled)


def test_hits_beyond_the_largest_range_are_counted():
    scans = Scans(torch.zeros(1, 3), torch.tensor([[5.0, 0, 0], [6.0, 0, 0], [300.0, 0, 0]]))
    assert sample_rays(scans).dropped["hits beyond 100 m (no hit, free space kept)"] == 1


def test_a_stray_point_is_left_out_with_a_warning():
    samples = sample_rays(simulate_room(600))
    points = torch.cat([samples.points, torch.full((1, 3), 1e6, dtype=F64)])
    labels = torch.cat([samples.labels, torch.ones(1)])
    with pytest.warns(UserWarning, match=r"left out 1 of \d+ points"):
        with_stray = LardHilbertMap().fit(points, labels)
    without = LardHilbertMap().fit(samples.points, samples.labels)
    assert torch.equal(with_stray(samples.points), without(samples.points))


def test_a_fit_without_a_hit_warns():
    with pytest.warns(UserWarning, match="none of 50 points is occupied"):
        LardHilbertMap().fit(torch.rand(50, 3), torch.zeros(50))
