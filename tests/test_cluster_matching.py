"""Matching and merging of clusters by Algorithm 2."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import wall, wall_map

from lardhm_torch import UpdateConfig
from lardhm_torch.learning.cluster_matching import match_clusters, merge_clusters
from lardhm_torch.learning.clustering import cluster_points
from lardhm_torch.learning.map_state import factor_covariances, new_rows

F64 = torch.float64
PAPER = UpdateConfig(as_in_paper=True)


def state_of(clusters, is_occupied):
    return new_rows(clusters, is_occupied, 0.01)


def brute_force_match(known, new, is_occupied, zeta, floor):
    """Algorithm 2, lines 2 to 13, loop by loop; of several matches the nearest."""

    def stds(offset, covariance):
        factor = factor_covariances(covariance[None], floor)[0]
        return torch.linalg.vector_norm(torch.linalg.solve(factor, offset))

    answer = []
    for n in range(len(new)):
        best, nearest = -1, float("inf")
        for c in range(len(known)):
            offset = new.means[n] - known.means[c]
            distance = float(torch.linalg.vector_norm(offset))
            inside = (
                is_occupied[n] == known.is_occupied[c]
                and distance < zeta
                and stds(offset, known.clusters.covariances[c]) < 1
                and stds(offset, new.covariances[n]) < 1
            )
            if inside and distance < nearest:
                best, nearest = c, distance
        answer.append(best)
    return torch.tensor(answer)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**31 - 1), zeta=st.sampled_from([0.05, 0.3, 5.0]))
def test_matching_by_index_is_algorithm_2_loop_by_loop(seed, zeta):
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(900, 2, generator=rng, dtype=F64)
    known = state_of(cluster_points(points, 25, rng), torch.rand(25, generator=rng) > 0.3)
    new = cluster_points(torch.rand(500, 2, generator=rng, dtype=F64), 20, rng)
    kinds = torch.rand(20, generator=rng) > 0.3
    match = match_clusters(known, new, kinds, zeta, 0.01)
    assert torch.equal(match, brute_force_match(known, new, kinds, zeta, 0.01))


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**31 - 1))
def test_merging_disjoint_sets_does_not_depend_on_their_order(seed):
    rng = torch.Generator().manual_seed(seed)
    sets = [torch.rand(100, 3, generator=rng, dtype=F64) + 10 * shift for shift in range(3)]
    parts = [cluster_points(points, 4, rng) for points in sets]
    kinds = torch.ones(len(parts[1]), dtype=torch.bool)
    start = state_of(parts[0], torch.ones(len(parts[0]), dtype=torch.bool))

    def merge(*order):
        state = start
        for number in order:
            part = parts[number]
            state = merge_clusters(state, part, kinds[:1].expand(len(part)), 1.0, 0.01)
        return state.rows(state.means[:, 0].argsort())

    for ours, theirs in zip(merge(1, 2, 1), merge(1, 1, 2), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_a_cluster_merged_with_itself_doubles_its_count_and_keeps_its_place():
    state = state_of(
        cluster_points(wall()[0], 30, torch.Generator().manual_seed(0)),
        torch.ones(30, dtype=torch.bool),
    )
    merged = merge_clusters(state, state.clusters, state.is_occupied, 1.0, 0.01)
    assert torch.equal(merged.counts, 2 * state.counts)
    torch.testing.assert_close(merged.means, state.means)
    torch.testing.assert_close(merged.scatters, 2 * state.scatters)


def test_occupied_and_free_never_merge():
    points, labels = wall()
    model = wall_map()
    occupied = int(model.counts[model.is_occupied].sum())
    model.update(points, 1 - labels, config=PAPER)  # the same place, every label reversed
    old = model.is_occupied[: len(wall_map())]
    assert torch.equal(old, wall_map().is_occupied)
    assert int(model.counts[model.is_occupied].sum()) == occupied + int((1 - labels).sum())
    assert int(model.counts[: len(old)].sum()) == int(wall_map().counts.sum())
