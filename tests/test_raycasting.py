import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball, radius_where, random_map

from lardhm_torch import LardHilbertMap, load_scans, sample_rays, split_rays
from lardhm_torch.evaluation.held_out import protocol_rays
from lardhm_torch.queries import raycasting
from lardhm_torch.queries.clearance import clearance
from lardhm_torch.queries.collision import expected_range, free_probability
from lardhm_torch.queries.distance import signed_distance
from lardhm_torch.queries.exploration import information_gain
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN
from lardhm_torch.queries.raycasting import raycast, surface_step


@pytest.mark.parametrize("threshold", [0.5, 0.7, 0.9])
@pytest.mark.parametrize("shift", [0.0, 4.5e6])
def test_a_ray_toward_a_ball_stops_where_the_closed_form_says(threshold, shift):
    origin = torch.full((3,), shift, dtype=torch.float64)
    model = GaussianMap(
        [[0.0, 0, 0], [-2.0, 0, 0]],
        torch.stack([0.3 * torch.eye(3), 0.3 * torch.eye(3)]),
        [6.0, -6.0],
        origin,
    )
    start = origin + torch.tensor([-2.0, 0, 0])
    directions = torch.tensor([[7.0, 0, 0], [0, 1, 0], [-1, 0, 0]])
    ranges = raycast(model, start, directions, 5.0, threshold, surface="crossing")
    level = math.log(threshold / (1 - threshold))
    # halfway between the two equal balls log-odds are 0; else the near one adds only its tail
    expected = 1.0 if threshold == 0.5 else 2 - radius_where(level)
    assert float(ranges[0]) == pytest.approx(expected, abs=1e-4)
    assert ranges[1:].tolist() == [math.inf, math.inf]


def test_the_probability_at_the_end_of_a_ray_is_the_threshold_and_lower_before():
    rng = torch.Generator().manual_seed(0)
    model = random_map(seed=7, clusters=20)
    model.weights.data[:3] = -8.0
    starts = model.centers.detach()[:3].repeat_interleave(40, dim=0)
    directions = torch.randn(120, 3, generator=rng, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    ranges = raycast(model, starts, directions, 6.0, threshold=0.6, step=0.02, surface="crossing")
    met = ranges.isfinite() & (ranges > 0)
    assert met.sum() > 20
    ends = starts[met] + ranges[met, None] * directions[met]
    outside = model(starts[met]) < 0.6
    torch.testing.assert_close(
        model(ends)[outside].detach(),
        torch.full((int(outside.sum()),), 0.6).double(),
        rtol=0,
        atol=1e-4,
    )
    shares = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None, None]
    before = model.log_odds(starts[met] + shares * (ends - starts[met]))
    assert (before <= math.log(0.6 / 0.4) + LOG_ODDS_MARGIN).all()


def test_ranges_do_not_depend_on_how_rays_are_batched(monkeypatch):
    model = ball()
    starts = torch.tensor([-2.0, 0.1, 0.0]).double()
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(1)).double()
    for surface in raycasting.SURFACES:
        together = raycast(model, starts, directions, 5.0, surface=surface)
        assert together.isfinite().any()
        with monkeypatch.context() as smaller:
            smaller.setattr(raycasting, "BLOCK_POINTS", 100)
            apart = raycast(model, starts, directions, 5.0, surface=surface)
        torch.testing.assert_close(apart, together)


def naive_range(model, start, direction, max_range, level, step, surface):
    """One ray, step by step, as the docstring of `raycast` says, without any refinement."""
    below = best = found = None
    for number in range(math.ceil(max_range / step - 1e-9) + 1):
        depth = min(number * step, max_range)
        value = float(model.log_odds(start + depth * direction))
        if found is None and value <= level:
            below = depth
        if found is None and value > level + LOG_ODDS_MARGIN:
            found, best = depth, -math.inf
        if found is not None:
            if value < best - LOG_ODDS_MARGIN:
                break
            if value > best:
                peak, best = depth, value
    if found is None:
        return math.inf
    return peak if surface == "peak" else below


@pytest.mark.parametrize("surface", raycasting.SURFACES)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_ranges_are_within_a_step_of_a_loop_over_steps(dim, surface):
    rng = torch.Generator().manual_seed(dim)
    model = random_map(seed=dim, dim=dim, clusters=12 * dim)
    starts = 3 * torch.randn(100, dim, generator=rng, dtype=torch.float64)
    directions = torch.randn(100, dim, generator=rng, dtype=torch.float64) - starts
    directions[0, 1:] = 0  # along an axis
    directions /= directions.norm(dim=1, keepdim=True)
    level, step = math.log(0.6 / 0.4), 0.05
    ranges = raycast(model, starts, directions, 9.0, 0.6, step, surface=surface).tolist()
    naive = [
        naive_range(model, start, direction, 9.0, level, step, surface)
        for start, direction in zip(starts, directions, strict=True)
    ]
    assert [math.isinf(r) for r in ranges] == [n == math.inf for n in naive]
    known = [(r, n) for r, n in zip(ranges, naive, strict=True) if n not in (None, math.inf)]
    assert len(known) > 5
    if surface == "peak":
        assert all(abs(r - n) <= 1.25 * step for r, n in known)
    else:  # between the last step below and the next one, unless it began above
        assert all(n <= r <= n + 2 * step for r, n in known)


def test_arrays_and_lists_are_taken_like_tensors():
    start, toward = [-2.0, 0.0, 0.0], np.array([[1.0, 0, 0], [1.0, 0.1, 0]])
    expected = raycast(ball(), torch.tensor(start), torch.tensor(toward), 5.0)
    assert torch.equal(raycast(ball(), start, toward, 5.0), expected)
    assert torch.equal(raycast(ball(), np.array(start), toward.tolist(), 5.0), expected)
    with pytest.raises(ValueError, match="directions must be a tensor, an array or equally long"):
        raycast(ball(), start, [[1.0, 0.0, 0.0], [1.0]], 5.0)


@pytest.mark.parametrize("offset", [0.0, 0.13, -0.2])
def test_by_default_a_ray_ends_on_the_ridge_of_the_log_odds(offset):
    factor = torch.diag(torch.tensor([0.1, 2.0, 2.0]).double())[None]  # a wall across x
    model = GaussianMap([[offset, 0.0, 0.0]], factor, [6.0])
    slanted = torch.tensor([[1.0, 0, 0], [1.0, 0.4, 0]]).double()
    ranges = raycast(model, torch.tensor([-2.0, 0, 0]), slanted, 5.0)
    # the largest exp(-(x/0.1)^2/2 - (y/2)^2/2) on the way: its middle, in closed form
    toward = slanted / slanted.norm(dim=1, keepdim=True)
    spread = torch.tensor([0.1, 2.0, 2.0]).double()
    away = torch.tensor([2.0 + offset, 0, 0]).double()
    expected = (toward * away / spread**2).sum(1) / (toward / spread).square().sum(1)
    torch.testing.assert_close(ranges, expected, rtol=0, atol=2e-3)


def test_the_ridge_of_the_first_of_two_walls_is_met():
    factors = (torch.diag(torch.tensor([0.1, 2.0, 2.0]).double())).expand(2, 3, 3)
    model = GaussianMap([[0.0, 0, 0], [1.0, 0, 0]], factors, [4.0, 8.0])
    ranges = raycast(model, torch.tensor([-2.0, 0, 0]), torch.tensor([[1.0, 0, 0]]), 5.0)
    assert float(ranges) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(("name", "most"), [("tdtk_dat", 0.05), ("balm_realworld", 0.10)])
def test_ranges_of_held_out_rays_are_met(data, name, most):
    scans = protocol_rays(load_scans(data / name / "scans.npz"), 60_000)
    train, test = split_rays(scans, 0.5)
    samples = sample_rays(train)
    model = LardHilbertMap().fit(samples.points, samples.labels)
    test = test.select(torch.arange(0, len(test), 10))
    ranges = raycast(model, test.ray_origins, test.ends - test.ray_origins, 70.0)
    assert float((ranges - test.ranges).abs().median()) < most
    assert float(ranges.isfinite().double().mean()) > 0.98


def test_a_ray_that_starts_inside_has_range_zero_and_one_that_cannot_reach_has_none():
    starts = torch.tensor([[0.0, 0, 0], [-2.0, 0, 0]]).double()
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0]])
    assert raycast(ball(), starts, directions, 1.0).tolist() == [0.0, math.inf]


def test_a_ripple_where_nothing_was_measured_stops_no_ray():
    faint = ball(weight=0.1)
    assert raycast(faint, torch.tensor([-2.0, 0, 0]), torch.tensor([[1.0, 0, 0]]), 5.0) == math.inf


def test_from_unknown_space_a_ray_ends_where_the_obstacle_becomes_clear():
    ranges = raycast(
        ball(), torch.tensor([-1.0, 0, 0]), torch.tensor([[1.0, 0, 0]]), 5.0, surface="crossing"
    )
    assert float(ranges) == pytest.approx(1 - radius_where(LOG_ODDS_MARGIN), abs=1e-5)


def test_no_rays_give_no_ranges():
    assert raycast(ball(), torch.zeros(3), torch.zeros(0, 3), 5.0).shape == (0,)


def test_the_step_is_the_thickness_of_the_occupied_clusters():
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[
        0
    ]
    covariance = turn @ torch.diag(torch.tensor([0.04, 1.0, 2.0]).double() ** 2) @ turn.T
    factors = torch.stack([torch.linalg.cholesky(covariance), 0.001 * torch.eye(3).double()])
    assert surface_step(GaussianMap(torch.zeros(2, 3), factors, [1.0, -1.0])) == pytest.approx(
        0.04, rel=0.022
    )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"directions": torch.ones(2, 2)}, r"directions must be \(R, 3\); got \(2, 2\)"),
        ({"origins": torch.zeros(3, 3)}, r"origins must be \(2, 3\).*got \(3, 3\)"),
        ({"directions": torch.zeros(2, 3)}, "finite and not zero"),
        ({"directions": torch.full((2, 3), math.nan)}, "finite and not zero"),
        ({"max_range": 0.0}, "max_range must be > 0 m"),
        ({"max_range": math.inf}, "max_range must be > 0 m and finite; got inf"),
        ({"threshold": 1.0}, "threshold must be between 0 and 1, both excluded; got 1.0"),
        ({"step": 0.0}, "step must be > 0 m; got 0.0"),
        ({"surface": "back"}, "surface must be one of peak, crossing; got 'back'"),
    ],
)
def test_bad_rays_are_refused(changed, message):
    arguments = {"origins": torch.zeros(3), "directions": torch.ones(2, 3), "max_range": 5.0}
    with pytest.raises(ValueError, match=message):
        raycast(ball(), **{**arguments, **changed})


@pytest.mark.parametrize("model", [LardHilbertMap(), ball(weight=-1.0)])
def test_where_there_is_no_obstacle_rays_end_nowhere(model):
    start, toward = torch.zeros(3), torch.ones(1, 3)
    for surface in ("peak", "crossing"):
        assert raycast(model, start, toward, 5.0, surface=surface) == math.inf
    assert expected_range(model, start, toward, 5.0).tolist() == [pytest.approx(5.0)]
    assert free_probability(model, torch.zeros(1, 3), toward).tolist() == [1.0]
    assert clearance(model, start) == math.inf
    assert signed_distance(model, start, 2.0) == 2.0
    assert information_gain(model, start, toward, 5.0) > 0


def test_an_obstacle_wider_than_the_step_is_met_wherever_it_lies():
    distances = torch.linspace(1.0, 40.0, 400, dtype=torch.float64)
    starts = torch.zeros(400, 3, dtype=torch.float64)
    starts[:, 0] = -distances
    toward = torch.tensor([[1.0, 0, 0]]).expand(400, 3)
    ranges = raycast(ball(), starts, toward, 50.0, threshold=0.6, step=1.0, surface="crossing")
    expected = distances - radius_where(math.log(0.6 / 0.4))
    torch.testing.assert_close(ranges, expected.clamp(min=0), rtol=0, atol=1e-3)
