"""Points that clusters keep: the native passes against their definitions."""

import pytest
import torch
from native_maps import dims, dtypes, kernel, make_map, make_points

from lardhm_torch import native
from lardhm_torch.learning import evidence
from lardhm_torch.learning.assignment import feature_sums
from lardhm_torch.learning.evidence import EVIDENCE, keep_points
from lardhm_torch.learning.points import count_cells
from lardhm_torch.learning.retraining import _neighbors, excess_losses

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
def test_points_that_are_kept_already_and_those_that_can_be(both, dtype, dim):
    points, owners, found = kept(dim, dtype)
    cleared = torch.arange(CLUSTERS + 1) % 5 == 0
    owners[1:4] = torch.tensor([-1, CLUSTERS, 8])  # no cluster, a new one, and one without points
    fast, plain = both(evidence.kept_again, points, owners, found, cleared)
    assert all(torch.equal(a, b) for a, b in zip(fast, plain, strict=True))
    again, enters = fast
    assert again.sum() > 0
    assert enters[1:4].tolist() == [False, True, True]
    others = points + 1
    again, enters = evidence.kept_again(others, owners, found, cleared)
    assert again.sum() == 0
    assert 0 < enters.sum() < len(enters)
    after, _ = evidence.add_points(found, cleared, others, owners)
    chosen = [evidence.add_points(found, cleared, others[enters], owners[enters])[0], after]
    assert torch.equal(*chosen)


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
    assert (fast[wanted] > 0).any()
    assert not (fast[~wanted] > 0).any()
    assert feature_sums(points[:0], centers, raw, wanted, KERNEL, index).abs().sum() == 0


@dims
@dtypes
def test_points_are_added_as_if_all_had_come_at_once(both, dtype, dim):
    points, owners, found = kept(dim, dtype)
    more = torch.cat([make_points(500, dim, dtype), points[:200]])
    of_more = torch.arange(700) % (CLUSTERS + 6) - 1  # -1 and numbers that are too large: none
    cleared = torch.arange(CLUSTERS + 3) % 5 == 0
    given = (found, cleared, more, of_more)
    (fast, new), (plain, plain_new) = both(evidence.add_points, *given)
    assert torch.equal(fast, plain)
    assert torch.equal(new, plain_new)
    stays = ~cleared[owners]
    rows = torch.cat([points[stays], more])
    whole = keep_points(rows, torch.cat([owners[stays], of_more]), CLUSTERS + 3)
    assert torch.equal(fast, whole)
    again = (fast[:CLUSTERS, :, None] == found[:, None]).all(dim=3).any(dim=2)
    expected = evidence.kept_counts(fast)
    expected[:CLUSTERS] = (~again & ~fast[:CLUSTERS, :, 0].isinf()).sum(dim=1)
    assert torch.equal(new, expected)


@dims
def test_points_that_moved_with_their_map_are_sorted_again(both, dim):
    _, _, found = kept(dim, torch.float64)
    moved = torch.where(found.isinf(), found, found + 0.25)
    more, of_more = make_points(400, dim, torch.float64), torch.arange(400) % 20
    cleared = torch.zeros(CLUSTERS, dtype=torch.bool)
    (fast, _), (plain, _) = both(evidence.add_points, moved, cleared, more, of_more)
    assert torch.equal(fast, plain)
    assert torch.equal(fast[20:], moved[20:])


@dims
@dtypes
def test_halves_of_clusters(both, dtype, dim):
    _, _, found = kept(dim, dtype)
    fast, plain = both(evidence.halves, found)
    for ours, theirs in zip(fast, plain, strict=True):
        assert torch.equal(ours, theirs)
    sizes = sum(evidence.kept_counts(half) for half in fast)
    assert torch.equal(sizes, evidence.kept_counts(found))


def test_a_line_is_divided_in_the_middle():
    line = torch.stack([torch.linspace(0, 7, 8), torch.linspace(0, 14, 8)], dim=1).double()
    upper, lower = evidence.halves(keep_points(line, torch.zeros(8, dtype=torch.long), 1))
    assert sorted(lower[0, :4, 0].tolist()) == [0, 1, 2, 3]
    assert sorted(upper[0, :4, 0].tolist()) == [4, 5, 6, 7]


@dtypes
def test_losses_in_excess_of_a_perfect_prediction(ops, monkeypatch, dtype):
    rng = torch.Generator().manual_seed(2)
    indices = torch.randint(30, (500, 5), generator=rng).int()
    values = torch.rand(500, 5, generator=rng, dtype=dtype)
    labels = (torch.arange(500) % 5 / 4).to(dtype)
    weights = 9 * torch.randn(30, generator=rng, dtype=dtype)
    fast = excess_losses(indices, values, labels, weights, 3)
    monkeypatch.setattr(native, "descends", lambda *_: False)
    slow = excess_losses(indices, values, labels, weights, 3)
    torch.testing.assert_close(fast, slow)
    assert torch.equal(slow, excess_losses(indices, values, labels, weights)[::3])
    assert bool((fast > -1e-6).all())
    assert fast.max() > 1


def test_opcheck_accepts_the_operators_of_kept_points(ops):
    points, owners, found = kept(3, torch.float64, 50)
    cleared = torch.arange(CLUSTERS) % 2 == 0
    torch.library.opcheck(ops.add_points.default, (found, cleared, points, owners.int()))
    torch.library.opcheck(ops.halves.default, (found,))
    index = native.build_index(points, 3)
    torch.library.opcheck(ops.neighbors_of.default, (points[:5], points, 3, index))
    indices, values = torch.zeros(4, 2, dtype=torch.int32), torch.ones(4, 2)
    torch.library.opcheck(ops.errors.default, (indices, values, values[:, 0], values[0], 2, True))


def test_losses_reject_clusters_that_do_not_exist(ops):
    indices, values = torch.zeros(300, 2, dtype=torch.int32), torch.ones(300, 2)
    indices[299, 1] = 7
    given = (values[:, 0], torch.zeros(7))
    assert len(excess_losses(indices, values, *given, 2)) == 150  # that row is not used
    for wrong in (7, -1):
        indices[299, 1] = wrong
        with pytest.raises(RuntimeError, match="index out of range"):
            excess_losses(indices, values, *given)


@dims
@dtypes
def test_neighbors_of_some_clusters(both, dtype, dim):
    centers = make_map(900, dim, dtype)[0]
    mask = torch.arange(900) % 90 == 4
    index = native.build_index(centers, 8)
    fast, plain = both(_neighbors, mask, centers, 8, index)
    assert torch.equal(fast, plain)
    assert 10 <= int(fast.sum()) <= 80
    assert int(_neighbors(mask & ~mask, centers, 8, index).sum()) == 0


@dims
@dtypes
def test_cells_with_points(both, dtype, dim):
    points = make_points(2000, dim, dtype)
    fast, plain = both(count_cells, points, 0.25)
    assert fast == plain == len((points / 0.25).floor().unique(dim=0))
    assert count_cells(points[:0], 0.25) == 0
