"""Which clusters an update divides, and which it dissolves to make room for them."""

import torch

from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.evidence import EVIDENCE, evidence_moments, keep_points, keeps_points
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.learning.regrouping import (
    LARGE,
    SMALL,
    Groups,
    Rule,
    _kept,
    _worth_dividing,
    regrouped,
)

LOSS = 0.01  # above it, clusters are divided


def patches(edges, rng):
    """Occupied clusters of as many points each, squares of these edges 10 m apart."""
    points = torch.rand(len(edges), EVIDENCE, 3, generator=rng, dtype=torch.float64)
    points *= torch.tensor(edges, dtype=points.dtype)[:, None, None]
    points[..., 2] = 0.0
    points[..., 0] += 10 * torch.arange(len(edges))[:, None]
    owners = torch.arange(len(edges)).repeat_interleave(EVIDENCE)
    evidence = keep_points(points.reshape(-1, 3), owners, len(edges))
    found = evidence_moments(evidence)
    clusters = Clusters(found.counts, found.means, found.scatters)
    return new_rows(clusters, torch.ones(len(edges), dtype=torch.bool), 0.02, evidence)


def test_small_clusters_are_not_divided_and_make_room_for_large_ones():
    inertia = torch.tensor([0.5 * SMALL, 0.9 * SMALL, 1.0, 2.0, LARGE + 2, LARGE + 1, 0.5])
    inertia = torch.cat([inertia, torch.full((5,), 1e-9)])
    inertia *= 1 / inertia.mean()
    losses = torch.full_like(inertia, 2 * LOSS)
    assert _worth_dividing(losses, inertia, 10, LOSS).tolist() == [4, 5, 3, 2, 6]
    assert _worth_dividing(losses, inertia, 3, LOSS).tolist() == [4, 5, 3]
    assert _worth_dividing(losses, inertia, 1, LOSS).tolist() == [4, 5]  # 5 in exchange
    assert _worth_dividing(losses, inertia, -6, LOSS).tolist() == [4]  # 7 small ones, 6 too many
    assert _worth_dividing(losses, inertia, -7, LOSS).tolist() == []
    losses[4] = 0.5 * LOSS
    assert _worth_dividing(losses, inertia, 10, LOSS).tolist() == [5, 3, 2, 6]
    assert _worth_dividing(losses[:0], inertia[:0], 10, LOSS).tolist() == []


def test_small_clusters_are_dissolved_while_there_are_too_many():
    state = patches([1.0] * 6 + [0.3, 0.25], torch.Generator().manual_seed(0))
    sizes = torch.full_like(state.counts, EVIDENCE)
    groups = Groups(state, state.evidence, sizes, state.kinds, torch.zeros_like(state.is_occupied))
    for limit, alive in ((8, [6, 7]), (7, [6]), (6, []), (5, [])):
        kept = _kept(groups, torch.zeros_like(sizes), 8, Rule(limit, True, False, LOSS, 0.02))
        assert kept[:6].all() or limit < 6
        assert (kept[6:].nonzero().squeeze(1) + 6).tolist() == alive


def test_a_map_at_its_limit_takes_clusters_to_where_they_are_needed():
    """Clusters of one wall are much smaller than those of another, which are predicted worse."""
    rng = torch.Generator().manual_seed(0)
    state = patches([0.5] * 12 + [4.0] * 4, rng)
    state.losses[12:] = 2 * LOSS
    none, rule = (torch.empty(0, 3, dtype=torch.float64),) * 3, Rule(16, True, False, LOSS, 0.02)
    state = regrouped(state, none, rule, rng)
    state = state.rows(keeps_points(state.evidence))
    assert len(state) == 16
    assert int((state.means[:, 0] > 115).sum()) == 8  # of 4
