import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import GaussianMap, ball, random_map

from lardhm_torch import LardHilbertMap, load_scans, sample_rays, simulate_room
from lardhm_torch.queries import marching
from lardhm_torch.queries.clearance import clearance
from lardhm_torch.queries.collision import (
    Mover,
    expected_range,
    free_probability,
    segment_hazard,
)
from lardhm_torch.queries.hazard import HAZARD_LENGTH, hazard


def dense_integral(model, start, end, length=HAZARD_LENGTH, count=400_000):
    """The hazard of one segment, summed over the middles of many short steps."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    points = start + share[:, None] * (end - start)
    return hazard(model, points, length=length).double().mean().detach() * (end - start).norm()


def test_through_the_middle_of_a_ball_the_integral_is_the_gaussian_one():
    starts, ends = (torch.tensor([[x, 0.0, 0.0]]).double() for x in (-9.0, 9.0))
    expected = 6 * 0.3 * math.sqrt(2 * math.pi) / 0.1
    assert float(segment_hazard(ball(), starts, ends)) == pytest.approx(expected)
    assert float(free_probability(ball(), starts, ends)) == pytest.approx(math.exp(-expected))


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), dim=st.integers(1, 3))
def test_probabilities_agree_with_dense_integration(seed, dim):
    model = random_map(seed=seed, dim=dim)
    rng = torch.Generator().manual_seed(seed)
    starts, ends = 2 * torch.randn(2, 3, dim, generator=rng, dtype=torch.float64)
    found = free_probability(model, starts, ends, Mover(step=0.02))
    for start, end, probability in zip(starts, ends, found, strict=True):
        expected = math.exp(-dense_integral(model, start, end, count=20_000))
        assert float(probability) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("name", ["tdtk_dat", "la3dm_sim_structured"])
def test_on_real_maps_of_k_nearest_clusters_they_agree_too(data, name):
    scans = load_scans(data / name / "scans.npz")
    scans = scans.select(torch.arange(0, len(scans), max(1, len(scans) // 20_000)))
    samples = sample_rays(scans)
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    rays = scans.select(torch.arange(5, len(scans), len(scans) // 4)[:4])
    found = free_probability(model, rays.ray_origins, rays.ends)
    for start, end, probability in zip(rays.ray_origins, rays.ends, found, strict=True):
        expected = torch.exp(-dense_integral(model, start, end))
        assert float(probability) == pytest.approx(float(expected), abs=1e-4)


def test_a_way_and_its_two_parts_expect_the_same():
    model = random_map(seed=3)
    starts, ends = 2 * torch.randn(2, 10, 3, dtype=torch.float64)
    middle = starts + 0.37 * (ends - starts)
    whole = segment_hazard(model, starts, ends, Mover(step=0.01))
    parts = [
        segment_hazard(model, a, b, Mover(step=0.01)) for a, b in ((starts, middle), (middle, ends))
    ]
    torch.testing.assert_close(whole, sum(parts), rtol=0, atol=1e-3)
    back = segment_hazard(model, ends, starts, Mover(step=0.01))
    torch.testing.assert_close(whole, back, rtol=0, atol=1e-5)


def test_gradients_pass_gradcheck_for_ways_and_for_the_map():
    model = random_map(seed=8)
    model.weights.data.abs_()
    model.weights.data[0] *= -1  # the first way starts in free space
    starts = (model.centers.data[:2] + 0.05).requires_grad_()
    ends = (model.centers.data[2:4] - 0.1).requires_grad_()
    assert (segment_hazard(model, starts, ends) > 0).all()

    def of_ways(a, b):
        return segment_hazard(model, a, b, Mover(radius=0.1, step=0.01))

    assert torch.autograd.gradcheck(of_ways, (starts, ends), atol=1e-4)
    model.requires_grad_()
    free_probability(model, starts, ends).sum().backward()
    assert model.weights.grad.isfinite().all()
    assert model.centers.grad.isfinite().all()


def test_a_wider_mover_meets_no_less():
    model = random_map(seed=4)
    starts, ends = 2 * torch.randn(2, 20, 3, dtype=torch.float64)
    thin, wide = (
        segment_hazard(model, starts, ends, Mover(radius=radius)) for radius in (0.0, 0.3)
    )
    assert (wide >= thin - 1e-9).all()
    assert (wide > thin).any()


def test_a_sphere_that_passes_beside_a_ball_meets_what_its_nearest_point_meets():
    starts, ends = (torch.tensor([[x, 1.0, 0.0]]).double() for x in (-4.0, 4.0))
    nearest = [point - torch.tensor([0.0, 0.4, 0.0]) for point in (starts, ends)]
    expected = segment_hazard(ball(), *nearest)
    torch.testing.assert_close(segment_hazard(ball(), starts, ends, Mover(radius=0.4)), expected)


def test_where_nothing_was_measured_or_nobody_moves_nothing_is_met():
    far = torch.full((2, 3), 50.0).double()
    assert free_probability(ball(), far, far + 1).tolist() == [1.0, 1.0]
    assert segment_hazard(ball(), torch.zeros(1, 3), torch.zeros(1, 3)).tolist() == [0.0]
    assert segment_hazard(ball(), torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)


def test_the_expected_range_is_the_integral_of_the_chance_to_get_so_far():
    model = GaussianMap([[0.0, 0, 0]], 0.3 * torch.eye(3)[None], [0.2])
    start, toward = torch.tensor([-2.0, 0, 0]).double(), torch.tensor([[1.0, 0, 0]]).double()
    depth = torch.linspace(0, 5, 100_001, dtype=torch.float64)
    rate = hazard(model, start + depth[:, None] * toward).detach()
    met = torch.cumulative_trapezoid(rate, depth)
    expected = torch.trapezoid(torch.cat([met.new_ones(1), torch.exp(-met)]), depth)
    found = expected_range(model, start, toward, 5.0, Mover(step=0.02))
    assert float(found) == pytest.approx(float(expected), abs=1e-3)
    away = expected_range(model, start, -toward, 5.0)
    assert float(away) == pytest.approx(5.0, abs=1e-6)


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 2**31 - 1), step=st.floats(0.01, 3.0), radius=st.sampled_from([0, 0.2]))
def test_hazards_are_never_negative_and_probabilities_never_above_one(seed, step, radius):
    model, mover = random_map(seed, clusters=3), Mover(radius=radius, step=step)
    starts, ends = 3 * torch.randn(2, 12, 3, generator=torch.Generator().manual_seed(seed)).double()
    assert (segment_hazard(model, starts, ends, mover) >= 0).all()
    probability = free_probability(model, starts, ends, mover)
    assert ((probability >= 0) & (probability <= 1)).all()
    ranges = expected_range(model, starts, ends - starts, 2.0, mover)
    assert ((ranges >= 0) & (ranges <= 2 + 1e-12)).all()


def test_a_sphere_s_expected_range_follows_from_the_hazard_of_its_segments():
    model, mover = ball(weight=2.0, sigma=0.5), Mover(radius=0.5, step=0.02, length=1.0)
    start, toward = (
        torch.tensor([-3.0, 0.0, 0.0]).double(),
        torch.tensor([[1.0, 0.0, 0.0]]).double(),
    )
    depth = torch.linspace(0, 6, 201, dtype=torch.float64)[:, None]
    ends = start + depth * toward / toward.norm()
    hazards = segment_hazard(model, start.expand_as(ends), ends, mover)
    assert float(hazards[-1]) > 0.5
    expected = torch.trapezoid(torch.exp(-hazards), depth[:, 0])
    found = expected_range(model, start, toward, 6.0, mover)
    assert float(found) == pytest.approx(float(expected), abs=2e-3)


@pytest.mark.parametrize("follows", [False, True])
def test_native_rays_pass_over_no_hazard(monkeypatch, follows):
    """In one native pass, or with gradients, from step to step."""
    samples = sample_rays(simulate_room(3000))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    starts = torch.tensor([4.4, 2.8, 1.1]).double()
    toward = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double()
    toward.requires_grad_(follows)
    found = expected_range(model, starts, toward, 6.0).detach()
    monkeypatch.setattr(marching, "native_ranges", lambda *_: None)
    monkeypatch.setattr(marching, "native_map", lambda *_: None)
    expected = expected_range(model, starts, toward, 6.0).detach()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-2)
    assert float((found - expected).abs().median()) < 1e-4


@pytest.mark.parametrize("dim", [2, 3])
def test_native_expected_ranges_are_those_of_the_loop(monkeypatch, dim):
    """Also for cells as large as the map, thin clusters, and ranges that are no multiple of the step."""
    rng = torch.Generator().manual_seed(dim)
    points = torch.randn(3000, dim, generator=rng).double()
    model = LardHilbertMap(dim, num_neighbors=5).double()
    model.fit(points, (points[:, 0].sin() > 0).double(), 40).requires_grad_(False)
    starts, toward = 2 * torch.randn(2, 300, dim, generator=rng).double()
    rule = Mover(step=0.03, length=1.0)
    found = expected_range(model, starts, toward, 4.01, rule)
    monkeypatch.setattr(marching, "native_ranges", lambda *_: None)
    monkeypatch.setattr(marching, "native_map", lambda *_: None)
    torch.testing.assert_close(
        found, expected_range(model, starts, toward, 4.01, rule), rtol=0, atol=5e-3
    )
    assert float((found < 4).double().mean()) > 0.2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"starts": torch.zeros(3)}, r"must be \(S, 3\) both; got \(3,\)"),
        ({"ends": torch.zeros(2, 2)}, r"must be \(S, 3\) both"),
    ],
)
def test_bad_segments_are_refused(changed, message):
    arguments = {"starts": torch.zeros(2, 3), "ends": torch.ones(2, 3)}
    with pytest.raises(ValueError, match=message):
        segment_hazard(ball(), **{**arguments, **changed})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": -0.1}, "radius must be 0 m or more and finite; got -0.1"),
        ({"radius": math.inf}, "radius must be 0 m or more and finite; got inf"),
        ({"length": 0.0}, "length must be > 0 m; got 0.0"),
        ({"step": 0.0}, "step must be > 0 m; got 0.0"),
    ],
)
def test_an_impossible_mover_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Mover(**settings)


@pytest.mark.parametrize("convert", [np.asarray, lambda a: a.tolist()])
def test_arrays_and_lists_are_taken_like_tensors(convert):
    model = random_map(seed=1).requires_grad_(False)
    starts, ends = 2 * torch.randn(2, 6, 3, dtype=torch.float64)
    for function, tensors in (
        (segment_hazard, (starts, ends)),
        (free_probability, (starts, ends)),
        (clearance, (starts,)),
        (hazard, (starts,)),
        (lambda m, o, d: expected_range(m, o, d, 3.0), (starts[0], ends)),
    ):
        given = function(model, *(convert(tensor.numpy()) for tensor in tensors))
        assert torch.equal(given, function(model, *tensors))


def test_arrays_that_are_views_or_read_only_are_taken():
    points = np.linspace(0, 1, 12).reshape(4, 3)[::-1]
    points.flags.writeable = False
    assert clearance(ball(), points).shape == (4,)
    with pytest.raises(ValueError, match=r"starts must be a tensor, an array.*got 'here'"):
        segment_hazard(ball(), "here", points)
