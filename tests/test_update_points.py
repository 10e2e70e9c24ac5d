"""The points and the training of an update: how many new points it uses, their weights, its steps."""

import pytest
import torch

from lardhm_torch import Scans, StreamConfig, UpdateConfig
from lardhm_torch.learning.retraining import _with_enough_steps, balanced
from lardhm_torch.learning.update import UPDATE_FIT, _thinned
from lardhm_torch.native.thinning import PER_CELL
from lardhm_torch.scans import seeded_generator
from lardhm_torch.streaming import _thinned as thinned_rays


def generator():
    return torch.Generator().manual_seed(0)


def dense_scan(**columns):
    """A scan with 500 rays to one cell of 0.1 m and 300 to others, every fifth without return."""
    ends = 10 * torch.rand(800, 3, generator=generator(), dtype=torch.float64) + 5
    ends[:500] = 0.02 * ends[:500] + torch.tensor([5.0, 5.0, 5.0])
    return Scans(torch.zeros(1, 3), ends, is_return=torch.arange(800) % 5 > 0, **columns)


def test_an_update_uses_few_points_of_each_class_in_a_cell():
    points = torch.rand(900, 3, generator=generator())
    labels = torch.tensor([1.0, 0.0, 0.5]).repeat(300)
    config = UpdateConfig(cell_edge=0.5)
    kept, of_kept = _thinned(points, labels, config, generator())
    for label in (0.0, 0.5, 1.0):
        assert int((of_kept == label).sum()) == 8 * PER_CELL
    fewer, of_fewer = _thinned(
        points, labels, UpdateConfig(cell_edge=0.5, max_points=9), generator()
    )
    assert [int((of_fewer == label).sum()) for label in (1.0, 0.0, 0.5)] == [9, 9, 9]
    assert {tuple(point) for point in fewer.tolist()} <= {tuple(point) for point in kept.tolist()}


def test_a_stream_uses_few_rays_that_end_in_one_cell():
    scan = dense_scan()
    config = StreamConfig(update=UpdateConfig(cell_edge=0.5))
    part = thinned_rays(scan, config, seeded_generator(0, "thinning"))
    assert len(part) < 310 < len(scan)
    crowded = (part.ends - 5.15).abs().amax(dim=1) < 0.2
    assert (
        int((crowded & part.is_return).sum()) == int((crowded & ~part.is_return).sum()) == PER_CELL
    )
    config = StreamConfig(update=UpdateConfig(cell_edge=0.5, max_points=20))
    part = thinned_rays(scan, config, seeded_generator(0, "thinning"))
    assert int(part.is_return.sum()) == int((~part.is_return).sum()) == 20


def test_rays_with_channels_are_all_used():
    scan = dense_scan(channels={"intensity": torch.ones(800)})
    assert len(thinned_rays(scan, StreamConfig(), seeded_generator(0, "thinning"))) == 800


def test_factors_of_groups_are_those_of_their_points():
    kinds, owners = torch.tensor([0, 1, 2, 1, 0]), torch.tensor([0, 0, 1, 2, 2, 2, 3, 3, 4])
    strength = torch.tensor([1.0, 2.0, 3.0, 1.5, 2.5], dtype=torch.float64)
    sizes = torch.bincount(owners)
    groups = balanced(kinds, strength, UPDATE_FIT, sizes)[owners]
    points = balanced(kinds[owners], strength[owners], UPDATE_FIT)
    torch.testing.assert_close(groups, points)
    assert abs(float(points.mean()) - 1) < 1e-12
    shares = [float(points[kinds[owners] == kind].sum()) for kind in range(3)]
    assert abs(shares[0] / (shares[0] + shares[1]) - UPDATE_FIT.occupied_share) < 1e-12
    assert abs(shares[2] / (shares[0] + shares[1]) - UPDATE_FIT.unknown_share) < 1e-12


@pytest.mark.parametrize("num_points", [1, 30, 5_000, 40_000, 200_000])
def test_few_points_give_as_many_steps_as_needed(num_points):
    config = _with_enough_steps(UPDATE_FIT, num_points)
    batches = -(-num_points // config.rows_per_batch(num_points))
    assert config.passes * batches >= 64
    assert config.passes == 2 or config.passes * batches < 64 + batches
    assert num_points < 100_000 or config.passes == 2
