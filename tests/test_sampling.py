import pytest
import torch

from lardhm_torch.sampling import SamplingConfig, sample_rays
from lardhm_torch.scans import Scans, seeded_generator, split_rays


def random_scans(rays=200, seed=0, **columns):
    rng = torch.Generator().manual_seed(seed)
    origins = torch.randn(3, 3, generator=rng, dtype=torch.float64)
    scan_id = torch.randint(3, (rays,), generator=rng)
    offsets = torch.randn(rays, 3, generator=rng, dtype=torch.float64) * 4
    return Scans(origins, origins[scan_id] + offsets, scan_id, **columns)


def depth_of(samples, scans):
    """Distance along its ray of every sample, and how far from the ray it lies."""
    origins, ranges = scans.ray_origins[samples.ray_id], scans.ranges[samples.ray_id]
    along = (scans.ends[samples.ray_id] - origins) / ranges[:, None]
    offsets = samples.points - origins
    depth = (offsets * along).sum(dim=1)
    return depth, torch.linalg.vector_norm(offsets - depth[:, None] * along, dim=1), ranges


def test_free_samples_lie_on_the_ray_between_origin_and_margin():
    scans = random_scans()
    samples = sample_rays(scans)
    depth, aside, ranges = depth_of(samples, scans)
    free = samples.labels == 0
    assert (aside < 1e-12).all()
    assert (depth[free] >= 0).all()
    assert (depth[free] <= (ranges[free] - 0.15).clamp(min=0) + 1e-12).all()


def test_every_usable_hit_is_kept_exactly_and_labelled_occupied():
    scans = random_scans()
    samples = sample_rays(scans)
    occupied = samples.labels == 1
    assert torch.equal(samples.points[occupied], scans.ends[samples.ray_id[occupied]])
    assert occupied.sum() == (scans.ranges >= 0.3).sum()


def test_free_samples_are_stratified_over_the_ray():
    scans = Scans(torch.zeros(1, 3), torch.tensor([[10.15, 0.0, 0.0]]))
    samples = sample_rays(scans, SamplingConfig(free_samples=10, near_samples=0))
    depth = samples.points[samples.labels == 0, 0].sort().values
    assert torch.equal(depth.floor().long(), torch.arange(10))


def test_a_limit_draws_a_random_subset_of_the_points_of_each_label():
    scans = random_scans(rays=2000)
    whole, part = sample_rays(scans), sample_rays(scans, max_points=500)
    depth, aside, ranges = depth_of(part, scans)
    hits, free = part.labels == 1, part.labels == 0
    assert hits.sum() == free.sum() == 500
    assert 0 < (part.labels == 0.5).sum() <= 500
    assert (aside < 1e-12).all()
    assert (depth[free] <= (ranges[free] - 0.15).clamp(min=0) + 1e-12).all()
    assert torch.equal(part.points[hits], scans.ends[part.ray_id[hits]])
    assert len(part.ray_id[hits].unique()) == 500
    every = depth_of(whole, scans)[0][whole.labels == 0]
    assert abs(float(depth[free].mean() / every.mean()) - 1) < 0.05


def test_a_limit_above_the_number_of_points_changes_nothing():
    scans = random_scans()
    whole, same = sample_rays(scans), sample_rays(scans, max_points=10_000)
    assert torch.equal(whole.points, same.points)


def test_near_samples_lie_close_in_front_of_the_hit():
    scans = random_scans()
    near = sample_rays(scans, SamplingConfig(near_samples=3, behind_samples=0))
    plain = sample_rays(scans, SamplingConfig(near_samples=0, behind_samples=0))
    added = len(near) - len(plain)
    assert added == 3 * int(near.labels.sum())
    depth, _, ranges = depth_of(near, scans)
    back = (ranges - depth)[-added:]
    assert (back <= 0.6 + 1e-12).all()
    assert (back >= 0.15 - 1e-12).all()


def test_beams_without_return_give_free_space_up_to_their_end_only():
    scans = random_scans(is_return=torch.zeros(200, dtype=torch.bool))
    samples = sample_rays(scans)
    assert samples.labels.sum() == 0
    depth, _, ranges = depth_of(samples, scans)
    assert (depth <= ranges).all()
    assert (depth > ranges - 0.15).any()


def test_rays_beyond_max_range_are_cut_and_have_no_hit():
    scans = Scans(torch.zeros(1, 3), torch.tensor([[1e9, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    samples = sample_rays(scans, SamplingConfig(max_range=20.0))
    assert samples.labels.sum() == 1
    assert samples.points[:, 0].max() <= 20.0


def test_later_returns_of_a_pulse_are_hits_without_free_space():
    scans = Scans(
        torch.zeros(1, 3),
        torch.tensor([[5.0, 0, 0], [7.0, 0, 0]]),
        target_index=torch.tensor([1, 2]),
    )
    samples = sample_rays(scans)
    assert (samples.labels == 1).sum() == 2
    assert (samples.ray_id[samples.labels == 0] == 0).all()


def test_unusable_rays_are_dropped_and_counted():
    inf, nan = float("inf"), float("nan")
    ends = torch.tensor([[nan, 0, 0], [inf, 0, 0], [0, 0, 0], [0.1, 0, 0], [3, 0, 0.0]])
    samples = sample_rays(Scans(torch.zeros(1, 3), ends))
    assert samples.dropped["not finite"] == 2
    assert samples.dropped["shorter than 0.3 m"] == 2
    assert set(samples.ray_id.tolist()) == {4}


def test_the_same_seed_gives_the_same_samples():
    scans = random_scans()
    assert torch.equal(sample_rays(scans, seed=3).points, sample_rays(scans, seed=3).points)
    assert not torch.equal(sample_rays(scans, seed=3).points, sample_rays(scans, seed=4).points)


def test_samples_move_with_the_world():
    scans, shift = random_scans(), torch.tensor([5e5, 4.5e6, 100.0])
    moved = Scans(scans.origins + shift, scans.ends + shift, scans.scan_id)
    difference = sample_rays(moved).points - shift - sample_rays(scans).points
    assert difference.abs().max() < 1e-8


def test_no_usable_ray_is_an_error_that_counts_the_reasons():
    with pytest.raises(ValueError, match=r"at least one usable ray of 1.*not finite': 1"):
        sample_rays(Scans(torch.zeros(1, 3), torch.full((1, 3), float("nan"))))
    with pytest.raises(ValueError, match="at least one usable ray of 0"):
        sample_rays(Scans(torch.zeros(1, 3), torch.zeros(0, 3)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"min_range": -1}, "0 <= min_range < max_range < inf; got -1"),
        ({"max_range": float("inf")}, "got 0.3 and inf"),
        ({"free_samples": 0}, "free_samples must be 1 or more; got 0"),
        ({"near_samples": -1}, "near_samples must be 0 or more; got -1"),
        ({"near_margin": 0.7}, "near_margin < near_reach; got 0.7"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        SamplingConfig(**settings)


def test_two_dimensional_scans_are_sampled_too():
    samples = sample_rays(Scans(torch.zeros(1, 2), torch.tensor([[3.0, 4.0]])))
    assert samples.points.shape[1] == 2


def test_split_rays_gives_every_ray_to_one_side():
    scans = random_scans()
    train, test = split_rays(scans, 0.7, seed=1)
    assert len(train) == 140
    both = torch.cat([train.ends, test.ends])
    assert torch.equal(both.sort(dim=0).values, scans.ends.sort(dim=0).values)


def test_near_samples_of_a_short_ray_spread_over_its_free_part():
    ends = torch.tensor([[0.4, 0.0, 0.0]]).repeat(500, 1)
    config = SamplingConfig(free_samples=1, near_samples=8, behind_samples=0)
    samples = sample_rays(Scans(torch.zeros(1, 3), ends), config)
    near = samples.points[-4000:, 0]
    assert float(near.min()) > 0
    assert float(near.max()) <= 0.25 + 1e-12
    assert float((near < 0.125).double().mean()) == pytest.approx(0.5, abs=0.05)


def test_samples_can_be_had_in_another_dtype():
    samples = sample_rays(Scans(torch.zeros(1, 3), torch.rand(5, 3) + 1)).to(torch.float32)
    assert samples.points.dtype == samples.labels.dtype == torch.float32
    assert samples.ray_id.dtype == torch.int64


def test_seeds_give_independent_streams_for_every_purpose():
    one, again, other = (
        torch.rand(1000, generator=seeded_generator(3, purpose))
        for purpose in ("sampling", "sampling", "fit")
    )
    assert torch.equal(one, again)
    assert abs(float(torch.corrcoef(torch.stack([one, other]))[0, 1])) < 0.1
    with pytest.raises(ValueError, match=r"seed must be an integer; got 1\.5"):
        seeded_generator(1.5, "sampling")
