"""The native kernel against a brute-force float64 oracle, and its loader."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel, kernel_factors, raw_factors
from lardhm_torch.features import nearest_centers as plain_nearest
from lardhm_torch.native import build

ULPS = 4
CENTER_COUNTS = (1, 2, 7, 60, 500)
ROOT = Path(__file__).parents[1]


@pytest.fixture
def ops():
    if not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    return torch.ops.lardhm


def make_map(count: int, dim: int, dtype: torch.dtype, seed: int = 0) -> tuple[Tensor, ...]:
    """Random centers, raw factors and weights; some axes are thinner than the floor."""
    rng = torch.Generator().manual_seed(seed)
    centers = 2 * torch.randn(count, dim, generator=rng, dtype=dtype)
    scale_tril = torch.randn(count, dim, dim, generator=rng, dtype=dtype).tril()
    scale_tril.diagonal(dim1=1, dim2=2).abs_().add_(0.3)
    return centers, raw_factors(scale_tril), torch.randn(count, generator=rng, dtype=dtype)


def kernel(num_neighbors: int) -> Kernel:
    """The settings of the maps here."""
    return Kernel(num_neighbors, covariance_scale=1.7, min_lengthscale=0.4)


def make_points(count: int, dim: int, dtype: torch.dtype, seed: int = 1) -> Tensor:
    """Random points, many of them outside the centers' box."""
    rng = torch.Generator().manual_seed(seed)
    points = 3 * torch.randn(count, dim, generator=rng, dtype=dtype)
    points[::5] *= 4
    return points


def true_distances(points: Tensor, centers: Tensor) -> Tensor:
    """(N, M) in float64."""
    return (points.double()[:, None] - centers.double()).square().sum(dim=2).sqrt()


def true_neighbors(points: Tensor, centers: Tensor, k: int) -> Tensor:
    """(N, k) rows of the centers, ascending, ties to the lower."""
    order = true_distances(points, centers).sort(dim=1, stable=True).indices
    return order[:, :k].sort(dim=1).values


def true_terms(
    points: Tensor, parameters: tuple[Tensor, ...], indices: Tensor, dtype: torch.dtype
) -> Tensor:
    """(N, k) weight times kernel value."""
    points = points.to(dtype)
    centers, raw, weights = (tensor.to(dtype) for tensor in parameters)
    scale_tril = kernel_factors(raw, kernel(1))
    offsets = (points[:, None] - centers[indices])[..., None]
    whitened = torch.linalg.solve_triangular(scale_tril[indices], offsets, upper=False)
    return weights[indices] * torch.exp(-0.5 * whitened.square().sum(dim=(2, 3)))


def assert_neighbors_exact(points: Tensor, centers: Tensor, k: int, found: Tensor) -> None:
    """Distinct, ascending, and the k-th distance right to a few units in the last place."""
    k = min(k, len(centers))
    assert found.shape == (len(points), k)
    assert (found.diff(dim=1) > 0).all()
    distances = true_distances(points, centers)
    farthest = distances.gather(1, found).max(dim=1).values
    expected = distances.kthvalue(k, dim=1).values
    assert (farthest - expected <= ULPS * torch.finfo(centers.dtype).eps * expected).all()


dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
dims = pytest.mark.parametrize("dim", [2, 3])


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


# --- gradients ---


def reference_gradients(points, parameters, indices, grad, probability):
    inputs = [t.detach().clone().requires_grad_() for t in (points, *parameters)]
    answer = true_terms(inputs[0], tuple(inputs[1:]), indices, torch.float64).sum(dim=1)
    answer = torch.sigmoid(answer) if probability else answer
    return torch.autograd.grad(answer, inputs, grad)


@dims
@pytest.mark.parametrize("probability", [False, True])
def test_gradients_equal_those_of_the_formula(ops, dim, probability):
    for count in CENTER_COUNTS:
        parameters = make_map(count, dim, torch.float64)
        points = make_points(3000, dim, torch.float64)
        index = ops.build_index(parameters[0], 5)
        grad = torch.randn(3000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        indices = true_neighbors(points, parameters[0], 5)
        expected = reference_gradients(points, parameters, indices, grad, probability)
        for wanted in (15, 1, 8, 6):
            found = ops.occupancy_backward(
                grad, points, *parameters, *kernel(5), index, probability, wanted
            )
            for bit, (mine, true) in enumerate(zip(found, expected, strict=True)):
                if wanted >> bit & 1:
                    torch.testing.assert_close(mine, true, rtol=1e-9, atol=1e-10)
                else:
                    assert mine.numel() == 0


@dims
@pytest.mark.parametrize("probability", [False, True])
def test_gradcheck_passes_twice(ops, dim, probability):
    parameters = make_map(6, dim, torch.float64)
    points = make_points(5, dim, torch.float64) / 4
    inputs = [t.clone().requires_grad_() for t in (points, *parameters)]

    def answer(points, centers, raw, weights):
        index = ops.build_index(centers.detach(), 4)
        return ops.occupancy(points, centers, raw, weights, *kernel(4), index, probability)

    assert torch.autograd.gradcheck(answer, inputs)
    assert torch.autograd.gradgradcheck(answer, inputs)


def test_gradients_are_the_same_at_every_call(ops):
    parameters = make_map(700, 3, torch.float32)
    points = make_points(20_000, 3, torch.float32)
    grad = torch.ones(20_000)
    index = ops.build_index(parameters[0], 5)
    first, second = (
        ops.occupancy_backward(grad, points, *parameters, *kernel(5), index, True, 15)
        for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_opcheck_accepts_the_operators(ops):
    parameters = make_map(12, 3, torch.float64)
    points = make_points(40, 3, torch.float64)
    index = ops.build_index(parameters[0], 5)
    tracked = [t.clone().requires_grad_() for t in (points, *parameters)]
    torch.library.opcheck(ops.occupancy.default, (*tracked, *kernel(5), index, True))
    torch.library.opcheck(ops.nearest.default, (points, parameters[0], 5, index))
    grad = torch.ones(40, dtype=torch.float64)
    arguments = (grad, points, *parameters, *kernel(5), index, False, 15)
    torch.library.opcheck(ops.occupancy_backward.default, arguments)
    torch.library.opcheck(ops.assign.default, (points, parameters[0], index, True))
    torch.library.opcheck(ops.build_index.default, (parameters[0], 5))
    given = (points, *parameters[:2], index)
    torch.library.opcheck(ops.nearest_features.default, (*given, *kernel(5)))
    lattice = (points.flatten()[:9], [2, 3, 4], *parameters, *kernel(5), index, True)
    torch.library.opcheck(ops.lattice_occupancy.default, lattice)
    rows = torch.arange(40).reshape(2, 20)
    torch.library.opcheck(ops.kmeans.default, (points, parameters[0], rows, 20, 5))
    torch.library.opcheck(ops.z_order.default, (points,))
    indices, values = ops.nearest_features(*given, *kernel(5))
    state = (grad, grad, parameters[2], *torch.zeros(2, 12, dtype=torch.float64))
    rates = (40, 10, 0, 4, 0.5, True, True, 0.0, 0.1)
    torch.library.opcheck(ops.descent.default, (indices, values, *state, *rates))


def test_compiled_functions_give_the_same(ops):
    parameters = make_map(40, 3, torch.float32)
    points = make_points(64, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)

    def loss(points, *parameters):
        return ops.occupancy(2 * points, *parameters, *kernel(5), index, True).sum()

    def gradients(function):
        inputs = [t.clone().requires_grad_() for t in (points, *parameters)]
        return torch.autograd.grad(function(*inputs), inputs)

    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    for mine, true in zip(gradients(compiled), gradients(loss), strict=True):
        torch.testing.assert_close(mine, true)


# --- assignment ---


@dtypes
@dims
@pytest.mark.parametrize("native_path", [True, False])
def test_assignment_sums_the_moments_of_each_center(dtype, dim, native_path, monkeypatch):
    if native_path and not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    monkeypatch.setattr(native, "supports", lambda points: native_path)
    centers = make_map(30, dim, dtype)[0]
    points = make_points(5000, dim, dtype)
    points[7] = torch.nan
    labels, counts, sums, scatters = native.assign(points, centers)
    kept = torch.arange(5000) != 7
    expected = true_distances(points[kept], centers).argmin(dim=1)
    assert labels[7] == -1
    assert torch.equal(labels[kept], expected)
    offsets = (points[kept] - centers[expected]).double()
    products = offsets[:, :, None] * offsets[:, None]
    zeros = torch.zeros(30, dim, dim, dtype=torch.float64)
    assert torch.equal(counts, torch.bincount(expected, minlength=30).to(dtype))
    torch.testing.assert_close(
        sums, zeros[:, 0].clone().index_add_(0, expected, offsets).to(dtype), rtol=1e-5, atol=1e-4
    )
    torch.testing.assert_close(scatters, zeros.index_add_(0, expected, products).to(dtype))
    assert native.assign(points, centers, scatter=False)[3].shape == (0, dim, dim)


# --- the index ---


def test_a_stale_or_foreign_index_cannot_change_an_answer(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    good = ops.build_index(parameters[0], 5)
    expected = ops.occupancy(points, *parameters, *kernel(5), good, False)
    nothing = torch.empty(0, dtype=torch.uint8)
    damaged = good.clone()
    damaged[45] += 1  # in the corner of the centers' box
    others = [
        nothing, good[:-1], good[:100], good[1:], damaged, torch.zeros_like(good),
        torch.randint(256, (5000,), dtype=torch.uint8),
        ops.build_index(parameters[0].double(), 5), ops.build_index(parameters[0][:, :2], 5),
        ops.build_index(parameters[0] + 1e-3, 5), ops.build_index(parameters[0][:-1], 5),
    ]  # fmt: skip
    for other in others:
        assert not ops.index_matches(other, parameters[0], 5)
        assert torch.equal(ops.occupancy(points, *parameters, *kernel(5), other, False), expected)
    assert ops.index_matches(good, parameters[0], 5)


def test_changing_the_centers_in_place_makes_the_index_stale(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    parameters[0].data[17, 2] += 1e-4
    assert not ops.index_matches(index, parameters[0], 5)
    parameters[0].data[:30] += 3
    fresh = ops.build_index(parameters[0], 5)
    stale = ops.occupancy(points, *parameters, *kernel(5), index, False)
    assert torch.equal(stale, ops.occupancy(points, *parameters, *kernel(5), fresh, False))


def test_one_index_serves_every_number_of_neighbors(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    index = ops.build_index(parameters[0], 1)
    assert ops.index_matches(index, parameters[0], 30)
    assert_neighbors_exact(points, parameters[0], 30, ops.nearest(points, parameters[0], 30, index))


# --- threads and processes ---


def test_several_threads_at_once_get_their_own_answers(ops):
    maps = [make_map(300, 3, torch.float32, seed) for seed in range(4)]
    points = make_points(20_000, 3, torch.float32)
    nothing = torch.empty(0, dtype=torch.uint8)
    expected = [ops.occupancy(points, *one, *kernel(5), nothing, True) for one in maps]
    found: dict[int, list[Tensor]] = {}

    def ask(which: int) -> None:
        found[which] = [
            ops.occupancy(points, *maps[which], *kernel(5), nothing, True) for _ in range(5)
        ]

    threads = [threading.Thread(target=ask, args=(which,)) for which in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert all(
        torch.equal(answer, expected[which]) for which in range(4) for answer in found[which]
    )


def test_the_number_of_torch_threads_does_not_change_a_bit(ops):
    parameters = make_map(300, 3, torch.float32)
    points = make_points(100_000, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    before = torch.get_num_threads()
    answers = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            answers.append(ops.occupancy(points, *parameters, *kernel(5), index, True))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(answer, answers[0]) for answer in answers)


def _answer_in_child(queue, points, parameters, index):
    answer = torch.ops.lardhm.occupancy(points, *parameters, *kernel(5), index, True)
    queue.put(answer[::1000].tolist())  # torch's own operators on many numbers would hang here


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_does_not_hang(ops):
    parameters = make_map(300, 3, torch.float32)
    points = make_points(50_000, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        expected = ops.occupancy(points, *parameters, *kernel(5), index, True)[::1000].tolist()
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        child = context.Process(
            target=_answer_in_child, args=(queue, points, parameters, index), daemon=True
        )
        child.start()
        child.join(30)
        assert child.exitcode == 0, "the child hangs or died"
        assert queue.get() == expected
    finally:
        torch.set_num_threads(before)


# --- the loader ---

ASK = """
import warnings
warnings.simplefilter("always")
import torch
from lardhm_torch import native
with warnings.catch_warnings(record=True) as heard:
    warnings.simplefilter("always")
    points = torch.rand(10, 3)
    centers = torch.rand(4, 3)
    raw, weights, kernel = torch.zeros(4, 3, 3), torch.ones(4), native.Kernel(2)
    for _ in range(3):
        native.occupancy(points, centers, raw, weights, kernel, probability=True)
print(native.available(), len(heard), *[str(w.message) for w in heard])
"""


def ask_in_process(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", ASK], capture_output=True, text=True, timeout=240, cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_without_a_compiler_one_warning_names_the_cause_and_the_cure(tmp_path):
    answer = ask_in_process(CXX="no-such-compiler", LARDHM_CACHE=str(tmp_path), LARDHM_NATIVE="1")
    assert answer.startswith("False 1 ")
    assert "no-such-compiler" in answer
    assert "LARDHM_NATIVE=0" in answer


def test_a_failing_compiler_means_the_plain_path(tmp_path):
    answer = ask_in_process(CXX="false", LARDHM_CACHE=str(tmp_path), LARDHM_NATIVE="1")
    assert answer.startswith("False 1 ")


@pytest.mark.parametrize("word", ["0", "false", "OFF"])
def test_switched_off_it_is_silent(word, tmp_path):
    answer = ask_in_process(LARDHM_NATIVE=word, LARDHM_CACHE=str(tmp_path))
    assert answer == "False 0"
    assert list(tmp_path.iterdir()) == []


def stub_compiler(tmp_path: Path, body: str) -> Path:
    """A compiler that does as the shell lines say; $target is the file it is to make."""
    script = tmp_path / "compiler.sh"
    find_target = 'while [ "$1" != "-o" ]; do shift; done; target=$2'
    script.write_text(f"#!/bin/sh\n{find_target}\n{body}\n")
    script.chmod(0o755)
    return script


def test_a_killed_build_leaves_nothing_that_blocks_the_next(tmp_path, monkeypatch):
    slow = stub_compiler(tmp_path, 'echo half > "$target"; exec sleep 100')
    environment = {**os.environ, "CXX": str(slow), "LARDHM_NATIVE": "1"}
    environment["LARDHM_CACHE"] = str(tmp_path / "cache")
    started = subprocess.Popen([sys.executable, "-c", ASK], cwd=ROOT, env=environment,
                               start_new_session=True, stdout=subprocess.DEVNULL)  # fmt: skip
    deadline = time.monotonic() + 60
    while not list((tmp_path / "cache").glob("build-*/*.o")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    assert list((tmp_path / "cache").glob("build-*/*.o"))
    quick = stub_compiler(tmp_path, 'echo whole > "$target"')
    monkeypatch.setenv("CXX", str(quick))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    library = build._cached_library()
    assert library.read_text() == "whole\n"
    assert library.parent == tmp_path / "cache"


def test_an_unwritable_cache_is_replaced_by_a_temporary_folder(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path, 'echo whole > "$target"')))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(build.tempfile, "gettempdir", lambda: str(tmp_path))
    library = build._cached_library()
    assert library.read_text() == "whole\n"
    assert tmp_path in library.parents


def test_two_builds_at_once_both_succeed(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path, 'sleep 0.3; echo whole > "$target"')))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    built: list[Path] = []
    threads = [
        threading.Thread(target=lambda: built.append(build._cached_library())) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(built) == 2
    assert built[0] == built[1]
    assert built[0].read_text() == "whole\n"
    assert list((tmp_path / "cache").iterdir()) == [built[0]]


def test_a_damaged_library_in_the_cache_is_built_anew(ops, tmp_path, monkeypatch):
    sound = build._cached_library()
    compiler = stub_compiler(tmp_path, f'cp "{sound}" "$target"')
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    damaged = build._cached_library()
    damaged.write_bytes(b"no library")
    environment = {"CXX": str(compiler), "LARDHM_CACHE": str(tmp_path / "cache")}
    assert ask_in_process(LARDHM_NATIVE="1", **environment) == "True 0"
    assert damaged.read_bytes() == sound.read_bytes()


def test_a_change_of_source_or_compiler_is_another_library(tmp_path, monkeypatch):
    first = build._cache_key(["c++"])
    assert first == build._cache_key(["c++"])
    assert first != build._cache_key(["g++"])
    changed = shutil.copytree(build.FOLDER, tmp_path / "native")
    with (changed / "index.h").open("a") as source:
        source.write("\n")
    monkeypatch.setattr(build, "FOLDER", changed)
    assert first != build._cache_key(["c++"])


def test_importing_the_package_builds_and_loads_nothing(tmp_path):
    code = "import lardhm_torch.native as n; print(n.build._loaded)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True,
        env={**os.environ, "LARDHM_CACHE": str(tmp_path / "none")},
    )  # fmt: skip
    assert done.stdout.strip() == "None"
    assert not (tmp_path / "none").exists()


def test_other_dimensions_and_types_take_the_plain_path():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where there is no compiler
        assert not native.supports(torch.zeros(2, 4))
        assert not native.supports(torch.zeros(2, 3, dtype=torch.float16))
