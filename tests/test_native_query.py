"""The native kernel's queries against brute force in float64."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from native_maps import (
    CENTER_COUNTS,
    assert_neighbors_exact,
    dims,
    dtypes,
    kernel,
    make_map,
    make_points,
    true_terms,
)
from torch import Tensor

from lardhm_torch import features, native
from lardhm_torch.features import nearest_centers as plain_nearest
from lardhm_torch.native.surfaces import NativeMap, cube_log_odds, point_gradients


@dtypes
@dims
@pytest.mark.parametrize("k", [1, 2, 3, 5, 7, 8, 12, 16, 40])
def test_answers_equal_brute_force(ops, dtype, dim, k):
    for count in CENTER_COUNTS:
        parameters = make_map(count, dim, dtype)
        points = make_points(300, dim, dtype)
        index = ops.build_index(parameters[0], k)
        found = ops.nearest(points, parameters[0], k, index)
        assert_neighbors_exact(points, parameters[0], k, found)
        terms = true_terms(points, parameters, found, torch.float64)
        log_odds = ops.occupancy(points, *parameters, *kernel(k), index, False)
        tolerance = 1e-5 if dtype == torch.float32 else 1e-12
        error = (log_odds.double() - terms.sum(dim=1)).abs()
        assert log_odds.dtype == dtype
        assert (error <= tolerance * (1 + terms.abs().sum(dim=1))).all()
        probability = ops.occupancy(points, *parameters, *kernel(k), index, True)
        torch.testing.assert_close(probability, torch.sigmoid(log_odds))


@dims
def test_neighbors_and_ties_are_those_of_the_definition(ops, dim):
    axes = [torch.arange(6.0)] * dim  # a lattice: nearly every point has ties
    centers = torch.cartesian_prod(*axes)
    centers = centers[torch.randperm(len(centers), generator=torch.Generator().manual_seed(0))]
    points = torch.cat([centers + 0.5, centers, centers + torch.rand(dim), 0.37 * centers])
    for k in (1, 3, 5, 9):
        found = ops.nearest(points, centers, k, ops.build_index(centers, k))
        assert torch.equal(found, plain_nearest(points, centers, k))


def clustered(count: int, dim: int, rng: torch.Generator) -> Tensor:
    homes = 100 * torch.randn(4, dim, generator=rng, dtype=torch.float64)
    spread = 10.0 ** torch.randint(-3, 1, (count, 1), generator=rng)
    chosen = homes[torch.randint(4, (count,), generator=rng)]
    return chosen + spread * torch.randn(count, dim, generator=rng, dtype=torch.float64)


def placed(kind: str, count: int, dim: int, seed: int) -> Tensor:
    """Positions of one of the shapes that trouble searches, float64."""
    rng = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, dim, generator=rng, dtype=torch.float64)
    if kind == "clustered":
        return clustered(count, dim, rng)
    if kind == "collinear":
        return normal[:, :1] * torch.ones(dim, dtype=torch.float64)
    if kind == "duplicated":
        return normal[torch.randint(max(1, count // 5), (count,), generator=rng)]
    if kind == "far":
        scale = 10.0 ** torch.randint(-2, 4, (1,), generator=rng)
        return scale * (normal + 10.0 ** torch.randint(1, 4, (1,), generator=rng))
    if kind == "outlier":
        normal[0] *= 1e5
    return normal


KINDS = ("random", "clustered", "collinear", "duplicated", "far", "outlier")


@settings(deadline=None, max_examples=60)
@given(
    kind=st.sampled_from(KINDS),
    count=st.integers(1, 400),
    dim=st.sampled_from([2, 3]),
    k=st.integers(1, 20),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31 - 1),
)
def test_neighbors_are_exact_whatever_the_layout(kind, count, dim, k, dtype, seed):
    if not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    centers = placed(kind, count, dim, seed).to(dtype)
    near = centers[torch.arange(200) % count] + placed(kind, 200, dim, seed + 1).to(dtype) / 50
    points = torch.cat([near, placed(kind, 100, dim, seed + 2).to(dtype), 20 * near[:50]])
    index = torch.ops.lardhm.build_index(centers, k)
    assert_neighbors_exact(points, centers, k, torch.ops.lardhm.nearest(points, centers, k, index))


@pytest.mark.parametrize("count", [1, 10, 200, 3000])
def test_few_points_in_a_large_map_are_answered_exactly(ops, count):
    parameters = make_map(20_000, 3, torch.float32)
    points = make_points(count, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    found = torch.cat([ops.nearest(p, parameters[0], 5, index) for p in points.split(1000)])
    for some, rows in zip(points.split(200), found.split(200), strict=True):
        assert_neighbors_exact(some, parameters[0], 5, rows)
    assert torch.equal(found, ops.nearest(points, parameters[0], 5, index))
    terms = true_terms(points, parameters, found, torch.float64)
    answer = ops.occupancy(points, *parameters, *kernel(5), index, False).double()
    assert ((answer - terms.sum(dim=1)).abs() <= 1e-5 * (1 + terms.abs().sum(dim=1))).all()
    grad = torch.ones(count)
    by_weights = ops.occupancy_backward(grad, points, *parameters, *kernel(5), index, False, 8)[3]
    expected = torch.zeros(20_000, dtype=torch.float64)
    expected.index_add_(0, found.flatten(), (terms / parameters[2][found]).flatten())
    torch.testing.assert_close(by_weights.double(), expected, rtol=1e-4, atol=1e-5)


def test_order_and_number_of_points_do_not_change_a_bit(ops):
    parameters = make_map(900, 3, torch.float32)
    points = make_points(50_000, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    whole = ops.occupancy(points, *parameters, *kernel(5), index, False)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    assert torch.equal(
        ops.occupancy(points[order], *parameters, *kernel(5), index, False), whole[order]
    )
    chunks = [ops.occupancy(c, *parameters, *kernel(5), index, False) for c in points.split(777)]
    assert torch.equal(torch.cat(chunks), whole)


@dtypes
@pytest.mark.parametrize("k", [5, 10, 16, 18])
def test_points_at_coincident_centers_are_answered_beside_others(ops, dtype, k):
    centers, raw, weights = make_map(300, 3, dtype)
    centers[100:140] = centers[100]
    rng = torch.Generator().manual_seed(2)
    points = centers[100] + 1e-2 * torch.randn(256, 3, generator=rng, dtype=dtype)
    points[::3] = centers[100]  # k-th distance 0: neighbors there do not fade
    points[1::3] = make_points(len(points[1::3]), 3, dtype)
    index = ops.build_index(centers, k)
    answer = ops.occupancy(points, centers, raw, weights, *kernel(k), index, False)
    factors = features.kernel_factors(raw, kernel(k))
    expected = features.log_odds(points, centers, factors, weights, k)
    tolerance = 1e-4 if dtype == torch.float32 else 1e-10
    torch.testing.assert_close(answer, expected, rtol=tolerance, atol=tolerance)
    alone = [
        ops.occupancy(p, centers, raw, weights, *kernel(k), index, False) for p in points.split(1)
    ]
    assert torch.equal(torch.cat(alone), answer)


@dtypes
@pytest.mark.parametrize("shape", [(7, 9), (40, 33), (1, 1, 1), (8, 8, 8), (13, 21, 6), (3, 0, 5)])
@pytest.mark.parametrize("count", [0, 3, 400])
def test_a_lattice_is_answered_as_its_points_are(ops, dtype, shape, count):
    parameters = make_map(count, len(shape), dtype)
    axes = [torch.linspace(-4, 3, n, dtype=dtype) for n in shape]
    points = torch.cartesian_prod(*axes)
    index = ops.build_index(parameters[0], 5)
    for probability in (True, False):
        expected = ops.occupancy(points, *parameters, *kernel(5), index, probability)
        found = native.lattice_occupancy(
            axes, *parameters, kernel(5), probability=probability, index=index
        )
        assert torch.equal(found, expected.reshape(shape))


def test_lattices_of_other_dimensions_and_types_are_refused(ops):
    parameters = make_map(9, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    for axes, shape in ((torch.zeros(4), [2, 2]), (torch.zeros(5).double(), [2, 2, 1])):
        with pytest.raises(RuntimeError, match="axes must hold one list of coordinates"):
            ops.lattice_occupancy(axes, shape, *parameters, *kernel(5), index, True)


def test_huge_coordinates_neither_hang_nor_spoil_other_points(ops):
    parameters = make_map(100, 3, torch.float32)
    points = torch.tensor([[1e19, 0, 0], [1e30, -1e30, 1e30], [0, 0, 0], [3e38, -3e38, 3e38]])
    index = ops.build_index(parameters[0], 5)
    answer = ops.occupancy(points, *parameters, *kernel(5), index, False)
    assert (answer[:2] == 0).all()
    assert torch.equal(
        answer[2:3], ops.occupancy(points[2:3], *parameters, *kernel(5), index, False)
    )


@dtypes
def test_points_that_are_not_finite_give_nan_and_spoil_no_other(ops, dtype):
    parameters = make_map(80, 3, dtype)
    points = make_points(200, 3, dtype)
    index = ops.build_index(parameters[0], 5)
    clean = ops.occupancy(points, *parameters, *kernel(5), index, True)
    bad = torch.tensor([3, 50, 199])
    points[bad, torch.tensor([0, 1, 2])] = torch.tensor([torch.nan, torch.inf, -torch.inf]).to(
        dtype
    )
    answer = ops.occupancy(points, *parameters, *kernel(5), index, True)
    assert answer[bad].isnan().all()
    good = torch.ones(200, dtype=torch.bool).index_fill(0, bad, False)
    assert torch.equal(answer[good], clean[good])
    assert ops.nearest(points, parameters[0], 5, index)[bad].max() < 80


@dims
def test_empty_and_tiny_maps_and_queries_are_answered(ops, dim):
    for count, points in ((0, 4), (1, 0), (1, 1), (3, 17)):
        parameters = make_map(count, dim, torch.float32)
        x = make_points(points, dim, torch.float32)
        index = ops.build_index(parameters[0], 5)
        assert ops.nearest(x, parameters[0], 5, index).shape == (points, min(5, count))
        answer = ops.occupancy(x, *parameters, *kernel(5), index, True)
        assert answer.shape == (points,)
        if count == 0:
            assert (answer == 0.5).all()
        wanted = ops.occupancy_backward(answer, x, *parameters, *kernel(5), index, True, 15)
        assert [g.shape for g in wanted] == [t.shape for t in (x, *parameters)]


def test_strided_inputs_give_the_same(ops):
    centers, raw, weights = make_map(50, 3, torch.float64)
    points = make_points(100, 3, torch.float64)
    index = ops.build_index(centers, 5)
    expected = ops.occupancy(points, centers, raw, weights, *kernel(5), index, False)
    apart = torch.stack([weights, weights], dim=1)[:, 0]
    turned = raw.mT.contiguous().mT
    strided = (points.T.contiguous().T, centers, turned, apart)
    answer = ops.occupancy(*strided, *kernel(5), index, False)
    assert torch.equal(answer, expected)


def test_wrong_shapes_and_types_are_refused_by_name(ops):
    centers, raw, weights = make_map(9, 3, torch.float32)
    index = ops.build_index(centers, 5)
    points = torch.zeros(4, 3)
    with pytest.raises(RuntimeError, match="points must be"):
        ops.nearest(torch.zeros(4, 2), centers, 5, index)
    with pytest.raises(RuntimeError, match="points must have the dtype"):
        ops.nearest(points.double(), centers, 5, index)
    with pytest.raises(RuntimeError, match="one factor per center"):
        ops.occupancy(points, centers, raw[:4], weights, *kernel(5), index, False)
    with pytest.raises(RuntimeError, match="weights must be"):
        ops.occupancy(points, centers, raw, weights[:4], *kernel(5), index, False)
    with pytest.raises(RuntimeError, match="covariance_scale must be > 0"):
        ops.occupancy(points, centers, raw, weights, 5, 0.0, 0.0, index, False)
    with pytest.raises(RuntimeError, match="k must be at least 1"):
        ops.nearest(points, centers, 0, index)
    with pytest.raises(RuntimeError, match="index must be a uint8"):
        ops.nearest(points, centers, 5, index.float())


@dtypes
@dims
@pytest.mark.parametrize("edge", [1, 3, 9])
def test_cubes_of_a_lattice_are_answered_as_their_points_are(ops, dtype, dim, edge):
    parameters, rng = make_map(60, dim, dtype), torch.Generator().manual_seed(0)
    index = ops.build_index(parameters[0], 5)
    axes = [torch.linspace(-4, 4, 30 + d, dtype=dtype) for d in range(dim)]
    firsts = torch.randint(0, 30 - edge + 1, (50, dim), generator=rng)
    model = NativeMap(*parameters, kernel(5), index, torch.zeros(dim, dtype=torch.float64))
    found = cube_log_odds(model, axes, firsts, edge)
    steps = torch.cartesian_prod(*[torch.arange(edge)] * dim).reshape(-1, dim)
    places = firsts[:, None] + steps
    points = torch.stack([axes[d][places[..., d]] for d in range(dim)], dim=-1)
    expected = ops.occupancy(points.reshape(-1, dim), *parameters, *kernel(5), index, False)
    assert found.shape == (50, *[edge] * dim)
    torch.testing.assert_close(found.reshape(-1), expected)


def test_cubes_outside_of_their_lattice_are_refused(ops):
    parameters = make_map(7, 3, torch.float32)
    index, axes = ops.build_index(parameters[0], 5), [torch.zeros(9)] * 3
    model = NativeMap(*parameters, kernel(5), index, torch.zeros(3, dtype=torch.float64))
    for first in (1, -1):
        with pytest.raises(RuntimeError, match="cubes must lie in the lattice"):
            cube_log_odds(model, axes, torch.full((1, 3), first), 9)


@dtypes
def test_gradients_by_points_are_those_of_autograd(ops, dtype):
    parameters, points = make_map(60, 3, dtype), make_points(200, 3, dtype).requires_grad_()
    index = ops.build_index(parameters[0], 5)
    ops.occupancy(points, *parameters, *kernel(5), index, False).sum().backward()
    model = NativeMap(*parameters, kernel(5), index, torch.zeros(3, dtype=torch.float64))
    found = point_gradients(model, points.detach().double())
    torch.testing.assert_close(found, points.grad.double())
