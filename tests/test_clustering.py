import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import MiniBatchKMeans

from lardhm_torch import native
from lardhm_torch.features import nearest_centers, squared_distances
from lardhm_torch.learning.clustering import (
    Clusters,
    choose_num_clusters,
    cluster_classes,
    cluster_points,
    clusters_from_moments,
    group_classes,
    merge_small,
    pool_clusters,
    split_clusters,
)
from lardhm_torch.learning.kmeans import mini_batch_kmeans
from lardhm_torch.learning.map_state import factor_covariances
from lardhm_torch.learning.points import morton_order

F64 = torch.float64


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def blobs(count=20, each=100, dim=3, seed=0):
    centers = torch.rand(count, dim, generator=rng(seed), dtype=F64) * 10
    noise = torch.randn(count, each, dim, generator=rng(seed), dtype=F64) * 0.2
    return (centers[:, None] + noise).reshape(-1, dim)


def inertia(points, centers):
    nearest = nearest_centers(points, centers, 1).squeeze(1)
    return float(squared_distances(points, centers[nearest]).sum())


def cluster_moments(points, labels, num_clusters):
    """Count, mean and scatter of the points of each label, one label after the other."""
    members = [points[labels == m] for m in range(num_clusters)]
    means = torch.stack([m.sum(dim=0) / max(1, len(m)) for m in members])
    apart = [m - mean for m, mean in zip(members, means, strict=True)]
    counts = torch.tensor([len(m) for m in members])
    return Clusters(counts, means, torch.stack([offsets.T @ offsets for offsets in apart]))


@pytest.mark.parametrize("dim", [1, 3])
def test_moments_equal_numpy_cluster_by_cluster(dim):
    points = torch.randn(300, dim, generator=rng(), dtype=F64) + 50
    centers = points[:7] + 0.1
    labels, *moments = native.assign(points, centers)
    clusters = clusters_from_moments(centers, *moments)
    for m in range(7):
        members = points[labels == m].numpy()
        assert clusters.counts[m] == len(members)
        np.testing.assert_allclose(clusters.means[m], members.mean(axis=0))
        expected = np.cov(members.T) if len(members) > 1 else 0.0
        np.testing.assert_allclose(clusters.covariances[m].squeeze(), expected, atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**31 - 1), dim=st.integers(1, 5), groups=st.integers(1, 9))
def test_pooling_equals_the_moments_of_the_union(seed, dim, groups):
    points = torch.randn(200, dim, generator=rng(seed), dtype=F64) + 100
    labels = torch.randint(10, (200,), generator=rng(seed))
    group_of = torch.randint(groups, (10,), generator=rng(seed))
    pooled = pool_clusters(cluster_moments(points, labels, 10), group_of, groups)
    union = cluster_moments(points, group_of[labels], groups)
    assert torch.equal(pooled.counts, union.counts)
    filled = union.counts > 0
    torch.testing.assert_close(pooled.means[filled], union.means[filled])
    torch.testing.assert_close(
        pooled.scatters[filled], union.scatters[filled], atol=1e-9, rtol=1e-9
    )


def test_every_point_belongs_to_one_cluster_and_none_is_small():
    points = blobs()
    clusters = cluster_points(points, 60, rng())
    assert clusters.counts.sum() == len(points)
    assert clusters.counts.min() >= 5
    assert 30 <= len(clusters) <= 60


def test_small_clusters_join_their_nearest_neighbor():
    points = torch.tensor([[0.0]] * 5 + [[1.0]] * 2 + [[10.0]] * 6, dtype=F64)
    labels = torch.tensor([0] * 5 + [1] * 2 + [3] * 6)
    merged, groups = merge_small(cluster_moments(points, labels, 4))
    assert groups.tolist() == [0, 0, 0, 1]  # the empty one, too, has a place
    assert merged.counts.tolist() == [7, 6]
    torch.testing.assert_close(merged.means[0], points[:7].mean(dim=0))


def test_each_class_has_its_clusters_and_they_own_its_points():
    points, g = blobs(), rng()
    labels = torch.rand(len(points), generator=g).mul(3).floor() / 2
    found = group_classes(points, labels.to(points), 60, g)
    first = 0
    for members, owners, number in zip(found.classes, found.owners, found.numbers, strict=True):
        means = torch.zeros(number, 3, dtype=points.dtype).index_add_(0, owners.long(), members)
        sizes = torch.bincount(owners, minlength=number)
        own = slice(first, first := first + number)
        torch.testing.assert_close(means / sizes[:, None], found.clusters.means[own])
    assert first == len(found.clusters)


def test_where_all_clusters_are_small_one_remains():
    merged, _ = merge_small(cluster_moments(torch.randn(3, 2), torch.arange(3), 3))
    assert merged.counts.tolist() == [3]


@pytest.mark.parametrize("seed", range(3))
def test_inertia_is_no_worse_than_scikit_learns(seed):
    points = torch.rand(8000, 3, generator=rng(seed)) ** 2  # uneven density
    points = points[morton_order(points)]
    ours = inertia(points, mini_batch_kmeans(points, 100, rng(seed)))
    theirs = MiniBatchKMeans(100, random_state=seed, n_init=3).fit(points.numpy())
    assert ours <= 1.02 * inertia(points, torch.tensor(theirs.cluster_centers_))


def test_the_same_seed_gives_the_same_centers():
    points = blobs()
    first, again = (mini_batch_kmeans(points, 30, rng(5)) for _ in range(2))
    assert torch.equal(first, again)


def test_clusters_move_with_the_points():
    points, shift = blobs(), 2.0**12  # exact in float64: the same random choices
    here = cluster_points(points, 30, rng())
    there = cluster_points(points + shift, 30, rng())
    torch.testing.assert_close(there.means - shift, here.means, atol=1e-8, rtol=0)
    torch.testing.assert_close(there.scatters, here.scatters, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "points",
    [
        torch.zeros(1, 3, dtype=F64),
        torch.ones(100, 3, dtype=F64),
        torch.linspace(0, 9, 100, dtype=F64)[:, None] * torch.tensor([1.0, 0, 0]),
        torch.rand(100, 3, dtype=F64) * torch.tensor([1.0, 1.0, 0.0]),
        (torch.rand(100, 3) * torch.tensor([1e3, 1e3, 1e-6])).float(),
    ],
    ids=["one point", "all equal", "a line", "a plane", "a wide thin plane in float32"],
)
def test_degenerate_clusters_get_a_valid_factor(points):
    clusters = cluster_points(points, 4, rng())
    factors = factor_covariances(clusters.covariances, 0.01)
    assert factors.isfinite().all()
    assert (factors.diagonal(dim1=-2, dim2=-1) >= 0.01 * (1 - 1e-6)).all()


def test_factors_reproduce_the_covariance_plus_floor():
    covariances = cluster_points(blobs(), 10, rng()).covariances
    factors = factor_covariances(covariances, 0.05)
    expected = covariances + 0.05**2 * torch.eye(3, dtype=F64)
    torch.testing.assert_close(factors @ factors.mT, expected, atol=1e-5, rtol=1e-5)


def test_classes_are_clustered_apart_occupied_first():
    points = blobs()
    labels = (points[:, 0] > 5).double()
    clusters, is_occupied = cluster_classes(points, labels, 40, rng())
    assert torch.equal(is_occupied, clusters.means[:, 0] > 5)
    assert is_occupied.long().diff().max() <= 0
    assert clusters.counts[is_occupied].sum() == labels.sum()


@pytest.mark.parametrize(
    ("sizes", "asked", "given_out"),
    [
        ([1000, 1000], 101, [51, 50]),
        ([1000, 20], 100, [80, 20]),
        ([20, 1000], 100, [20, 80]),
        ([1000, 0], 100, [100, 0]),
        ([3, 3], 500, [3, 3]),
    ],
)
def test_clusters_are_split_over_the_classes(sizes, asked, given_out):
    assert split_clusters(sizes, asked) == given_out


@pytest.mark.parametrize(
    ("points_a_cell", "points_a_cluster"), [(1, 15), (3, 15), (6, 24), (20, 35)]
)
def test_clusters_are_as_fine_as_space_unless_starved_or_crowded(points_a_cell, points_a_cluster):
    line = (torch.arange(2000, dtype=F64) + 0.5)[:, None] * torch.tensor([0.2, 0.0, 0.0], dtype=F64)
    points = line.repeat(points_a_cell, 1) - 100.0
    assert choose_num_clusters(points) == pytest.approx(len(points) / points_a_cluster, abs=1)
    assert choose_num_clusters(points[:3]) == 3  # in three cells
    assert choose_num_clusters(points[:3] / 100 + 0.05) == 1
    assert choose_num_clusters(torch.rand(200_000, 3, generator=rng()) * 1e3) == 5000
