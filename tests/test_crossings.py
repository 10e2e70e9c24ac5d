"""Where rays pass through surfaces that other rays hit."""

import pytest
import torch
from native_maps import dims
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans, native, raycast, sample_rays
from lardhm_torch.native.crossings import (
    PATCH_HITS,
    Lines,
    Passages,
    balanced_order,
    find_patches,
    passages,
    roughness,
)
from lardhm_torch.sampling import SamplingConfig

F64 = torch.float64


def wall_with_a_hole(spacing: float = 0.1, half: float = 0.2) -> tuple[Scans, Tensor]:
    """A sensor 4 m in front of a wall with a square hole, another wall at 8 m; rays through the hole."""
    rng = torch.Generator().manual_seed(1)
    line = torch.arange(-2, 2, spacing, dtype=F64)
    places = torch.cartesian_prod(line, line)
    places += spacing * (torch.rand(places.shape, generator=rng, dtype=F64) - 0.5)
    through = (places.abs() < half).all(dim=1)
    ends = torch.cat([torch.full_like(places[:, :1], 4.0), places], dim=1)
    ends *= torch.where(through, 2.0, 1.0)[:, None]
    noise = 0.01 * torch.randn(len(ends), 1, generator=rng, dtype=F64)
    return Scans(torch.zeros(1, 3), ends * (1 + noise / ends.norm(dim=1, keepdim=True))), through


def all_passages(scans: Scans, margin: float = 0.6) -> Passages:
    """Passages of rays of a single scan through all its hits."""
    offsets = scans.ends - scans.origins
    reach = offsets.norm(dim=1)
    lines = Lines(scans.origins, offsets / reach[:, None], reach)
    return passages(scans.ends, lines, reach - 0.15, margin)


def test_rays_through_a_hole_pass_the_plane_of_the_wall_and_others_do_not():
    scans, through = wall_with_a_hole()
    found = all_passages(scans)
    near = found.depths * (scans.ends / scans.ends.norm(dim=1, keepdim=True))[found.rays, 0]
    wall = found.is_flat
    assert wall.double().mean() > 0.5
    assert ((near[wall] - 4).abs() < 0.05).all()
    assert (found.widths[wall] < 0.1).all()
    assert through[found.rays].all()
    assert set(through.nonzero()[:, 0].tolist()) == set(found.rays[wall].tolist())


def rough_room(scale: float, noise: float = 0.01, scans: int = 2) -> Scans:
    """Floor and wall of a room of 10 m, 20,000 hits that scatter by so much, in another unit."""
    rng = torch.Generator().manual_seed(2)
    ends = 10 * torch.rand(20_000, 3, generator=rng, dtype=F64)
    ends[::2, 2], ends[1::2, 0] = 0, 10
    ends += noise * torch.randn(ends.shape, generator=rng, dtype=F64)
    starts = torch.tensor([[5.0, 5, 2], [4, 6, 2]], dtype=F64)[:scans]
    return Scans(scale * starts, scale * ends, torch.arange(len(ends)) % scans)


@pytest.mark.parametrize("scale", [1, 10, 0.1])
def test_hits_scatter_by_the_noise_of_the_sensor_in_any_unit(scale):
    found = roughness(find_patches(rough_room(scale).ends))
    assert 0.005 * scale < found < 0.01 * scale


@pytest.mark.parametrize("scale", [10, 0.1])
def test_units_are_named_where_hits_scatter_too_much_or_too_little(scale):
    with pytest.warns(UserWarning, match=r"scatter by .* must be in meters"):
        sample_rays(rough_room(scale))


def test_no_unit_is_named_in_meters_in_a_simulation_or_for_one_precise_scan():
    for scans in (rough_room(1), rough_room(1, noise=0), rough_room(0.1, scans=1)):
        sample_rays(scans)


def test_rays_that_end_on_a_noisy_floor_do_not_pass_through_it():
    rng = torch.Generator().manual_seed(0)
    ends = 20 * torch.rand(2000, 3, generator=rng, dtype=F64) - 10
    ends[:, 2] = 0.03 * torch.randn(2000, generator=rng, dtype=F64)
    start = torch.tensor([[0, 0, 1.5]], dtype=F64)
    assert len(all_passages(Scans(start, ends)).rays) == 0


def test_leaves_of_the_tree_divide_the_points_along_their_longest_axis():
    points = torch.tensor([[3.0, 0], [0, 1], [2, 0], [1, 1], [2, 1], [0, 0]], dtype=F64)
    assert balanced_order(points, 0).tolist() == [0, 1, 2, 3, 4, 5]
    assert balanced_order(points, 1).tolist() == [1, 3, 5, 0, 2, 4]


def mixed_scene(count: int, dim: int, one_start: bool) -> tuple[Tensor, Lines]:
    """Scattered hits, many with equal coordinates, seen from one place or from many."""
    rng = torch.Generator().manual_seed(count + dim)
    hits = torch.randn(count, dim, generator=rng, dtype=F64)
    hits[:, 0] = (3 * hits[:, 0]).round()
    starts = 0.1 * torch.randn(1 if one_start else count, dim, generator=rng, dtype=F64) - 4
    offsets = hits - starts
    offsets[::13, 1:] = 0
    reach = offsets.norm(dim=1)
    return hits, Lines(starts, offsets / reach[:, None], reach)


@dims
@pytest.mark.parametrize("one_start", [True, False])
@pytest.mark.parametrize("count", [PATCH_HITS, 1001])
def test_native_and_plain_find_the_same_passages(ops, monkeypatch, dim, one_start, count):
    hits, lines = mixed_scene(count, dim, one_start)
    given = (hits, lines, lines.reach - 0.15, 0.3)
    found, order = passages(*given), balanced_order(hits, 4)
    monkeypatch.setattr(native, "supports", lambda *tensors: False)
    assert torch.equal(order, balanced_order(hits, 4))
    plain = passages(*given)
    for ours, theirs in zip(found, plain, strict=True):
        torch.testing.assert_close(ours, theirs)
    assert count == PATCH_HITS or len(found.rays) > 100


def test_where_rays_pass_does_not_depend_on_where_the_world_origin_is():
    hits, lines = mixed_scene(500, 3, one_start=False)
    shift = torch.tensor([4e5, -5e6, 100.0], dtype=F64)
    here = passages(hits, lines, lines.reach, 0.6)
    there = passages(hits + shift, lines._replace(starts=lines.starts + shift), lines.reach, 0.6)
    assert torch.equal(here.rays, there.rays)
    torch.testing.assert_close(here.depths, there.depths, atol=1e-6, rtol=0)


def test_the_native_search_refuses_shapes_that_do_not_match(ops):
    hits, lines = mixed_scene(64, 3, one_start=True)
    boxes, eye = hits[:4], torch.eye(3, dtype=F64).expand(4, 3, 3)
    rest = (lines.reach, boxes, boxes, boxes, eye, boxes, boxes[:, 0], 2.5)
    assert len(ops.passing(*lines, *rest)[0]) == 0
    with pytest.raises(RuntimeError, match="must be a power of two"):
        ops.passing(*lines, lines.reach, *[hits[:3]] * 3, eye[:3], hits[:3], hits[:3, 0], 2.5)
    with pytest.raises(RuntimeError, match="must be float64"):
        ops.passing(lines.starts.float(), *lines[1:], *rest)


def test_samples_in_the_hole_are_added_and_no_other_sample_changes():
    scans, through = wall_with_a_hole()
    without = sample_rays(scans, SamplingConfig(passing_samples=0, behind_samples=0), seed=2)
    samples = sample_rays(scans, SamplingConfig(passing_samples=3, behind_samples=0), seed=2)
    assert torch.equal(samples.points[: len(without)], without.points)
    added, ray_id = samples.points[len(without) :], samples.ray_id[len(without) :]
    assert (samples.labels[len(without) :] == 0).all()
    assert through[ray_id].all()
    assert torch.bincount(ray_id, minlength=len(through))[through].min() >= 3
    on_ray = torch.linalg.cross(added, scans.ends[ray_id]) / scans.ends[ray_id].norm(dim=1)[:, None]
    assert on_ray.abs().max() < 1e-9
    assert (added.norm(dim=1) <= scans.ends[ray_id].norm(dim=1) - 0.15 + 1e-9).all()


def stopped(config: SamplingConfig) -> float:
    """Fraction of the rays through a hole that a map stops there."""
    scans, through = wall_with_a_hole()
    samples = sample_rays(scans, config)
    model = LardHilbertMap().fit(samples.points, samples.labels)
    ranges = raycast(model, torch.zeros(3), scans.ends[through], 12.0)
    return float((ranges < 6).double().mean())


def test_an_opening_that_a_few_rays_pass_stays_open():
    assert stopped(SamplingConfig()) <= 0.1
    assert stopped(SamplingConfig(passing_samples=0)) > 0.5


def test_a_negative_number_of_samples_is_an_error():
    with pytest.raises(ValueError, match="passing_samples must be 0 or more; got -1"):
        SamplingConfig(passing_samples=-1)
