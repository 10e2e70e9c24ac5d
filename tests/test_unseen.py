"""Space that nothing was seen of: where it is found, and what a map says there."""

import pytest
import torch

from lardhm_torch import LardHilbertMap, Scans, TuneConfig, fine_tune, sample_rays
from lardhm_torch.features import neighbor_fade
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.map_state import factor_covariances, new_rows
from lardhm_torch.learning.unseen import LARGEST, draw_tails, even_kernels, off_surfaces
from lardhm_torch.native.crossings import never_crossed
from lardhm_torch.sampling import UNKNOWN, SamplingConfig

F64 = torch.float64


def facing_wall(rays: int = 3000) -> Scans:
    """A sensor 3 m in front of a wall at x = 3, seen through a cone."""
    rng = torch.Generator().manual_seed(0)
    across = 4 * torch.rand(rays, 2, generator=rng, dtype=F64) - 2
    ends = torch.cat([torch.full((rays, 1), 3.0, dtype=F64), across], dim=1)
    ends[:, 0] += 0.01 * torch.randn(rays, generator=rng, dtype=F64)
    return Scans(origins=torch.zeros(1, 3, dtype=F64), ends=ends)


def test_a_cluster_much_larger_than_its_neighbors_has_a_smaller_kernel():
    means = torch.cartesian_prod(*[torch.arange(5.0)] * 2).double()
    scatters = torch.diag_embed(torch.tensor([0.01, 0.0025], dtype=F64)).repeat(25, 1, 1)
    scatters[12] *= 100
    counts = torch.full((25,), 2)
    known = new_rows(Clusters(counts, means, scatters), torch.ones(25, dtype=torch.bool), 0.0)
    assert even_kernels(known, 0.0) is known  # nothing is said of unknown space
    counts[0] = 0  # an unknown cluster
    state = new_rows(Clusters(counts, means, scatters), counts > 0, 0.0)
    found = even_kernels(state, 0.0)
    changed = (found.raw_scale_tril != state.raw_scale_tril).any(dim=2).any(dim=1)
    assert changed.nonzero().flatten().tolist() == [12]
    assert torch.equal(found.scatters, state.scatters)
    limit = torch.diag_embed(torch.tensor([0.01 * LARGEST**2] * 2, dtype=F64))
    expected = factor_covariances(limit[None], 0.0)[0].diagonal()
    torch.testing.assert_close(found.raw_scale_tril[12].diagonal().exp(), expected)


def test_cells_that_a_ray_went_through_are_crossed_and_others_are_not():
    starts, ahead = torch.zeros(1, 2, dtype=F64), torch.tensor([[1.0, 0.0]], dtype=F64)
    points = torch.tensor([[1.05, 0.05], [1.95, 0.05], [2.15, 0.05], [1.05, 0.25]], dtype=F64)
    free = never_crossed(points, starts, ahead, torch.tensor([2.0], dtype=F64), 0.1)
    assert free.tolist() == [False, False, True, True]


def test_which_cells_are_crossed_does_not_depend_on_where_the_world_origin_is():
    rng = torch.Generator().manual_seed(1)
    starts = torch.randn(50, 3, generator=rng, dtype=F64).round(decimals=2)
    ahead = torch.nn.functional.normalize(torch.randn(50, 3, generator=rng, dtype=F64), dim=1)
    points = starts + 2.05 * ahead
    reach = torch.full((50,), 2.0, dtype=F64)
    here = never_crossed(points, starts, ahead, reach, 0.1)
    there = never_crossed(points + 1e6, starts + 1e6, ahead, reach, 0.1)
    assert (here == there).double().mean() > 0.95  # a border may fall on the other side


def test_unknown_samples_lie_behind_hits_where_no_ray_went():
    scans = facing_wall(500)
    config = SamplingConfig(behind_samples=2)
    samples = sample_rays(scans, config, seed=3)
    unknown = samples.points[samples.labels == UNKNOWN]
    hits = scans.ends[samples.ray_id[samples.labels == UNKNOWN]]
    depths = (unknown - hits).norm(dim=1)
    assert 500 < len(unknown) <= 1000
    assert (depths >= config.near_margin - 1e-9).all()
    assert (depths <= config.near_reach + 1e-9).all()
    assert (unknown.norm(dim=1) > hits.norm(dim=1)).all()


def test_a_ray_of_another_sensor_keeps_space_behind_a_wall_from_being_unknown():
    wall = facing_wall(500)
    behind = torch.stack([torch.full((200,), 3.3), torch.full((200,), 9.0), torch.zeros(200)], 1)
    behind[:, 2] = torch.linspace(-2, 2, 200)
    origins = torch.tensor([[0.0, 0, 0], [3.3, -9.0, 0]], dtype=F64)
    both = Scans(
        origins=origins,
        ends=torch.cat([wall.ends, behind.double()]),
        scan_id=torch.cat([torch.zeros(500), torch.ones(200)]).long(),
    )
    alone = sample_rays(wall, seed=0)
    seen = sample_rays(both, seed=0)
    count = int((seen.labels[seen.ray_id < 500] == UNKNOWN).sum())
    assert count < 0.97 * int((alone.labels == UNKNOWN).sum())


def test_no_unknown_samples_where_none_are_asked_for():
    samples = sample_rays(facing_wall(50), SamplingConfig(behind_samples=0))
    assert set(samples.labels.tolist()) == {0.0, 1.0}
    with pytest.raises(ValueError, match="behind_samples must be 0 or more"):
        SamplingConfig(behind_samples=-1)


def flat_cluster() -> Clusters:
    spread = torch.diag(torch.tensor([0.01, 1.0, 1.0], dtype=F64) ** 2)
    return Clusters(torch.tensor([50]), torch.zeros(1, 3, dtype=F64), 49 * spread[None])


def test_places_within_a_surface_are_not_unknown():
    points = torch.tensor([[0.0, 1, 1], [0.02, 0, 0], [0.3, 0, 0], [0.0, 9, 0]], dtype=F64)
    assert off_surfaces(points, flat_cluster(), 0.01).tolist() == [False, False, True, True]
    none = Clusters(*(moments[:0] for moments in flat_cluster()))
    assert off_surfaces(points, none, 0.01).all()


def test_tails_lie_two_to_five_standard_deviations_out():
    cluster = flat_cluster()
    rng = torch.Generator().manual_seed(0)
    tails = draw_tails(cluster, torch.tensor([True]), 3, 1e-6, rng)
    whitened = tails / torch.tensor([0.01, 1.0, 1.0], dtype=F64)
    assert ((whitened.norm(dim=1) > 1.99) & (whitened.norm(dim=1) < 5.01)).all()


def test_the_map_says_one_half_behind_a_wall_and_still_sees_the_wall():
    scans = facing_wall()
    across = torch.rand(400, 2, generator=torch.Generator().manual_seed(5), dtype=F64) * 2 - 1
    at = [torch.cat([torch.full((400, 1), x, dtype=F64), across], 1) for x in (2.0, 3.0, 3.25, 4.0)]
    samples = sample_rays(scans, seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels)
    free, wall, behind, far = (model.log_odds(points) for points in at)
    assert (free < -1).double().mean() > 0.98
    assert (wall > 1).double().mean() > 0.98
    assert (behind < -1).double().mean() < 0.02
    assert (far.abs() > 1).double().mean() < 0.02


def test_unknown_tells_never_seen_from_contradictory():
    scans = facing_wall()
    samples = sample_rays(scans, seed=0)
    ghosts = torch.tensor([1.5, 0.3, 0.0]) + 0.1 * torch.randn(
        400, 3, generator=torch.Generator().manual_seed(0)
    )
    points = torch.cat([samples.points, ghosts.double()])
    labels = torch.cat([samples.labels, (torch.arange(400) % 2).float()])
    model = LardHilbertMap().fit(points, labels)
    contradictory, never = torch.tensor([[1.5, 0.3, 0.0]]), torch.tensor([[6.0, 0.0, 0.0]])
    assert model.unknown(contradictory).item() < 0.3
    assert model.unknown(never).item() > 0.9
    assert model.unknown(never.expand(2, 5, 3)).shape == (2, 5)
    assert LardHilbertMap().unknown(never).item() == 1


def test_clusters_of_unknown_points_count_nothing():
    samples = sample_rays(facing_wall(), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels)
    known = int((samples.labels != UNKNOWN).sum())
    assert int(model.counts.sum()) == known
    assert (model.counts == 0).any()
    assert not model.is_occupied[model.counts == 0].any()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("num_neighbors", [2, 5, 16])
def test_the_probability_never_jumps(dim, num_neighbors):
    rng = torch.Generator().manual_seed(dim)
    points = 2 * torch.rand(3000, dim, generator=rng, dtype=F64)
    labels = (points[:, 0] > 1).double()
    model = LardHilbertMap(dim, num_neighbors).double().fit(points, labels, 100)
    starts = torch.rand(20, 1, dim, generator=rng, dtype=F64)
    along = torch.nn.functional.normalize(torch.randn(20, 1, dim, generator=rng, dtype=F64), dim=2)

    def steps(size: float) -> torch.Tensor:
        way = size * torch.arange(int(1e-2 / size), dtype=F64)[:, None]
        return model(starts + way * along).diff(dim=1).abs().amax()

    assert steps(1e-6) < 1e-2 * steps(1e-4) * 2  # in proportion to the step: a jump is not


def test_a_neighbor_has_faded_out_when_another_takes_its_place():
    centers = torch.tensor([[0.0], [1.0], [3.0]], dtype=F64)
    here = torch.tensor([[0.2], [1.5]], dtype=F64)
    fade = neighbor_fade(here, centers, torch.tensor([[0, 1], [0, 1]]))
    torch.testing.assert_close(fade[0], torch.tensor([1.0, 0.0], dtype=F64))
    assert fade[1].tolist() == [0, 1]
    everyone = torch.tensor([[0, 1, 2]])
    assert (neighbor_fade(here[:1], centers, everyone) == 1).all()


def test_tuning_keeps_unseen_space_unknown():
    samples = sample_rays(facing_wall(), seed=0)
    rng = torch.Generator().manual_seed(5)
    unseen = 6 * torch.rand(4000, 3, generator=rng, dtype=F64) - 3
    unseen[:, 0] += 6.3  # from 0.3 m behind the wall
    shares = []
    for share in (0.1, 0.0):
        model = LardHilbertMap().fit(samples.points, samples.labels)
        config = TuneConfig(unknown_share=share)
        fine_tune(model, samples.points, samples.labels, ray_id=samples.ray_id, config=config)
        found = model.log_odds(unseen).abs()
        assert float((found > 1).double().mean()) < 0.01
        shares.append(float((found > 0.3).double().mean()))
    assert shares[0] < 0.3 * shares[1]
