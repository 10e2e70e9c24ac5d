import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from lardhm_torch import querying
from lardhm_torch.querying import (
    EVIDENCE,
    grid,
    map_bounds,
    occupancy_gradient,
    query_grid,
    query_slice,
    raycast,
    surface_step,
)


class GaussianMap(nn.Module):
    """A map in a few lines: every cluster answers for every point."""

    def __init__(self, centers, scale_tril, weights, origin=None):
        super().__init__()
        self.centers = nn.Parameter(torch.as_tensor(centers, dtype=torch.float64))
        self.scale_tril = torch.as_tensor(scale_tril, dtype=torch.float64)
        self.weights = nn.Parameter(torch.as_tensor(weights, dtype=torch.float64))
        self.dim = self.centers.shape[1]
        self.origin = torch.zeros(self.dim).double() if origin is None else origin

    def log_odds(self, points):
        offsets = (points - self.origin)[..., None, :] - self.centers
        whitened = torch.linalg.solve_triangular(self.scale_tril, offsets[..., None], upper=False)
        return torch.exp(-0.5 * whitened.square().sum(dim=(-2, -1))) @ self.weights

    def forward(self, points):
        return torch.sigmoid(self.log_odds(points))


def ball(weight=6.0, sigma=0.3, dim=3, origin=None):
    return GaussianMap(torch.zeros(1, dim), sigma * torch.eye(dim)[None], [weight], origin)


def radius_where(log_odds, weight=6.0, sigma=0.3):
    """Distance from the center of `ball` at which it has these log-odds, in closed form."""
    return sigma * math.sqrt(2 * math.log(weight / log_odds))


def random_map(seed, dim=3, clusters=6):
    rng = torch.Generator().manual_seed(seed)
    factors = 0.2 * torch.randn(clusters, dim, dim, generator=rng).tril(-1)
    factors += torch.diag_embed(0.2 + torch.rand(clusters, dim, generator=rng))
    weights = 4 * torch.randn(clusters, generator=rng)
    return GaussianMap(2 * torch.randn(clusters, dim, generator=rng), factors, weights)


def test_a_grid_starts_at_its_lower_corner_and_reaches_the_upper_one():
    points = grid([1.0, 2.0, 3.0], [1.3, 2.2, 3.0], 0.1)
    assert points.shape == (4, 3, 1, 3)
    assert points.dtype == torch.float64
    torch.testing.assert_close(points[0, 0, 0], torch.tensor([1.0, 2.0, 3.0]).double())
    torch.testing.assert_close(points[-1, -1, -1], torch.tensor([1.3, 2.2, 3.0]).double())


@settings(deadline=None, max_examples=40)
@given(
    lower=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4),
    edges=st.lists(st.floats(0, 2), min_size=4, max_size=4),
    resolution=st.floats(0.25, 1),
)
def test_neighbors_in_a_grid_are_one_resolution_apart_and_none_lies_outside(
    lower, edges, resolution
):
    upper = [a + b for a, b in zip(lower, edges, strict=False)]
    points = grid(lower, upper, resolution)
    for axis in range(len(lower)):
        steps = points.diff(dim=axis)[..., axis]
        torch.testing.assert_close(steps, torch.full_like(steps, resolution), rtol=0, atol=1e-8)
        along = points[..., axis]
        assert along.min() == lower[axis]
        assert upper[axis] - resolution < along.max() + 1e-5
        assert along.max() <= upper[axis] + 1e-5


def test_the_query_grid_of_the_paper_has_its_number_of_points():
    axes = querying.grid_axes([0, 0, 0], [6.3, 5.3, 2.3], 0.05)
    assert [len(axis) for axis in axes] == [127, 107, 47]


@pytest.mark.parametrize("block", [7, 1 << 20])
@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_a_queried_grid_equals_the_queries_of_its_points(dim, block, monkeypatch):
    monkeypatch.setattr(querying, "BLOCK_POINTS", block)
    model = random_map(seed=dim, dim=dim)
    probability = query_grid(model, [-1.0] * dim, [0.7] * dim, 0.5)
    assert probability.shape == (4,) * dim
    torch.testing.assert_close(probability, model(grid([-1.0] * dim, [0.7] * dim, 0.5)).detach())
    assert not probability.requires_grad


def test_a_slice_equals_the_queries_of_its_points():
    model = random_map(seed=1)
    cut = query_slice(model, height=0.3, resolution=0.25, bounds=([-1, -2], [1, 2]))
    assert cut.probability.shape == (9, 17)
    assert cut.extent == (-1, 1, -2, 2)
    point = torch.tensor([-1 + 3 * 0.25, -2 + 5 * 0.25, 0.3]).double()
    torch.testing.assert_close(cut.probability[3, 5], model(point).detach())


def test_a_slice_of_a_flat_map_is_all_of_it():
    model = ball(dim=2)
    cut = query_slice(model, resolution=0.1)
    assert cut.probability.shape == (19, 19)  # three standard deviations of 0.3 m on both sides
    assert cut.extent == pytest.approx((-0.9, 0.9, -0.9, 0.9))


def test_bounds_are_three_standard_deviations_around_the_clusters_and_follow_the_origin():
    origin = torch.tensor([5e5, 4.5e6, 100.0]).double()
    factor = torch.tensor([[[1.0, 0, 0], [3.0, 4.0, 0], [0, 0, 0.1]]])
    lower, upper = map_bounds(GaussianMap([[1.0, 2.0, 3.0]], factor, [1.0], origin), margin=0.5)
    reach = torch.tensor([3.5, 15.5, 0.8]).double()  # row lengths 1, 5, 0.1
    center = origin + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(lower, center - reach)
    torch.testing.assert_close(upper, center + reach)


def test_gradients_agree_with_finite_differences():
    model, points = random_map(seed=4), torch.randn(2, 5, 3, dtype=torch.float64)
    slopes = []
    for axis in range(3):
        step = 1e-5 * torch.eye(3, dtype=torch.float64)[axis]
        slopes.append((model.log_odds(points + step) - model.log_odds(points - step)) / 2e-5)
    expected = torch.stack(slopes, dim=-1).detach()
    torch.testing.assert_close(occupancy_gradient(model, points), expected, rtol=1e-5, atol=1e-7)
    assert model.weights.grad is None


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
    ranges = raycast(
        model, start, torch.tensor([[7.0, 0, 0], [0, 1, 0], [-1, 0, 0]]), 5.0, threshold
    )
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
    ranges = raycast(model, starts, directions, 6.0, threshold=0.6, step=0.02)
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
    assert (before <= math.log(0.6 / 0.4) + EVIDENCE).all()


def test_ranges_do_not_depend_on_how_rays_are_batched(monkeypatch):
    model = ball()
    starts = torch.tensor([-2.0, 0.1, 0.0]).double()
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(1)).double()
    together = raycast(model, starts, directions, 5.0)
    monkeypatch.setattr(querying, "BLOCK_POINTS", 3 * querying.STRIDE)
    torch.testing.assert_close(raycast(model, starts, directions, 5.0), together)


def test_a_ray_that_starts_inside_has_range_zero_and_one_that_cannot_reach_has_none():
    starts = torch.tensor([[0.0, 0, 0], [-2.0, 0, 0]]).double()
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0]])
    assert raycast(ball(), starts, directions, 1.0).tolist() == [0.0, math.inf]


def test_a_ripple_where_nothing_was_measured_stops_no_ray():
    faint = ball(weight=0.1)
    assert raycast(faint, torch.tensor([-2.0, 0, 0]), torch.tensor([[1.0, 0, 0]]), 5.0) == math.inf


def test_from_unknown_space_a_ray_ends_where_the_obstacle_becomes_clear():
    ranges = raycast(ball(), torch.tensor([-1.0, 0, 0]), torch.tensor([[1.0, 0, 0]]), 5.0)
    assert float(ranges) == pytest.approx(1 - radius_where(EVIDENCE), abs=1e-5)


def test_no_rays_give_no_ranges():
    assert raycast(ball(), torch.zeros(3), torch.zeros(0, 3), 5.0).shape == (0,)


def test_the_step_is_the_thickness_of_the_occupied_clusters():
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[
        0
    ]
    covariance = turn @ torch.diag(torch.tensor([0.04, 1.0, 2.0]).double() ** 2) @ turn.T
    factors = torch.stack([torch.linalg.cholesky(covariance), 0.001 * torch.eye(3).double()])
    assert surface_step(GaussianMap(torch.zeros(2, 3), factors, [1.0, -1.0])) == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0], [1, 1], 0.0), "resolution must be > 0 m and finite; got 0.0"),
        (([0, 0], [1, 1], math.nan), "resolution must be > 0 m"),
        (([0, 0], [1], 0.1), r"lower <= upper; got \[0.0, 0.0\] and \[1.0\]"),
        (([0, 2], [1, 1], 0.1), "lower <= upper"),
        (([0, math.nan], [1, 1], 0.1), "lower <= upper"),
        (([0, 0], [1, math.inf], 0.1), "lower and upper must be finite"),
    ],
)
def test_bad_grids_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        grid(*arguments)


def test_bad_slices_and_bounds_are_refused():
    with pytest.raises(ValueError, match="must have 3 coordinates; got 2"):
        query_grid(ball(), [0, 0], [1, 1], 0.5)
    with pytest.raises(
        ValueError, match="height must be a number in 3-D and None in 2-D; got None"
    ):
        query_slice(ball())
    with pytest.raises(ValueError, match="height must be a number in 3-D and None in 2-D; got 1"):
        query_slice(ball(dim=2), height=1.0)
    with pytest.raises(ValueError, match=r"2 or 3 dimensions; got 4\. Use query_grid"):
        query_slice(ball(dim=4), height=1.0)
    with pytest.raises(ValueError, match="it is empty: fit it first"):
        map_bounds(GaussianMap(torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0)))


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
    ],
)
def test_bad_rays_are_refused(changed, message):
    arguments = {"origins": torch.zeros(3), "directions": torch.ones(2, 3), "max_range": 5.0}
    with pytest.raises(ValueError, match=message):
        raycast(ball(), **{**arguments, **changed})


def test_a_map_without_occupied_clusters_needs_a_step():
    model = ball(weight=-1.0)
    with pytest.raises(ValueError, match="got none: give a step"):
        raycast(model, torch.zeros(3), torch.ones(1, 3), 5.0)
    assert raycast(model, torch.zeros(3), torch.ones(1, 3), 5.0, step=0.1) == math.inf


def test_an_obstacle_wider_than_the_step_is_met_wherever_it_lies():
    distances = torch.linspace(1.0, 40.0, 400, dtype=torch.float64)
    starts = torch.zeros(400, 3, dtype=torch.float64)
    starts[:, 0] = -distances
    toward = torch.tensor([[1.0, 0, 0]]).expand(400, 3)
    ranges = raycast(ball(), starts, toward, 50.0, threshold=0.6, step=1.0)
    expected = distances - radius_where(math.log(0.6 / 0.4))
    torch.testing.assert_close(ranges, expected.clamp(min=0), rtol=0, atol=1e-3)
