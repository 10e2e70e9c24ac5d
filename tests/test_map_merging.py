import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import F64, same_map, wall, wall_map

from lardhm_torch import (
    LardHilbertMap,
    load_scans,
    merge_maps,
    sample_rays,
    simulate_room,
    split_rays,
)


def rotation(dim, seed):
    rng = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(dim, dim, generator=rng, dtype=F64)).Q
    turn[0] *= torch.linalg.det(turn).sign()
    return turn


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31 - 1),
    dim=st.sampled_from([2, 3, 4]),
    far=st.sampled_from([1.0, 100.0, 5e6]),
    dtype=st.sampled_from([torch.float32, F64]),
)
def test_a_moved_map_answers_at_moved_points_as_before(seed, dim, far, dtype):
    model = wall_map(dim, dtype)
    turn = rotation(dim, seed)
    shift = far * torch.randn(dim, generator=torch.Generator().manual_seed(seed), dtype=F64)
    points = wall(200, dim, seed=1)[0]
    before = model(points).detach()
    there = model.transform(turn, shift)(points @ turn.T + shift).detach()
    torch.testing.assert_close(there, before, atol=1e-5, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "dtype", "tolerance"),
    [
        ("sevenscenes_rgbd", torch.float32, 1e-5),
        # 84 m wide, kernels as thin as 2 cm: float32 coordinates have steps of 4e-6 m, and rounding
        # the points alone changes probabilities by up to 3e-5
        ("kitti00_mulls", torch.float32, 1e-4),
        ("kitti00_mulls", F64, 1e-9),
    ],
)
def test_a_moved_map_of_real_scans_answers_as_before(data, name, dtype, tolerance):
    scans = load_scans(data / name / "scans.npz")
    samples = sample_rays(scans.select(torch.arange(0, len(scans), 40)))
    model = LardHilbertMap().to(dtype).fit(samples.points, samples.labels)
    turn, shift = rotation(3, 0), torch.tensor([3.0, -7.0, 0.4], dtype=F64)
    points = samples.points[::10]
    before = model(points)
    there = model.transform(turn, shift)(points @ turn.T + shift)
    torch.testing.assert_close(there, before, atol=tolerance, rtol=0)


@torch.no_grad()
def test_moving_a_float32_map_adds_no_more_than_rounding_the_points_once_does(data):
    # The move itself is in float64, and the origin takes up the translation: what is left is the
    # rounding of points, centers and factors to float32, here on the widest scans.
    scans = load_scans(data / "kitti00_mulls" / "scans.npz")
    samples = sample_rays(scans.select(torch.arange(0, len(scans), 40)))
    model = LardHilbertMap().fit(samples.points, samples.labels)
    turn, shift = rotation(3, 1), torch.tensor([1003.0, 993.0, 1000.4], dtype=F64)
    points = samples.points[::10]
    there = points @ turn.T + shift
    before = model.log_odds(points)
    moved = model.transform(turn, shift)
    change = (moved.log_odds(there) - before).double()
    exact = copy.deepcopy(moved).double()
    rounded = (there - moved.origin).float().double() + moved.origin
    by_rounding = exact.log_odds(rounded) - exact.log_odds(there)
    assert 0 < change.square().mean() < 2**2 * by_rounding.square().mean()
    assert change.abs().max() < 2 * by_rounding.abs().max()


def test_moving_there_and_back_leaves_the_map_as_it_was():
    model, turn = wall_map(), rotation(3, 0)
    shift = torch.tensor([3.2, -7.7, 0.4], dtype=F64)
    before = copy.deepcopy(model)
    model.transform(turn, shift).transform(turn.T, -turn.T @ shift)
    for name, tensor in before.state_dict().items():
        if name != "_extra_state":
            torch.testing.assert_close(model.state_dict()[name], tensor)


def test_a_moved_map_has_the_moments_of_the_moved_points():
    points, labels = wall()
    model = LardHilbertMap().double().fit(points, labels, num_clusters=1)
    turn, shift = rotation(3, 1), torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    model.transform(turn, shift)
    moved = points[labels > 0.5] @ turn.T + shift
    torch.testing.assert_close(model.means[0] + model.origin, moved.mean(dim=0))
    torch.testing.assert_close(model.scatters[0], moved.T.cov() * (len(moved) - 1))


@pytest.mark.parametrize(
    ("turn", "shift", "message"),
    [
        (torch.eye(2), torch.zeros(3), r"\(3, 3\) and translation \(3,\); got \(2, 2\)"),
        (torch.eye(3), torch.zeros(2), r"got \(3, 3\) and \(2,\)"),
        (2 * torch.eye(3), torch.zeros(3), "orthonormal with determinant 1"),
        (torch.diag(torch.tensor([-1.0, 1, 1])), torch.zeros(3), "determinant is -1"),
        (torch.eye(3), torch.tensor([0, 0, torch.inf]), "translation must be finite"),
    ],
)
def test_only_rigid_transforms_move_a_map(turn, shift, message):
    model = wall_map()
    before = copy.deepcopy(model)
    with pytest.raises(ValueError, match=message):
        model.transform(turn, shift)
    assert same_map(model, before)


def test_what_lies_outside_the_radius_is_forgotten_and_the_rest_is_not():
    model = wall_map().update(*wall(at=30.0), num_clusters=40)
    near, far = wall(seed=1)[0], wall(seed=1, at=30.0)[0]
    before = model(near).detach()
    center = torch.tensor([1.0, 1.0, 1.0])
    model.crop(center, 10.0)
    distance = torch.linalg.vector_norm(model.centers + model.origin - center, dim=1)
    assert (distance <= 10).all()
    torch.testing.assert_close(model(near).detach(), before)
    assert torch.equal(model(far), torch.full((len(far),), 0.5, dtype=F64))
    assert len(model.crop(center + 1e4, 1.0)) == 0
    assert torch.equal(model(near), torch.full((len(near),), 0.5, dtype=F64))


def test_a_robot_that_forgets_runs_in_constant_memory():
    model, sizes = LardHilbertMap(), []
    for step in range(12):
        at = 2.0 * step
        model.update(*wall(200, at=at, seed=step), num_clusters=20, seed=step)
        sizes.append(len(model.crop(torch.tensor([at, 1.0, 1.0]), 5.0)))
    assert max(sizes[6:]) <= 1.5 * sizes[5]


def test_a_crop_needs_a_place_and_a_radius():
    model = wall_map()
    with pytest.raises(ValueError, match=r"center must be \(3,\) and finite"):
        model.crop(torch.zeros(2), 1.0)
    with pytest.raises(ValueError, match="radius must be > 0 m; got 0"):
        model.crop(torch.zeros(3), 0.0)


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 100), dtype=st.sampled_from([torch.float32, F64]))
def test_a_map_merged_with_itself_answers_as_before(seed, dtype):
    model = LardHilbertMap().to(dtype).fit(*wall(seed=seed), num_clusters=60, seed=seed)
    joined = merge_maps(model, model)
    points = torch.cat([wall(seed=seed + 1)[0], 4 * torch.rand(500, 3, dtype=F64) - 1])
    assert (joined(points) - model(points)).abs().max() < 1e-3
    assert len(joined) == len(model)
    assert torch.equal(joined.counts, 2 * model.counts)


def test_a_tuned_map_merged_with_itself_answers_as_before():
    model = wall_map()
    rng = torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.centers += 0.05 * torch.randn(model.centers.shape, generator=rng, dtype=F64)
        model.raw_scale_tril += 0.1 * torch.randn(model.raw_scale_tril.shape, generator=rng).tril()
    points = wall(seed=1)[0]
    assert (merge_maps(model, model)(points) - model(points)).abs().max() < 1e-3


def test_maps_of_different_places_are_put_side_by_side_in_either_order():
    first = LardHilbertMap().double().fit(*wall(), num_clusters=30)
    second = LardHilbertMap().double().fit(*wall(at=40.0), num_clusters=30)
    points = torch.cat([wall(seed=1)[0], wall(seed=1, at=40.0)[0]])
    one, other = merge_maps(first, second), merge_maps(second, first)
    assert len(one) == len(first) + len(second)
    torch.testing.assert_close(one(points), other(points))
    torch.testing.assert_close(one(points[:1200]), first(points[:1200]))
    torch.testing.assert_close(one(points[1200:]), second(points[1200:]))
    assert torch.equal(one.origin, first.origin)


@pytest.mark.parametrize("how", ["merge", "update"])
def test_places_that_float32_cannot_hold_are_refused_and_change_nothing(how):
    """Coordinates in meters and in UTM: rounded to float32, the other map would lose 0.25 m."""
    here, labels = wall(400, 3, seed=1)
    there = here + torch.tensor([5e5, 5.3e6, 0.0])
    first, second = (LardHilbertMap().fit(points, labels, 20) for points in (here, there))
    before = first(here)
    with pytest.raises(ValueError, match=r"near the origin.*at 5.3e\+06 m, which float32 cannot"):
        merge_maps(first, second) if how == "merge" else first.update(there, labels)
    assert torch.equal(first(here), before)
    model = merge_maps(first.double(), second.double())
    torch.testing.assert_close(model(there), second(there), atol=1e-3, rtol=0)
    torch.testing.assert_close(model(here), first(here), atol=1e-3, rtol=0)


def test_an_empty_map_adds_nothing():
    model, empty = wall_map(), LardHilbertMap().double()
    assert same_map(merge_maps(model, empty), model)
    assert same_map(merge_maps(empty, model), model)


def test_maps_of_other_settings_are_not_merged():
    with pytest.raises(ValueError, match=r"same settings; got .*'num_neighbors': 16.*: 5"):
        merge_maps(wall_map(), wall_map(num_neighbors=5))


@torch.no_grad()
def test_the_maps_of_two_robots_make_one_that_is_as_good_as_all_scans_at_once(data):
    from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

    scans = protocol_rays(load_scans(data / "sevenscenes_rgbd" / "scans.npz"), 40_000)
    train, test = split_rays(scans, 0.5)
    halves = [train.select(train.scan_id % 2 == number) for number in (0, 1)]

    def mapped(rays, **options):
        samples = sample_rays(rays)
        return LardHilbertMap().fit(samples.points, samples.labels, **options)

    joined = merge_maps(*(mapped(half) for half in halves))
    batch = mapped(train)
    for kind, loss in (("unif", 0.01), ("near", 0.02)):
        ours = evaluate(joined, test)[kind]["balanced_accuracy"]
        assert ours >= evaluate(batch, test)[kind]["balanced_accuracy"] - loss


def test_clusters_of_unknown_points_merge_without_nan():
    maps = []
    for seed in (1, 2):
        samples = sample_rays(simulate_room(1500, seed=seed), seed=seed)
        maps.append(LardHilbertMap().fit(samples.points, samples.labels))
    assert all(bool((model.counts == 0).any()) for model in maps)
    merged = merge_maps(*maps)
    for name, tensor in merged.state_dict().items():
        assert not isinstance(tensor, torch.Tensor) or not bool(tensor.isnan().any()), name
    twice = merge_maps(maps[0], maps[0])
    points = samples.points[::20]
    assert (twice(points) - maps[0](points)).abs().max() < 0.05
