import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import MultivariateNormal

from lardhm_torch import features
from lardhm_torch.features import feature_matrix, lard_kernel, nearest_centers, nearest_features

F64 = torch.float64


def random_clusters(count, dim=3, seed=0, dtype=F64):
    rng = torch.Generator().manual_seed(seed)
    centers = torch.randn(count, dim, generator=rng, dtype=dtype)
    lower = torch.randn(count, dim, dim, generator=rng, dtype=dtype).tril(-1) * 0.3
    diagonal = torch.rand(count, dim, generator=rng, dtype=dtype) + 0.2
    return centers, lower + torch.diag_embed(diagonal)


def brute_force(points, centers, k):
    distances = (points[:, None].double() - centers[None].double()).square().sum(-1)
    return distances.sort(dim=1, stable=True).indices[:, :k].sort(dim=1).values


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**31 - 1),
    count=st.integers(1, 120),
    k=st.integers(1, 12),
    dim=st.integers(1, 5),
)
def test_neighbors_equal_brute_force(seed, count, k, dim):
    rng = torch.Generator().manual_seed(seed)
    centers = torch.randn(count, dim, generator=rng, dtype=F64)
    points = torch.randn(50, dim, generator=rng, dtype=F64) * 2
    found = nearest_centers(points, centers, k)
    assert torch.equal(found, brute_force(points, centers, min(k, count)))


@pytest.mark.parametrize("count", [10, 300])
def test_ties_go_to_the_lower_index(count):
    half = torch.randn(count // 2, 3, dtype=F64).round(decimals=1)
    centers = torch.cat([half, half])
    points = torch.randn(64, 3, dtype=F64).round(decimals=1)
    assert torch.equal(nearest_centers(points, centers, 5), brute_force(points, centers, 5))


def test_all_centers_equal_is_one_big_tie():
    found = nearest_centers(torch.randn(7, 3), torch.ones(200, 3), 4)
    assert torch.equal(found, torch.arange(4).repeat(7, 1))


def test_the_exhaustive_search_in_chunks_equals_the_tree(monkeypatch):
    centers, points = torch.randn(500, 3, dtype=F64), torch.randn(400, 3, dtype=F64)
    tree = nearest_centers(points, centers, 6)
    monkeypatch.setattr(features, "KDTREE_MIN_CENTERS", 10**9)
    monkeypatch.setattr(features, "CHUNK_ENTRIES", 7 * 500)
    assert torch.equal(nearest_centers(points, centers, 6), tree)


def test_features_are_density_ratios_of_gaussians():
    centers, scale_tril = random_clusters(6)
    points = torch.randn(20, 3, dtype=F64)
    indices = torch.arange(6).repeat(20, 1)
    gaussians = MultivariateNormal(centers, scale_tril=scale_tril)
    ratio = (gaussians.log_prob(points[:, None]) - gaussians.log_prob(centers)).exp()
    torch.testing.assert_close(lard_kernel(points, centers, scale_tril, indices), ratio)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**31 - 1), shift=st.floats(-50, 50), dim=st.integers(2, 5))
def test_features_ignore_how_the_world_is_moved_and_turned(seed, shift, dim):
    centers, scale_tril = random_clusters(8, dim, seed)
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(20, dim, generator=rng, dtype=F64)
    rotation = torch.linalg.qr(torch.randn(dim, dim, generator=rng, dtype=F64)).Q
    covariances = rotation @ scale_tril @ scale_tril.mT @ rotation.mT
    here = nearest_features(points, centers, scale_tril, 3)
    turned = torch.linalg.cholesky(covariances)
    there = nearest_features(points @ rotation.mT + shift, centers @ rotation.mT + shift, turned, 3)
    torch.testing.assert_close(there[1], here[1], rtol=1e-6, atol=1e-9)


def test_feature_matrix_is_sparse_coalesced_and_multiplies():
    centers, scale_tril = random_clusters(40)
    points = torch.randn(30, 3, dtype=F64)
    indices, values = nearest_features(points, centers, scale_tril, 5)
    matrix = feature_matrix(indices, values, 40)
    assert matrix.is_coalesced()
    assert matrix._nnz() == 30 * 5
    unsorted = torch.sparse_coo_tensor(
        matrix.indices(), matrix.values(), matrix.shape, check_invariants=True
    )
    assert not unsorted.is_coalesced()  # so that `coalesce` sorts and adds up, and proves the flag
    assert torch.equal(unsorted.coalesce().indices(), matrix.indices())
    assert torch.equal(unsorted.coalesce().values(), matrix.values())
    weights = torch.randn(40, 1, dtype=F64)
    product = torch.sparse.mm(matrix, weights).squeeze(1)
    torch.testing.assert_close(product, (values * weights[indices, 0]).sum(dim=1))


def test_kernel_gradients_are_right():
    centers, scale_tril = random_clusters(4)
    points = torch.randn(3, 3, dtype=F64)
    indices = torch.tensor([[0, 1], [1, 3], [2, 3]])
    inputs = [t.requires_grad_() for t in (points, centers, scale_tril)]
    assert torch.autograd.gradcheck(lambda *t: lard_kernel(*t, indices), inputs)


def test_a_query_in_chunks_equals_one_in_a_piece(monkeypatch):
    centers, scale_tril = random_clusters(20)
    weights, points = torch.randn(20, dtype=F64), torch.randn(100, 3, dtype=F64)
    whole = features.log_odds(points, centers, scale_tril, weights, 5)
    monkeypatch.setattr(features, "QUERY_CHUNK", 7)
    assert torch.equal(features.log_odds(points, centers, scale_tril, weights, 5), whole)


def test_nan_and_infinite_points_answer_nan_and_leave_others_alone():
    centers, scale_tril = random_clusters(100)
    weights = torch.randn(100, dtype=F64)
    points = torch.randn(6, 3, dtype=F64)
    clean = features.log_odds(points, centers, scale_tril, weights, 5)
    points[1, 0], points[4, 2] = float("nan"), float("inf")
    answer = features.log_odds(points, centers, scale_tril, weights, 5)
    assert answer.isnan().tolist() == [False, True, False, False, True, False]
    assert torch.equal(answer[[0, 2, 3, 5]], clean[[0, 2, 3, 5]])


def test_no_points_and_no_centers_are_fine():
    assert nearest_centers(torch.zeros(0, 3), torch.zeros(5, 3), 2).shape == (0, 2)
    assert nearest_centers(torch.zeros(4, 3), torch.zeros(0, 3), 2).shape == (4, 0)


def test_the_search_survives_compile_and_opcheck():
    points, centers = torch.randn(20, 3), torch.randn(10, 3)
    torch.library.opcheck(torch.ops.lardhm.plain_nearest, (points, centers, 3))
