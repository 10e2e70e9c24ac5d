"""Clusters that stop the rays of a map early get other shapes."""

import pytest
import torch

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    Scans,
    native,
    raycast,
    sample_rays,
    simulate_room,
)
from lardhm_torch.features import Kernel
from lardhm_torch.learning import clearing
from lardhm_torch.learning.fitting import FitTask
from lardhm_torch.learning.parameters import read_state

F64 = torch.float64


@pytest.fixture(scope="module")
def room():
    return simulate_room(12_000)


@pytest.fixture(scope="module")
def samples(room):
    return sample_rays(room)


@pytest.fixture(scope="module")
def plain(samples):
    return LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)


@pytest.fixture(scope="module")
def clear(samples, room):
    return LardHilbertMap().fit(samples.points, samples.labels, rays=room).requires_grad_(False)


def early(model, scans):
    found = raycast(model, scans.ray_origins, scans.ends - scans.ray_origins, 12.0)
    return float((found < scans.ranges - 0.5).double().mean())


def test_fewer_rays_end_early_at_the_frames_of_door_and_window(plain, clear):
    others = simulate_room(12_000, seed=1)
    leaving = others.select((~others.is_return).nonzero().squeeze(1))
    before, after = early(plain, leaving), early(clear, leaving)
    assert before > 0.1
    assert after < 0.75 * before


def test_only_the_shapes_of_clusters_that_stop_rays_change(plain, clear):
    same = (plain.centers == clear.centers).all(dim=1)
    assert 0 < int(same.sum()) < len(plain)
    assert bool(same[~plain.is_occupied].all())
    assert torch.equal(plain.means, clear.means)
    assert torch.equal(plain.evidence, clear.evidence)


def test_without_rays_that_end_early_nothing_changes():
    room = simulate_room(600)
    samples = sample_rays(room)
    before = LardHilbertMap().fit(samples.points, samples.labels)
    none = room.select(torch.arange(0))
    after = LardHilbertMap().fit(samples.points, samples.labels, rays=none)
    assert torch.equal(before(samples.points), after(samples.points))


def test_ends_are_those_of_plain_torch(plain, room, monkeypatch):
    task = FitTask(plain.kernel, FitConfig(), torch.Generator().manual_seed(0))
    few = room.select(torch.arange(0, len(room), 400))
    rays = clearing.ray_lines(few, plain.origin, task)
    rays = rays._replace(starts=rays.starts.expand_as(rays.ahead))
    given = (rays, plain.kernel, native.build_index(plain.centers, plain.kernel.num_neighbors))
    native_depths = clearing.end_depths(read_state(plain), *given)
    monkeypatch.setattr(clearing.native, "supports", lambda *_: False)
    plain_depths = clearing.end_depths(read_state(plain), *given)
    assert bool(plain_depths.isfinite().any())
    assert (native_depths - plain_depths).abs().nan_to_num(0).max() < 1e-6


@pytest.mark.parametrize(
    ("scans", "config", "match"),
    [
        (simulate_room(60), FitConfig(shape_passes=4), "shape_passes"),
        (Scans(torch.zeros(1, 2), torch.ones(5, 2)), FitConfig(), "3 dimensions"),
    ],
)
def test_rays_are_checked(scans, config, match):
    samples = sample_rays(simulate_room(60))
    with pytest.raises(ValueError, match=match):
        LardHilbertMap().fit(samples.points, samples.labels, rays=scans, config=config)


def test_later_returns_and_rays_that_are_not_sampled_are_left_out():
    ends = torch.tensor([[5.0, 0, 0], [6.0, 0, 0], [0.01, 0, 0], [300.0, 0, 0]])
    scans = Scans(torch.zeros(1, 3), ends, target_index=torch.tensor([1, 2, 1, 1]))
    task = FitTask(Kernel(16, 4.0, 0.01), FitConfig(), torch.Generator())
    lines = clearing.ray_lines(scans, torch.zeros(3, dtype=F64), task)
    assert lines.reach.tolist() == [5.0, 100.0]
