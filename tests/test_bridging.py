"""Gaps in surfaces: where kernels are stretched, and what a map says there."""

import pytest
import torch

from lardhm_torch import FitConfig, LardHilbertMap, Scans, raycast, sample_rays
from lardhm_torch.features import Kernel
from lardhm_torch.learning.bridging import (
    EDGE,
    REACH,
    bridged,
    close_points,
    find_gaps,
    find_plates,
)
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.sampling import UNKNOWN

F64 = torch.float64
FLOOR = 0.01
KERNEL = Kernel(8, 4.0, FLOOR)


def rings(radii: torch.Tensor, height: float = 1.7, count: int = 1500, seed: int = 0) -> Scans:
    """A sensor at (0, 0, height) whose rays hit the floor z = 0 in rings."""
    rng = torch.Generator().manual_seed(seed)
    angle = 2 * torch.pi * torch.rand(len(radii), count, generator=rng, dtype=F64)
    ends = torch.stack([radii[:, None] * angle.cos(), radii[:, None] * angle.sin(), 0 * angle], -1)
    ends[..., 2] = 0.005 * torch.randn(angle.shape, generator=rng, dtype=F64)
    origin = torch.tensor([[0.0, 0.0, height]], dtype=F64)
    return Scans(origins=origin, ends=ends.reshape(-1, 3))


def strips(apart: float, dim: int = 3, length: float = 2.0):
    """Clusters along two parallel lines on z = 0 (in 2-D: y = 0), and hits between x = 0 and `apart`."""
    along = torch.arange(0, length, 0.2, dtype=F64) if dim == 3 else torch.zeros(1, dtype=F64)
    centers = torch.zeros(2 * len(along), dim, dtype=F64)
    centers[len(along) :, 0] = apart
    if dim == 3:
        centers[:, 1] = along.repeat(2)
    sizes = torch.full((dim,), 0.06, dtype=F64)
    sizes[-1] = 0.004
    covariances = torch.diag(sizes.square()).expand(len(centers), -1, -1)
    counts = torch.full((len(centers),), 20)
    return Clusters(counts, centers, 19 * covariances)


def bridge(clusters: Clusters, free: torch.Tensor, unknown: bool = True, label: float = 0.0):
    """Outcome of `bridged` for occupied clusters and points with a label."""
    state = new_rows(clusters, torch.ones(len(clusters), dtype=torch.bool), FLOOR)
    points = torch.cat([free, torch.full((1, free.shape[1]), 50.0, dtype=F64)])
    labels = torch.full((len(points),), label, dtype=F64)
    labels[-1] = UNKNOWN if unknown else 0.0
    rng = torch.Generator().manual_seed(0)
    return state, len(points), *bridged(state, points, labels, KERNEL, rng)


def test_clusters_in_one_plane_reach_each_other():
    apart = 0.8
    before, known, after, points, labels = bridge(strips(apart), torch.zeros(0, 3, dtype=F64))
    factors = after.raw_scale_tril.tril(-1) + torch.diag_embed(
        after.raw_scale_tril.diagonal(dim1=1, dim2=2).exp()
    )
    covariances = factors @ factors.mT
    torch.testing.assert_close(
        covariances[:, 0, 0].sqrt(), torch.full((20,), REACH * apart, dtype=F64), rtol=1e-3, atol=0
    )
    assert (covariances[:, 2, 2].sqrt() < 0.02).all()
    added = points[known:]
    assert len(added) > 100
    assert (labels[known:] == 1).all()
    assert (added[:, 2].abs() < 0.06).all()
    assert (((added[:, 0] > 0.05) & (added[:, 0] < apart - 0.05)).double().mean()) > 0.9
    for name in ("counts", "means", "scatters", "centers", "weights"):
        assert getattr(after, name) is getattr(before, name)


def test_clusters_that_touch_or_lie_in_other_planes_have_no_gaps():
    dense = strips(0.15)
    dense = Clusters(dense.counts, dense.means, dense.scatters)
    plates = find_plates(new_rows(dense, torch.ones(20, dtype=torch.bool), FLOOR), FLOOR)
    assert plates.is_flat.all()
    assert len(find_gaps(plates).first) == 0
    step = strips(0.8)
    step.means[10:, 2] = 0.3
    plates = find_plates(new_rows(step, torch.ones(20, dtype=torch.bool), FLOOR), FLOOR)
    assert len(find_gaps(plates).first) == 0


def test_a_gap_begins_at_the_edges_of_its_clusters():
    plates = find_plates(new_rows(strips(0.8), torch.ones(20, dtype=torch.bool), FLOOR), FLOOR)
    gaps = find_gaps(plates)
    assert len(gaps.first) == 20
    torch.testing.assert_close(gaps.lengths, torch.full((20,), 0.8, dtype=F64))
    extent = (0.06**2 + FLOOR**2) ** 0.5
    torch.testing.assert_close(gaps.empty, torch.full((20,), 0.8 - 2 * EDGE * extent, dtype=F64))


@pytest.mark.parametrize("label", [0.0, UNKNOWN])
def test_a_free_or_unknown_point_in_the_plane_keeps_a_gap_open_and_one_in_front_does_not(label):
    inside = torch.tensor([[0.4, 1.0, 0.0]], dtype=F64)
    in_front = torch.tensor([[0.4, 1.0, 0.15]], dtype=F64)
    sizes = [len(bridge(strips(0.8), free, label=label)[3]) for free in (inside, in_front)]
    points = bridge(strips(0.8), inside, label=label)[3][2:]
    assert sizes[0] < sizes[1]
    beside = (points[:, 1] - 1.0).abs() < 0.1
    across = (points[:, 0] - 0.4).abs() < 0.2
    assert (beside & across).sum() <= 2


def test_samples_without_unknown_ones_stay_as_they_are():
    before, known, after, points, _ = bridge(strips(0.8), torch.zeros(0, 3, dtype=F64), False)
    assert after is before
    assert len(points) == known


def test_gaps_in_a_line_of_a_two_dimensional_map_are_bridged():
    means = torch.zeros(6, 2, dtype=F64)
    means[:, 0] = torch.tensor([0.0, 0.2, 0.4, 1.2, 1.4, 1.6])
    covariances = torch.diag(torch.tensor([0.06, 0.004], dtype=F64).square()).expand(6, -1, -1)
    clusters = Clusters(torch.full((6,), 20), means, 19 * covariances)
    _, known, _, points, _ = bridge(clusters, torch.zeros(0, 2, dtype=F64))
    added = points[known:]
    assert len(added) > 5
    assert ((added[:, 0] > 0.3) & (added[:, 0] < 1.3)).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_the_floor_between_the_rings_of_a_lidar_ends_rays(seed):
    radii = torch.tensor([2.0, 2.5, 3.0, 3.5, 4.0], dtype=F64)
    samples = sample_rays(rings(radii, seed=seed), seed=seed)
    between = rings(radii[:-1] + 0.25, count=50, seed=seed + 10)
    found = []
    for bridge_gaps in (False, True):
        config = FitConfig(bridge_gaps=bridge_gaps)
        model = LardHilbertMap().fit(samples.points, samples.labels, seed=seed, config=config)
        got = raycast(model, between.origins[0], between.ends - between.origins[0], 8.0)
        found.append(float(((got - between.ranges).abs() < 0.2).double().mean()))
    assert found[0] < 0.2
    assert found[1] > 0.8


def test_no_point_near_a_place_is_left_out_before_the_search():
    rng = torch.Generator().manual_seed(4)
    points = 20 * torch.rand(20_000, 3, generator=rng) - 10
    places, radius = points[:50] + 0.1, 0.3
    found = close_points(points, places, radius)
    near = torch.cdist(points, places).amin(dim=1) < radius
    assert near.any()
    assert len(found) < 5000
    assert bool((found[:, None] == points[near]).all(dim=2).any(dim=0).all())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_close_points_are_those_of_plain_torch(ops, monkeypatch, dim, dtype):
    rng = torch.Generator().manual_seed(5)
    points = (20 * torch.rand(5000, dim, generator=rng) - 10).to(dtype)
    fast = close_points(points, points[:40] + 0.1, 0.3)
    monkeypatch.setattr("lardhm_torch.native.supports", lambda *_: False)
    assert torch.equal(fast, close_points(points, points[:40] + 0.1, 0.3))
    assert 0 < len(fast) < len(points)
