"""Points that clusters keep: the native passes against their definitions."""

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points

from lardhm_torch import native
from lardhm_torch.learning import evidence
from lardhm_torch.learning.assignment import feature_sums
from lardhm_torch.learning.evidence import EVIDENCE, keep_points
from lardhm_torch.learning.points import count_cells

CLUSTERS = 40
KERNEL = kernel(8)


@pytest.fixture
def both(ops, monkeypatch):
    """The results of a function by the native library and in plain torch."""

    def call(function, *given):
        fast = function(*given)
        with monkeypatch.context() as context:
            context.setattr(native, "supports", lambda *_: False)
            return fast, function(*given)

    return call


def kept(dim, dtype, count=3000):
    """Points, owners, and evidence: cluster 7 keeps one point and cluster 8 none."""
    rng = torch.Generator().manual_seed(1)
    points = torch.randn(count, dim, generator=rng, dtype=dtype)
    owners = torch.randint(CLUSTERS, (count,), generator=rng)
    owners[(owners == 7) | (owners == 8)] = 9
    owners[0] = 7
    return points, owners, keep_points(points, owners, CLUSTERS)


@dims
@dtypes
def test_kept_points_and_their_number(both, dtype, dim):
    _, owners, found = kept(dim, dtype)
    counts, plain = both(evidence.kept_counts, found)
    assert torch.equal(counts, plain)
    assert torch.equal(counts, owners.bincount(minlength=CLUSTERS).clamp(max=EVIDENCE))
    for rows in (None, torch.tensor([8, 3, 7, 3])):
        fast, slow = both(evidence.kept_points, found, rows)
        assert all(torch.equal(a, b) for a, b in zip(fast, slow, strict=True))


@dims
@dtypes
def test_points_that_are_kept_already_are_counted(both, dtype, dim):
    points, owners, found = kept(dim, dtype)
    again, plain = both(evidence.kept_again, points, owners, found)
    assert torch.equal(again, plain)
    assert torch.equal(again, evidence.kept_counts(found))
    assert evidence.kept_again(points + 1, owners, found).sum() == 0


@dims
@dtypes
def test_moments_of_kept_points(both, dtype, dim):
    found = kept(dim, dtype)[2]
    rows = evidence.kept_counts(found) > 0
    fast, plain = both(evidence.evidence_moments, found[rows])
    assert torch.equal(fast.counts, plain.counts)
    torch.testing.assert_close(fast.means, plain.means)
    torch.testing.assert_close(fast.scatters, plain.scatters, rtol=1e-5, atol=1e-4)


@dims
@dtypes
def test_clusters_that_follow_their_points(ops, dtype, dim):
    found = kept(dim, dtype)[2][:7]
    centers, raw, _ = make_map(7, dim, dtype)
    lower = raw.tril(-1) + torch.diag_embed(raw.diagonal(dim1=1, dim2=2).exp())
    given = (found, torch.arange(60, 67), centers, centers + 0.1, 50 * lower @ lower.mT, raw)
    given = (*given, torch.arange(7) < 4, 0.01)
    for fast, plain in zip(ops.follow_kept(*given), evidence.follow_kept(*given), strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-4)


@dims
@dtypes
def test_sums_of_features(both, dtype, dim):
    centers, raw, _ = make_map(300, dim, dtype)
    points = make_points(2000, dim, dtype)
    index = native.build_index(centers, KERNEL.num_neighbors)
    wanted = torch.arange(300) % 3 > 0
    fast, plain = both(feature_sums, points, centers, raw, wanted, KERNEL, index)
    torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-4)
    assert (fast[wanted] > 0).any() and not (fast[~wanted] > 0).any()
    assert feature_sums(points[:0], centers, raw, wanted, KERNEL, index).abs().sum() == 0


@dims
@dtypes
def test_cells_with_points(both, dtype, dim):
    points = make_points(2000, dim, dtype)
    fast, plain = both(count_cells, points, 0.25)
    assert fast == plain == len((points / 0.25).floor().unique(dim=0))
    assert count_cells(points[:0], 0.25) == 0
