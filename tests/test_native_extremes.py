"""Every native operator on odd sizes and on coordinates that are NaN, infinite or 1e30.

`make sanitize` runs these tests under sanitizers: what counts most is that the operators get through.
"""

import math

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points
from torch import Tensor

from lardhm_torch import features, native

EXTREMES = (math.nan, math.inf, -math.inf, 1e30, -1e30)
SIZES = ((1, 1), (7, 13), (37, 333), (500, 61))  # centers, points


def spoil(tensor: Tensor, every: int, values: tuple[float, ...] = EXTREMES) -> Tensor:
    """A copy with extreme numbers in every n-th row, one of its numbers each."""
    spoiled = tensor.clone()
    rows = spoiled.reshape(len(tensor), -1)
    for count, row in enumerate(range(0, len(tensor), every)):
        rows[row, count % rows.shape[1]] = values[count % len(values)]
    return spoiled


@dims
@dtypes
@pytest.mark.parametrize("sizes", SIZES)
def test_extreme_points_get_answers_and_change_no_other(ops, sizes, dtype, dim):
    count, size = sizes
    parameters = make_map(count, dim, dtype)
    points = make_points(size, dim, dtype)
    index = ops.build_index(parameters[0], 5)
    spoiled = spoil(points, 3)
    ordinary = (spoiled == points).all(dim=1)
    clean = native.occupancy(points, *parameters, kernel(5), probability=True)
    answer = native.occupancy(spoiled, *parameters, kernel(5), probability=True)
    assert torch.equal(answer[ordinary], clean[ordinary])
    assert torch.equal(answer.isnan(), ~spoiled.isfinite().all(dim=1))
    grad = torch.ones_like(answer)
    grads = ops.occupancy_backward(grad, spoiled, *parameters, *kernel(5), index, True, 15)
    assert grads[0][ordinary].isfinite().all()
    rows = native.nearest_centers(spoiled, parameters[0], 5)
    found, values = ops.nearest_features(spoiled, *parameters[:2], index, *kernel(5))
    for chosen in (rows, found):
        assert chosen.shape == (size, min(5, count))
        assert ((chosen >= 0) & (chosen < count)).all()
    assert values[ordinary].isfinite().all()
    order = ops.z_order(spoiled)
    assert torch.equal(order.sort().values, torch.arange(size))
    assert len(ops.ordered_features(spoiled, order, *parameters[:2], index, *kernel(5))[0]) == size


@dims
@dtypes
@pytest.mark.parametrize("every", [1, 2, 5])
def test_centers_that_are_not_finite_are_farther_than_all_others(
    ops, every, dtype, dim, monkeypatch
):
    monkeypatch.setattr(features, "KDTREE_MIN_CENTERS", 10**9)  # the tree refuses them
    parameters = make_map(93, dim, dtype)
    spoiled = (spoil(parameters[0], every, (math.nan,)), *parameters[1:])
    points = make_points(97, dim, dtype)
    index = ops.build_index(spoiled[0], 5)
    assert native.index_matches(index, spoiled[0], 5)  # byte by byte
    rows = ops.nearest(points, spoiled[0], 5, index)
    assert torch.equal(rows, features.nearest_centers(points, spoiled[0], 5))
    answer = native.occupancy(points, *spoiled, kernel(5), probability=False)
    expected = features.log_odds(
        points, spoiled[0], features.kernel_factors(spoiled[1], kernel(5)), spoiled[2], 5
    )
    torch.testing.assert_close(answer, expected, equal_nan=True, rtol=1e-4, atol=1e-4)
    assert expected.isnan().all() == (every == 1)


@dims
@dtypes
def test_parameters_that_are_not_finite_make_nobody_else_wrong(ops, dtype, dim):
    centers, raw, weights = make_map(60, dim, dtype)
    points = make_points(333, dim, dtype)
    index = ops.build_index(centers, 5)
    bad = (spoil(raw, 7), spoil(weights, 11))
    rows = ops.nearest(points, centers, 5, index)
    touched = torch.zeros(60, dtype=torch.bool)
    touched[::7], touched[::11] = True, True
    answer = ops.occupancy(points, centers, *bad, *kernel(5), index, True)
    clean = ops.occupancy(points, centers, raw, weights, *kernel(5), index, True)
    untouched = ~touched[rows].any(dim=1)
    assert 10 < untouched.sum() < 330
    assert torch.equal(answer[untouched], clean[untouched])
    axes = [spoil(torch.linspace(-3, 3, n, dtype=dtype), 4, EXTREMES[3:]) for n in (5, 9, 3)[:dim]]
    sizes = [len(axis) for axis in axes]
    lattice = ops.lattice_occupancy(torch.cat(axes), sizes, centers, *bad, *kernel(5), index, True)
    assert list(lattice.shape) == sizes


@dims
@dtypes
@pytest.mark.parametrize("sizes", SIZES)
def test_extreme_points_do_not_keep_clusters_from_being_formed(ops, sizes, dtype, dim):
    count, size = sizes
    centers = make_map(count, dim, dtype)[0]
    points = spoil(make_points(size, dim, dtype), 3)
    finite = points.isfinite().all(dim=1)
    for given in (centers, spoil(centers, 4)):
        labels, counts, _, scatters = native.assign(points, given)
        assert torch.equal(labels >= 0, finite)
        assert counts.sum() == finite.sum()
        assert scatters.shape == (count, dim, dim)
    rows = torch.arange(size).repeat(3)
    moved = ops.kmeans(points.nan_to_num(1e30, 1e30, -1e30), centers, rows, 10, 20)
    assert moved.shape == centers.shape
    owners = labels.to(torch.int32)
    assert ops.keep_points(points, owners, count, 4).shape == (count, 4, dim)


@dims
@dtypes
@pytest.mark.parametrize("count", [1, 7, 61])
def test_extreme_moments_and_boxes_get_answers(ops, count, dtype, dim):
    centers, raw, _ = make_map(count, dim, dtype)
    points = spoil(make_points(333, dim, dtype), 5)
    scatters = torch.eye(dim, dtype=dtype).repeat(count, 1, 1)
    counts = torch.full((count,), 9)
    owners = ops.nearest_clusters(points, counts, centers, scatters, 0.01, 3.0)
    assert ((owners >= -1) & (owners < count)).all()
    reached = ops.reaching(spoil(centers, 4), raw, points, 3.0, 1.7, 0.4)
    assert reached.shape == (count,)
    found = (counts, spoil(centers, 4), scatters)
    with pytest.raises(RuntimeError, match="not positive definite"):
        ops.pool(counts, centers, scatters, raw, *found, 0.01)


@dims
@dtypes
def test_extreme_rays_end_or_meet_nothing(ops, dtype, dim):
    parameters = make_map(37, dim, dtype)
    index = ops.build_index(parameters[0], 5)
    origins = spoil(make_points(61, dim, torch.float64), 3)
    ahead = torch.nn.functional.normalize(make_points(61, dim, torch.float64, seed=2), dim=1)
    for ridge in (False, True):
        march = (0.1, 7.3, 0.0, 0.0 if not ridge else 1.0, ridge)
        ranges = ops.raycast(origins, ahead, *march, *parameters, *kernel(5), index)
        assert ((ranges >= 0) & ((ranges <= 7.3) | ranges.isinf())).all()
    strides = spoil(0.02 * ahead, 4)
    ends = ops.ridge_positions(origins, strides, 9, 0.5, *parameters, *kernel(5), index)
    assert ends.shape == (61,)


@dims
@pytest.mark.parametrize("count", [1, 7, 61])
def test_extreme_faces_and_lattice_values_get_answers(ops, count, dim):
    centers = make_map(count, dim, torch.float64)[0]
    axes = torch.linalg.qr(make_map(count, dim, torch.float64)[1] + torch.eye(dim))[0].contiguous()
    half = torch.full((count, dim - 1), 0.3, dtype=torch.float64)
    points = spoil(make_points(97, dim, torch.float64), 3)
    for given in (centers, spoil(centers, 3)):
        faces = (given, axes, half, half.new_empty(0))
        found = ops.nearest_face(points, ops.face_tree(*faces), *faces, 2.0, True)
        assert [len(tensor) for tensor in found] == [97, 97, 97]
        assert (found[2] < count).all()
    values = spoil(make_points(27, dim, torch.float64), 4)
    corners = torch.tensor([[0, 5, 26], [26, 1, 0]])
    assert ops.mean_with_neighbors(values, corners).shape == values.shape
