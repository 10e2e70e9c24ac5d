"""What an update asks of many points and clusters: the native pass against its definition."""

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points, true_distances

from lardhm_torch import native
from lardhm_torch.clustering import cluster_points, factor_covariances
from lardhm_torch.features import kernel_factors, raw_factors
from lardhm_torch.map_state import MapState
from lardhm_torch.merging import pool_into
from lardhm_torch.native.update import explain, ordered_features, reaching

both_paths = pytest.mark.parametrize("native_path", [True, False])


@pytest.fixture
def path(request, monkeypatch):
    def choose(native_path):
        if native_path and not native.available():
            pytest.skip("the native kernel is off or there is no compiler")
        monkeypatch.setattr(native, "supports", lambda points: native_path)

    return choose


@dims
@dtypes
@both_paths
def test_points_near_their_center_have_an_owner_and_nearer_ones_count(
    dtype, dim, native_path, path
):
    path(native_path)
    centers, raw, _ = make_map(40, dim, dtype)
    factors = raw.tril(-1) + torch.diag_embed(raw.diagonal(dim1=1, dim2=2).exp())
    points = make_points(4000, dim, dtype)
    owners, counts, sums, scatters = explain(points, centers, factors, 1.5, 3.0)
    nearest = true_distances(points, centers).argmin(dim=1)
    offsets = (points - centers[nearest]).double()
    solved = torch.linalg.solve_triangular(
        factors[nearest].double(), offsets[:, :, None], upper=False
    )
    distance = torch.linalg.vector_norm(solved, dim=(1, 2))
    assert 100 < (distance > 3).sum() < 3900
    assert torch.equal(owners.long(), torch.where(distance <= 3, nearest, 40))
    joins = distance <= 1.5
    zeros = torch.zeros(40, dim, dim, dtype=torch.float64)
    products = offsets[joins, :, None] * offsets[joins, None]
    assert torch.equal(counts.long(), nearest[joins].bincount(minlength=40))
    total = zeros[:, 0].clone().index_add_(0, nearest[joins], offsets[joins])
    torch.testing.assert_close(sums, total.to(dtype), rtol=1e-5, atol=1e-5)
    total = zeros.index_add_(0, nearest[joins], products)
    torch.testing.assert_close(scatters, total.to(dtype), rtol=1e-5, atol=1e-5)


@dims
@both_paths
def test_a_cluster_reaches_a_box_where_its_kernel_does_along_every_axis(dim, native_path, path):
    path(native_path)
    centers, raw, _ = make_map(500, dim, torch.float64)
    raw[::3] -= 2 * torch.eye(dim)  # thin ones, some below the floor
    points = 1 + torch.rand(50, dim, generator=torch.Generator().manual_seed(0)).double()
    found = reaching(centers, raw, kernel(5), points, 2.0)
    reach = 2 * torch.linalg.vector_norm(kernel_factors(raw, kernel(5)), dim=2)
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    gap = torch.maximum(lower - centers, centers - upper)
    assert torch.equal(found, (gap <= reach).all(dim=1))
    assert 20 < found.sum() < 480
    assert reaching(centers[:0], raw[:0], kernel(5), points, 2.0).shape == (0,)


@dims
@dtypes
@both_paths
def test_features_of_an_order_are_those_of_the_ordered_points(dtype, dim, native_path, path):
    path(native_path)
    centers, raw, _ = make_map(300, dim, dtype)
    points = make_points(3000, dim, dtype)
    order = torch.randperm(3000, generator=torch.Generator().manual_seed(0))
    index = native.build_index(centers, 7)
    ours = ordered_features(points, order, centers, raw, kernel(7), index)
    theirs = native.nearest_features(points[order], centers, raw, kernel(7), index)
    rows, by_row = ours[0].sort(dim=1)  # a point's own neighbors come in any order
    assert torch.equal(rows, theirs[0])
    torch.testing.assert_close(ours[1].gather(1, by_row), theirs[1])


@pytest.mark.parametrize("order", [[0, 1, 1], [0, 1, 3], [0, 1]])
def test_an_order_that_leaves_a_point_out_is_refused(ops, order):
    centers, raw, _ = make_map(20, 3, torch.float32)
    points = make_points(3, 3, torch.float32)
    index = native.build_index(centers, 5)
    with pytest.raises(RuntimeError, match="every row of the points once"):
        ordered_features(points, torch.tensor(order), centers, raw, kernel(5), index)


@dims
@dtypes
def test_native_pooling_equals_the_plain_one(ops, dtype, dim, monkeypatch):
    rng = torch.Generator().manual_seed(0)
    known, found = (
        cluster_points(torch.rand(3000, dim, generator=rng, dtype=dtype), 100, rng)
        for _ in range(2)
    )
    size = min(len(known), len(found))
    known, found = (
        type(c)(c.counts[:size], c.means[:size], c.scatters[:size]) for c in (known, found)
    )
    raw = raw_factors(factor_covariances(known.covariances, 0.01))
    raw += 0.1 * torch.randn(raw.shape, generator=rng, dtype=dtype).tril()  # tuned
    moments = (known.counts, known.means, known.scatters)
    kinds = torch.ones(size, dtype=torch.bool)
    state = MapState(known.means[:, 0], known.means + 1, raw, kinds, *moments)
    where = torch.arange(size)
    fast = pool_into(state, where, found, 0.01)
    monkeypatch.setattr(native, "supports", lambda points: False)
    plain = pool_into(state, where, found, 0.01)
    tolerance = 1e-4 if dtype == torch.float32 else 1e-9
    for ours, theirs in zip(fast, plain, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)


def test_opcheck_accepts_the_operators_of_an_update(ops):
    centers, raw, _ = make_map(12, 3, torch.float64)
    points, order = make_points(40, 3, torch.float64), torch.arange(39, -1, -1)
    index = ops.build_index(centers, 5)
    torch.library.opcheck(ops.explain.default, (points, centers, raw, 1.0, 2.0))
    torch.library.opcheck(ops.reaching.default, (centers, raw, points, 2.0, *kernel(5)[1:]))
    given = (points, order, centers, raw, index, *kernel(5))
    torch.library.opcheck(ops.ordered_features.default, given)
    counts, scatters = torch.full((12,), 9), torch.eye(3).double().repeat(12, 1, 1)
    moments = (counts, centers, scatters)
    torch.library.opcheck(ops.pool.default, (*moments, raw, *moments, 0.01))
