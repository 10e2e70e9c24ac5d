"""What an update asks of many points and clusters: the native pass against its definition."""

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points, true_distances

from lardhm_torch import native
from lardhm_torch.features import kernel_factors, raw_factors
from lardhm_torch.learning.assignment import (
    explain,
    inside_candidates,
    kernels_near,
    ordered_features,
    unexplained,
)
from lardhm_torch.learning.cluster_matching import pool_into
from lardhm_torch.learning.clustering import Clusters, cluster_points
from lardhm_torch.learning.map_state import MapState, factor_covariances
from lardhm_torch.points import in_morton_order

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
    lower = raw.tril(-1) + torch.diag_embed(raw.diagonal(dim1=1, dim2=2).exp())
    centers[7] = 100  # nobody joins it
    sizes = torch.arange(5, 45)
    clusters = Clusters(sizes, centers, lower @ lower.mT * (sizes - 1)[:, None, None])
    factors = factor_covariances(clusters.covariances, 0.01)
    points = make_points(4000, dim, dtype)
    owners, found = explain(points, clusters, 0.01, 1.5, 3.0)
    nearest = true_distances(points, centers).argmin(dim=1)
    offsets = (points - centers[nearest]).double()
    solved = torch.linalg.solve_triangular(
        factors[nearest].double(), offsets[:, :, None], upper=False
    )
    distance = torch.linalg.vector_norm(solved, dim=(1, 2))
    assert 100 < (distance > 3).sum() < 3900
    assert torch.equal(owners.long(), torch.where(distance <= 3, nearest, 40))
    joins = distance <= 1.5
    assert torch.equal(found.counts, nearest[joins].bincount(minlength=40))
    assert found.counts[7] == 0
    for row in range(40):
        own = points[joins & (nearest == row)].double()
        mean = own.mean(dim=0) if len(own) else centers[row].double()
        torch.testing.assert_close(found.means[row], mean.to(dtype), rtol=1e-5, atol=1e-5)
        scatter = (own - mean).T @ (own - mean)
        torch.testing.assert_close(found.scatters[row], scatter.to(dtype), rtol=1e-5, atol=1e-5)


@dims
@dtypes
@both_paths
@pytest.mark.parametrize("count", [0, 1, 40_000])
def test_points_that_no_kept_cluster_owns_stay_in_order(dtype, dim, native_path, count, path):
    path(native_path)
    points = torch.arange(float(count * dim), dtype=dtype).reshape(count, dim)
    rng = torch.Generator().manual_seed(0)
    owners = torch.randint(11, (count,), generator=rng, dtype=torch.int32)  # 10 is nobody
    kept = torch.tensor([True, False] * 5)
    rest = unexplained(points, owners, kept)
    assert torch.equal(rest, points[(owners % 2 == 1) | (owners == 10)])


@dims
@dtypes
@both_paths
def test_all_points_inside_a_cluster_are_possibly_inside(dtype, dim, native_path, path):
    path(native_path)
    rng = torch.Generator().manual_seed(0)
    sources = torch.rand(400, dim, generator=rng, dtype=dtype) * torch.arange(1, dim + 1)
    clusters = cluster_points(in_morton_order(sources)[0], 20, rng)
    points = 8 * torch.rand(20_000, dim, generator=rng, dtype=dtype) - 4
    inside = explain(points, clusters, 0.01, 3.0, 3.0)[0] < len(clusters)
    possible = inside_candidates(points, clusters, 0.01, 3.0)
    assert torch.equal(points[inside], possible[torch.isin(possible[:, 0], points[inside, 0])])
    assert 50 < inside.sum() <= len(possible)
    if native_path:
        assert len(possible) < 8 * inside.sum()
    moments = (clusters.counts, clusters.means, clusters.scatters)
    assert len(inside_candidates(points, Clusters(*(t[:0] for t in moments)), 0.01, 3.0)) == 0
    assert len(inside_candidates(points[:0], clusters, 0.01, 3.0)) == 0


def test_owners_of_other_points_are_refused(ops):
    points, kept = torch.zeros(5, 3), torch.ones(2, dtype=torch.bool)
    with pytest.raises(RuntimeError, match="one a point"):
        unexplained(points, torch.zeros(4, dtype=torch.int32), kept)


def test_a_covariance_that_is_none_is_refused(ops):
    clusters = Clusters(torch.tensor([9]), torch.zeros(1, 3), -torch.eye(3)[None])
    with pytest.raises(RuntimeError, match="not positive definite"):
        explain(torch.zeros(5, 3), clusters, 0.01, 1.0, 2.0)


@dims
@both_paths
def test_a_cluster_reaches_a_box_where_its_kernel_does_along_every_axis(dim, native_path, path):
    path(native_path)
    centers, raw, _ = make_map(500, dim, torch.float64)
    raw[::3] -= 2 * torch.eye(dim)  # thin ones, some below the floor
    points = 1 + torch.rand(50, dim, generator=torch.Generator().manual_seed(0)).double()
    found = kernels_near(centers, raw, kernel(5), points, 2.0)
    reach = 2 * torch.linalg.vector_norm(kernel_factors(raw, kernel(5)), dim=2)
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    gap = torch.maximum(lower - centers, centers - upper)
    assert torch.equal(found, (gap <= reach).all(dim=1))
    assert 20 < found.sum() < 480
    assert kernels_near(centers[:0], raw[:0], kernel(5), points, 2.0).shape == (0,)


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
    counts, scatters = torch.full((12,), 9), torch.eye(3).double().repeat(12, 1, 1)
    moments = (counts, centers, scatters)
    torch.library.opcheck(ops.explain.default, (points, *moments, 0.01, 1.0, 2.0))
    owners, kept = torch.arange(40, dtype=torch.int32) % 13, counts < 0
    torch.library.opcheck(ops.possibly_inside.default, (points, *moments, 0.01, 1.0))
    torch.library.opcheck(ops.unexplained.default, (points, owners, kept))
    torch.library.opcheck(ops.reaching.default, (centers, raw, points, 2.0, *kernel(5)[1:]))
    given = (points, order, centers, raw, index, *kernel(5))
    torch.library.opcheck(ops.ordered_features.default, given)
    torch.library.opcheck(ops.pool.default, (*moments, raw, *moments, 0.01))
