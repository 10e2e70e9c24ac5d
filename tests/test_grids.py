import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import GaussianMap, ball, random_map

from lardhm_torch.queries import grids
from lardhm_torch.queries.grids import grid, map_bounds, occupancy_gradient, query_grid, query_slice


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


def test_arrays_lists_and_tensors_are_corners_alike():
    model = random_map(seed=1)
    ends = (np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 0.5]))
    expected = query_grid(model, *(end.tolist() for end in ends), 0.5)
    for convert in (np.asarray, torch.as_tensor, tuple):
        assert torch.equal(query_grid(model, *map(convert, ends), 0.5), expected)
        cut = query_slice(model, 0.5, 0.5, tuple(map(convert, ends)))
        assert torch.equal(cut.probability, expected[:, :, -1])
    points = np.random.default_rng(0).normal(size=(4, 3))
    assert torch.equal(
        occupancy_gradient(model, points), occupancy_gradient(model, torch.tensor(points))
    )
    with pytest.raises(ValueError, match="lower must be a tensor, an array or equally long lists"):
        grid("ab", [1, 1], 0.1)


def test_the_query_grid_of_the_paper_has_its_number_of_points():
    axes = grids.grid_axes([0, 0, 0], [6.3, 5.3, 2.3], 0.05)
    assert [len(axis) for axis in axes] == [127, 107, 47]


@pytest.mark.parametrize("block", [7, 1 << 20])
@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_a_queried_grid_equals_the_queries_of_its_points(dim, block, monkeypatch):
    monkeypatch.setattr(grids, "BLOCK_POINTS", block)
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
