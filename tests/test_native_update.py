"""What an update asks of many points and clusters: the native pass against its definition."""

from dataclasses import replace

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points, true_distances

from lardhm_torch import native
from lardhm_torch.features import kernel_factors, raw_factors
from lardhm_torch.learning.assignment import kernels_near, nearest_clusters, ordered_features
from lardhm_torch.learning.cluster_matching import pool_into
from lardhm_torch.learning.clustering import Clusters, cluster_points
from lardhm_torch.learning.evidence import keep_points
from lardhm_torch.learning.map_state import factor_covariances, new_rows

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
def test_the_owner_of_a_point_is_the_nearest_cluster_within_the_radius(
    dtype, dim, native_path, path
):
    path(native_path)
    centers, raw, _ = make_map(40, dim, dtype)
    lower = raw.tril(-1) + torch.diag_embed(raw.diagonal(dim1=1, dim2=2).exp())
    sizes = torch.arange(5, 45)
    clusters = Clusters(sizes, centers, lower @ lower.mT * (sizes - 1)[:, None, None])
    factors = factor_covariances(clusters.covariances, 0.01)
    points = make_points(4000, dim, dtype)
    owners = nearest_clusters(points, clusters, 0.01, 3.0)
    nearest = true_distances(points, centers).argmin(dim=1)
    offsets = (points - centers[nearest]).double()[:, :, None]
    solved = torch.linalg.solve_triangular(factors[nearest].double(), offsets, upper=False)
    distance = torch.linalg.vector_norm(solved, dim=(1, 2))
    assert 100 < (distance > 3).sum() < 3900
    assert torch.equal(owners, torch.where(distance <= 3, nearest, -1))


@dims
@dtypes
def test_native_evidence_equals_the_plain_one(ops, dtype, dim, monkeypatch):
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(6000, dim, generator=rng, dtype=dtype)
    points = torch.cat([points, points[:500]])  # repeated
    owners = torch.randint(-1, 42, (6500,), generator=rng)  # 40 and 41 are no clusters
    owners[(owners > 5) & (owners < 20)] = 3  # a crowded cluster, and empty ones
    fast = keep_points(points, owners, 40)
    monkeypatch.setattr(native, "supports", lambda points: False)
    assert torch.equal(fast, keep_points(points, owners, 40))
    assert torch.equal(keep_points(points[:0], owners[:0], 3), fast[:3].fill_(torch.inf))


def test_owners_of_other_points_are_refused(ops):
    with pytest.raises(RuntimeError, match="one per point"):
        keep_points(torch.zeros(5, 3), torch.zeros(4, dtype=torch.int32), 2)


def test_a_covariance_that_is_none_is_refused(ops):
    clusters = Clusters(torch.tensor([9]), torch.zeros(1, 3), -torch.eye(3)[None])
    with pytest.raises(RuntimeError, match="not positive definite"):
        nearest_clusters(torch.zeros(5, 3), clusters, 0.01, 2.0)


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
    kinds = torch.ones(size, dtype=torch.bool)
    state = replace(new_rows(known, kinds, 0.01), centers=known.means + 1, raw_scale_tril=raw)
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
    torch.library.opcheck(ops.nearest_clusters.default, (points, *moments, 0.01, 2.0))
    owners = torch.arange(40, dtype=torch.int32) % 13
    torch.library.opcheck(ops.keep_points.default, (points, owners, 12, 32))
    torch.library.opcheck(ops.reaching.default, (centers, raw, points, 2.0, *kernel(5)[1:]))
    given = (points, order, centers, raw, index, *kernel(5))
    torch.library.opcheck(ops.ordered_features.default, given)
    torch.library.opcheck(ops.pool.default, (*moments, raw, *moments, 0.01))
