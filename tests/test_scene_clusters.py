"""The number of clusters that a scene needs, and the training of their shapes."""

import pytest
import torch

from lardhm_torch import LardHilbertMap
from lardhm_torch.features import Kernel
from lardhm_torch.learning import scene_clusters
from lardhm_torch.learning.fitting import FitConfig, FitTask, fit_clusters
from lardhm_torch.learning.points import in_morton_order
from lardhm_torch.learning.scene_clusters import (
    class_totals,
    fit_scene,
    fit_shapes,
    known_loss,
    needed_clusters,
)
from lardhm_torch.learning.sized_maps import SMALL

KERNEL = Kernel(16, 2.5, 0.01)


def task(seed=0, shape_passes=4):
    return FitTask(
        KERNEL, FitConfig(shape_passes=shape_passes), torch.Generator().manual_seed(seed)
    )


def striped(stripes, count=20_000, seed=0):
    """A cube [m] of so many occupied and as many free layers, in Morton order."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=rng)
    return in_morton_order(points, (points[:, 0] * 2 * stripes % 2 >= 1).float())


def test_a_scene_of_more_detail_gets_more_clusters():
    few, many = (needed_clusters(*striped(stripes), task()) for stripes in (1, 4))
    assert 2 * few < many


def test_noise_aside_twice_as_many_points_of_a_scene_do_not_need_twice_as_many_clusters():
    few, many = (needed_clusters(*striped(2, count), task()) for count in (20_000, 40_000))
    assert many < 1.8 * few


def ball(count=20_000, seed=0):
    """A part of a ball in a cube [m], in Morton order."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return in_morton_order(points, (points.square().sum(dim=1) < 1).float())


def test_trained_shapes_have_a_smaller_loss_than_the_same_clusters_without():
    points, labels = ball()
    held_out = ball(seed=1)
    plain = fit_clusters(points, labels, class_totals(labels, 27), task())
    shaped = fit_shapes(points, labels, 27, task())
    assert len(shaped) == len(plain)
    assert known_loss(shaped, *held_out, task()) < 0.7 * known_loss(plain, *held_out, task())


def test_the_moments_stay_those_of_the_points():
    points, labels = striped(2)
    state = fit_shapes(points, labels, 60, task())
    assert int(state.counts.sum()) == len(points)
    torch.testing.assert_close(
        (state.means * state.counts[:, None]).sum(dim=0) / len(points), points.mean(dim=0)
    )
    assert float((state.centers - state.means).abs().max()) > 1e-3


@pytest.mark.parametrize(
    ("settings", "num_clusters", "count"), [({}, 40, 20_000), ({"shape_passes": 0}, None, 20_000),
                                            ({}, None, 5_000)]
)  # fmt: skip
def test_otherwise_the_map_is_that_of_fit_clusters(settings, num_clusters, count):
    points, labels = striped(2, count)
    ours = fit_scene(points, labels, num_clusters, task(**settings))
    theirs = fit_clusters(points, labels, num_clusters, task(**settings))
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


def test_points_of_one_class_are_clustered_as_before():
    points, _ = striped(1)
    labels = torch.ones(len(points))
    assert len(fit_scene(points, labels, None, task())) == len(
        fit_clusters(points, labels, None, task())
    )


def test_most_clusters_are_occupied_ones_and_none_has_too_few_points():
    labels = torch.tensor(900 * [1.0] + 900 * [0.0] + 900 * [0.5])
    assert class_totals(labels, 90) == [50, 30, 10]
    assert class_totals(labels[:1800], 80) == [50, 30, 0]
    assert class_totals(labels[870:1800], 80) == [2, 30, 0]  # 15 points each


def test_chunks_of_points_are_trained_one_after_the_other(monkeypatch):
    points, labels = striped(2)
    whole = fit_shapes(points, labels, 60, task())
    monkeypatch.setattr(scene_clusters, "CHUNK_ROWS", 7_000)
    parts = fit_shapes(points, labels, 60, task())
    losses = [known_loss(state, points, labels, task()) for state in (whole, parts)]
    assert losses[1] == pytest.approx(losses[0], rel=0.3)
    assert not torch.equal(whole.centers, parts.centers)


def test_the_same_seed_gives_the_same_map():
    points, labels = striped(2)
    one, other = (LardHilbertMap().fit(points, labels, seed=3, config=SMALL) for _ in range(2))
    assert torch.equal(one.weights, other.weights)
    assert torch.equal(one.raw_scale_tril, other.raw_scale_tril)


def test_a_2d_map_learns_its_number_of_clusters_too():
    points, labels = striped(2)
    model = LardHilbertMap(dim=2).fit(points[:, :2], labels, config=SMALL)
    right = (model(points[:, :2]) > 0.5) == (labels > 0.5)
    assert float(right.double().mean()) > 0.97
