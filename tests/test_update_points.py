"""The points and the training of an update: how many new points it uses, their weights, its steps."""

from dataclasses import replace

import pytest
import torch
from small_maps import wall

from lardhm_torch import LardHilbertMap, Scans, StreamConfig, UpdateConfig
from lardhm_torch.learning import parameters, retraining
from lardhm_torch.learning.evidence import EVIDENCE, evidence_moments, keep_points, kept_counts
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.learning.retraining import (
    FEWEST,
    SMALL_LOSS,
    _first_points,
    _with_enough_steps,
    balanced,
    retrained,
)
from lardhm_torch.learning.update import UPDATE_FIT, _thinned
from lardhm_torch.native.thinning import PER_CELL
from lardhm_torch.scans import seeded_generator
from lardhm_torch.streaming import _thinned as thinned_rays


def generator():
    return torch.Generator().manual_seed(0)


def dense_scan(**columns):
    """A scan with 500 rays to one cell of 0.1 m and 300 to others, every fifth without return."""
    ends = 10 * torch.rand(800, 3, generator=generator(), dtype=torch.float64) + 5
    ends[:500] = 0.02 * ends[:500] + torch.tensor([5.0, 5.0, 5.0])
    return Scans(torch.zeros(1, 3), ends, is_return=torch.arange(800) % 5 > 0, **columns)


def test_an_update_uses_few_points_of_each_class_in_a_cell():
    points = torch.rand(900, 3, generator=generator())
    labels = torch.tensor([1.0, 0.0, 0.5]).repeat(300)
    config = UpdateConfig(cell_edge=0.5)
    kept, of_kept = _thinned(points, labels, config, generator())
    for label in (0.0, 0.5, 1.0):
        assert int((of_kept == label).sum()) == 8 * PER_CELL
    fewer, of_fewer = _thinned(
        points, labels, UpdateConfig(cell_edge=0.5, max_points=9), generator()
    )
    assert [int((of_fewer == label).sum()) for label in (1.0, 0.0, 0.5)] == [9, 9, 9]
    assert {tuple(point) for point in fewer.tolist()} <= {tuple(point) for point in kept.tolist()}


def test_a_stream_uses_few_rays_that_end_in_one_cell():
    scan = dense_scan()
    config = StreamConfig(update=UpdateConfig(cell_edge=0.5))
    part = thinned_rays(scan, config, seeded_generator(0, "thinning"))
    assert len(part) < 310 < len(scan)
    crowded = (part.ends - 5.15).abs().amax(dim=1) < 0.2
    assert (
        int((crowded & part.is_return).sum()) == int((crowded & ~part.is_return).sum()) == PER_CELL
    )
    config = StreamConfig(update=UpdateConfig(cell_edge=0.5, max_points=20))
    part = thinned_rays(scan, config, seeded_generator(0, "thinning"))
    assert int(part.is_return.sum()) == int((~part.is_return).sum()) == 20


def test_rays_with_channels_are_all_used():
    scan = dense_scan(channels={"intensity": torch.ones(800)})
    assert len(thinned_rays(scan, StreamConfig(), seeded_generator(0, "thinning"))) == 800


def test_factors_of_groups_are_those_of_their_points():
    kinds, owners = torch.tensor([0, 1, 2, 1, 0]), torch.tensor([0, 0, 1, 2, 2, 2, 3, 3, 4])
    strength = torch.tensor([1.0, 2.0, 3.0, 1.5, 2.5], dtype=torch.float64)
    sizes = torch.bincount(owners)
    groups = balanced(kinds, strength, UPDATE_FIT, sizes)[owners]
    points = balanced(kinds[owners], strength[owners], UPDATE_FIT)
    torch.testing.assert_close(groups, points)
    assert abs(float(points.mean()) - 1) < 1e-12
    shares = [float(points[kinds[owners] == kind].sum()) for kind in range(3)]
    assert abs(shares[0] / (shares[0] + shares[1]) - UPDATE_FIT.occupied_share) < 1e-12
    assert abs(shares[2] / (shares[0] + shares[1]) - UPDATE_FIT.unknown_share) < 1e-12


@pytest.mark.parametrize("num_points", [1, 30, 5_000, 40_000, 200_000])
def test_few_points_give_as_many_steps_as_needed(num_points):
    config = _with_enough_steps(UPDATE_FIT, num_points)
    batches = -(-num_points // config.rows_per_batch(num_points))
    assert config.passes * batches >= 64
    assert config.passes == 2 or config.passes * batches < 64 + batches
    assert num_points < 100_000 or config.passes == 2


def test_of_many_kept_points_every_cluster_uses_its_first_ones():
    points = torch.rand(1000, 3, generator=generator(), dtype=torch.float64)
    owners = (40 * points[:, 0] ** 2).long()
    evidence = keep_points(points, owners, 40)
    state = new_rows(evidence_moments(evidence), torch.ones(40, dtype=torch.bool), 0.02, evidence)
    kept = kept_counts(evidence)
    rows = torch.arange(39, -1, -2)
    found, _, used = _first_points(state, rows, kept, 10**6)
    total = len(found)
    assert total == int(kept[rows].sum())
    assert torch.equal(used, kept)
    found, of_found, used = _first_points(state, rows, kept, total // 2)
    assert torch.equal(used, kept.clamp(max=EVIDENCE // 2))
    assert kept.max() > EVIDENCE // 2
    for row in rows.tolist():
        assert torch.equal(found[of_found == row], evidence[row, : used[row]])
    assert torch.equal(_first_points(state, rows, kept, 1)[2], kept.clamp(max=FEWEST))


def test_clusters_that_are_predicted_well_use_few_kept_points():
    points = torch.rand(200, 3, generator=generator(), dtype=torch.float64)
    evidence = keep_points(points, torch.arange(200) % 4, 4)
    state = new_rows(evidence_moments(evidence), torch.ones(4, dtype=torch.bool), 0.02, evidence)
    state.losses[:] = torch.tensor([0.0, 0.1 * SMALL_LOSS, 0.9 * SMALL_LOSS, 1.1 * SMALL_LOSS])
    used = _first_points(state, torch.arange(4), kept_counts(evidence), 10**6)[2]
    assert used.tolist() == [50, FEWEST, FEWEST, 50]


def factors_of(state, fresh, monkeypatch):
    """Points, labels and loss factors on which an update trains if some clusters are fresh."""
    found = []
    trained = retraining.trained
    monkeypatch.setattr(
        retraining, "trained", lambda *given: found.append(given[2]) or trained(*given)
    )
    state.fresh[:] = 100.0 * fresh
    retrained(state, 10**6, LardHilbertMap().kernel, UPDATE_FIT, generator())
    return found[0]


def test_classes_are_balanced_however_many_clusters_are_trained(monkeypatch):
    state = parameters.read_state(LardHilbertMap().fit(*wall(), num_clusters=400))
    some = state.means[:, 1] < state.means[:, 1].quantile(0.2)
    some &= ~state.is_occupied | (state.means[:, 2] < state.means[:, 2].median())  # fewer hits
    points, _, factors = factors_of(state, torch.ones_like(some), monkeypatch)
    of_all = dict(zip(map(tuple, points.tolist()), factors.tolist(), strict=True))
    points, _, factors = factors_of(state, some, monkeypatch)
    assert 0 < len(points) < 0.8 * len(of_all)
    again = torch.tensor([of_all[tuple(point)] for point in points.tolist()]).to(factors)
    torch.testing.assert_close(factors, again)


def test_unknown_points_inside_surfaces_have_no_weight(monkeypatch):
    """They were sampled behind a hit of one scan at grazing incidence."""
    points, labels = wall()
    model = LardHilbertMap().fit(points, labels, num_clusters=40)
    hits = (points[labels > 0.5][::20] - model.origin).to(model.centers)
    depth = torch.tensor([0.01, 0.4])
    places = (hits + depth[:, None, None] * torch.eye(3)[0]).reshape(-1, 3)
    evidence = keep_points(places, torch.arange(2).repeat_interleave(len(hits)), 2)
    found = replace(evidence_moments(evidence), counts=torch.zeros(2, dtype=torch.long))
    unknown = new_rows(found, torch.zeros(2, dtype=torch.bool), 0.02, evidence)
    state = parameters.read_state(model)
    state = state.put(torch.empty(0, dtype=torch.long), unknown)
    points, labels, factors = factors_of(state, torch.ones_like(state.weights), monkeypatch)
    unweighted = (labels == 0.5) & (points[:, 0] < hits[:, 0].mean() + 0.2)
    assert int(unweighted.sum()) == int((labels == 0.5).sum()) / 2 > 0
    assert torch.equal(factors == 0, unweighted)
