"""What a map remembers of earlier scans, and what it forgets because new ones contradict it."""

from dataclasses import replace

import pytest
import torch
from small_maps import wall, wall_map

from lardhm_torch import (
    LardHilbertMap,
    UpdateConfig,
    native,
)
from lardhm_torch.learning import parameters
from lardhm_torch.learning.clustering import Clusters, cluster_points
from lardhm_torch.learning.evidence import EVIDENCE, evidence_moments, keep_points, kept_counts
from lardhm_torch.learning.forgetting import (
    AGAIN,
    DOUBT,
    GONE,
    OVERRULED,
    doubted,
    forget,
    trust,
)
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.learning.regrouping import Rule, _divide

F64 = torch.float64
PAPER = UpdateConfig(as_in_paper=True)


def test_what_is_said_elsewhere_changes_nothing_here():
    model = wall_map()
    points = wall(seed=4)[0]
    before = model(points).detach()
    model.update(*wall(at=30.0), num_clusters=40)
    torch.testing.assert_close(model(points).detach(), before, atol=1e-6, rtol=0)


def test_new_points_beside_old_ones_do_not_destroy_what_was_known():
    """The left half of a wall is seen again and again; the right half must not fade."""
    model, (points, labels) = wall_map(), wall(seed=4)
    right = points[:, 1] > 1.3
    before = ((model(points) > 0.5) == (labels > 0.5))[right].double().mean()
    for seed in range(10):
        more, of_more = wall(seed=10 + seed)
        model.update(more[more[:, 1] < 1.0], of_more[more[:, 1] < 1.0], seed=seed)
    after = ((model(points) > 0.5) == (labels > 0.5))[right].double().mean()
    assert after > before - 0.03


def test_an_obstacle_that_rays_pass_through_fades_within_a_few_scans():
    model = LardHilbertMap().fit(*wall(seed=0), num_clusters=40)
    for seed in range(5):  # well known
        model.update(*wall(seed=seed + 1), seed=seed)
    beyond, labels = wall(seed=20, at=3.0)
    rng = torch.Generator().manual_seed(0)
    there = wall(seed=30)[0][:600]
    assert (model(there) > 0.5).double().mean() > 0.95
    scans = 0
    while (model(there) > 0.5).double().mean() > 0.05:
        assert scans < 10
        open_space = torch.rand(6000, 3, generator=rng, dtype=F64) * 2
        points = torch.cat([beyond[:600], open_space])
        model.update(points, torch.cat([labels[:600], torch.zeros(6000)]), seed=scans)
        scans += 1
    assert scans >= 1
    assert (model(beyond[:600]) > 0.5).double().mean() > 0.9


def test_trust_in_a_contradicted_cluster_falls_and_returns_with_a_hit():
    part = known_wall()
    doubts = torch.tensor([0.0, DOUBT, 2 * DOUBT])
    assert torch.equal(trust(doubts), torch.tensor([1.0, 1.0, 2.0**-8]))
    doubted_part = replace(part, doubts=torch.full_like(part.doubts, 2 * DOUBT))
    after = forget(doubted_part, part.doubts)
    assert torch.equal(after.evidence, part.evidence)
    again_trained = AGAIN * kept_counts(part.evidence).to(after.fresh)
    assert torch.equal(after.fresh, again_trained)
    again = forget(replace(after, doubts=part.doubts, fresh=part.fresh), after.doubts)
    assert torch.equal(again.fresh, again_trained)
    assert torch.equal(forget(part, part.doubts).fresh, part.fresh)


def test_clusters_that_stay_in_doubt_and_overruled_unknown_ones_lose_their_points():
    part = known_wall()
    gone = replace(part, doubts=torch.where(torch.arange(len(part)) == 0, GONE + 1, 0.0))
    after = forget(gone, gone.doubts)
    assert (kept_counts(after.evidence) == 0).tolist() == [True] + [False] * (len(part) - 1)
    unknown = replace(
        part,
        is_occupied=torch.zeros_like(part.is_occupied),
        counts=torch.zeros_like(part.counts),
        losses=torch.where(torch.arange(len(part)) == 1, 2 * OVERRULED, 0.0),
    )
    left = kept_counts(forget(unknown, unknown.doubts).evidence)
    assert (left == 0).tolist() == [n == 1 for n in range(len(part))]


def known_wall():
    points = wall()[0][:600]
    clusters = cluster_points(points, 4, torch.Generator().manual_seed(0))
    owners = torch.cdist(points, clusters.means).argmin(dim=1)
    evidence = keep_points(points, owners, len(clusters))
    return new_rows(clusters, torch.ones(len(clusters), dtype=torch.bool), 0.01, evidence)


def test_halves_of_a_cluster_in_doubt_are_in_doubt():
    part = replace(known_wall(), doubts=torch.full((4,), 2.0))
    rule = Rule(occupied=8, grows=True, few=False, split_loss=0.01, floor=0.01)
    groups = _divide(part, torch.ones(4), rule, exchange=True)
    assert groups.changed.sum() == 8
    assert torch.equal(groups.state.doubts, torch.full((8,), 2.0))


def test_clusters_have_the_covariances_of_their_kept_points_however_often_they_were_seen():
    model = LardHilbertMap().fit(*wall(), num_clusters=40)
    for seed in range(1, 31):
        model.update(*wall(5 * seed), seed=seed, config=UpdateConfig(split_loss=1e9))
    found = parameters.read_state(model).clusters
    kept = evidence_moments(model.evidence)
    assert found.counts.max() > 3 * EVIDENCE
    follows = (found.means - kept.means).abs().amax(
        dim=1
    ) < 1e-5  # its points changed since the fit
    assert follows.sum() > 30
    ours, theirs = found.covariances[follows], kept.covariances[follows]
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-6)


def test_only_occupied_clusters_that_rays_pass_and_none_hits_are_contradicted():
    points = wall()[0]
    rng = torch.Generator().manual_seed(0)
    clusters = cluster_points(points[:600], 8, rng)
    known = new_rows(clusters, torch.arange(len(clusters)) % 2 > 0, 0.01)
    kernel = LardHilbertMap().kernel
    hits, free = wall(seed=1, at=9.0)[0][:600], wall(seed=2)[0][:600]
    both, labels = torch.cat([hits, free]), torch.tensor([1.0, 0.0]).repeat_interleave(600)
    passed = known
    for _ in range(4):
        passed = forgetting_state(passed, both, labels, kernel)
    assert torch.equal(trust(passed.doubts) < 1, known.is_occupied)
    hit_again = forgetting_state(passed, free, torch.ones(600), kernel)
    assert (trust(hit_again.doubts) == 1).all()
    nothing_there = forgetting_state(known, hits, torch.zeros(600), kernel)
    assert (trust(nothing_there.doubts) == 1).all()


def test_scans_with_rays_through_a_cluster_count_until_it_is_hit():
    known, kernel = known_wall(), LardHilbertMap().kernel
    index = native.build_index(known.centers, kernel.num_neighbors)
    free = known.centers + torch.tensor([9.0, 0, 0], dtype=F64)
    passed = torch.tensor([1, 1, 3])
    doubts = doubted(known, free, torch.zeros(4), kernel, index, passed)
    once = 3 * DOUBT / (4 + known.counts.double()).log2()
    torch.testing.assert_close(doubts, once * torch.tensor([0.0, 1, 0, 1], dtype=F64))
    known = replace(known, doubts=doubts)
    hit = doubted(known, known.means[1:2], torch.ones(1), kernel, index, passed)
    assert hit[1] == 0
    torch.testing.assert_close(hit[3], 2 * once[3])


@pytest.mark.parametrize("dim", [2, 3])
def test_clusters_are_contradicted_only_together_with_most_around_them(dim):
    """What hides single clusters shows them again; a removed obstacle is passed everywhere."""
    along = torch.arange(10.0, dtype=F64) - 4.5
    patch = torch.cartesian_prod(along, along) if dim == 3 else along[:, None]
    centers = 0.1 * torch.nn.functional.pad(patch, (1, 0))
    centers = torch.cat([centers, torch.full((1, dim), 7.0, dtype=F64)])  # one stands alone
    scatter = 49 * torch.diag(torch.tensor([1e-4] + [8.3e-4] * (dim - 1), dtype=F64))
    clusters = Clusters(
        torch.full((len(centers),), 50), centers, scatter.expand(len(centers), dim, dim)
    )
    known = new_rows(clusters, torch.ones(len(centers), dtype=torch.bool), 0.01)
    kernel = LardHilbertMap(dim=dim).kernel
    index = native.build_index(known.centers, kernel.num_neighbors)
    nothing = (centers[:1] + 50, torch.zeros(1), kernel, index)

    def after_scans(passed):
        state = known
        for _ in range(20):
            state = replace(state, doubts=doubted(state, *nothing, passed))
        return trust(state.doubts) < 1

    everything = torch.arange(len(centers))
    assert after_scans(everything).all()
    middle, border = centers[:-1].norm(dim=1).argmin(), centers[:-1].norm(dim=1).argmax()
    assert not after_scans(torch.stack([middle, border])).any()
    half = (centers[:-1, 1] > 0).nonzero().squeeze(1)
    gone = after_scans(half)
    assert gone[half][centers[half, 1] > 0.1].all()
    assert gone.sum() <= len(half)
    assert after_scans(everything[-1:]).sum() == 1


def test_many_free_points_of_one_scan_count_as_one_scan():
    known, kernel = known_wall(), LardHilbertMap().kernel
    index = native.build_index(known.centers, kernel.num_neighbors)
    free = known.means.repeat_interleave(20, dim=0)
    doubts = doubted(known, free, torch.zeros(len(free)), kernel, index)
    once = 3 * DOUBT / (4 + known.counts.double()).log2()
    torch.testing.assert_close(doubts, once)


def forgetting_state(known, points, labels, kernel):
    index = native.build_index(known.centers, kernel.num_neighbors)
    return replace(known, doubts=doubted(known, points, labels, kernel, index))
