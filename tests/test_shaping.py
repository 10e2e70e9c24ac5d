"""Shapes of clusters that `fit` trains on a sample of the points."""

import pytest
import torch

from lardhm_torch import FitConfig, LardHilbertMap, native, sample_rays, simulate_room, split_rays
from lardhm_torch.evaluation.held_out import evaluate
from lardhm_torch.learning import scene_clusters, shaping
from lardhm_torch.learning.fitting import FitTask
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.points import training_points

F64 = torch.float64
ADAPTED = FitConfig(adapt_shapes=True)


@pytest.fixture(scope="module")
def rays():
    return split_rays(simulate_room(12_000), 0.5)


@pytest.fixture(scope="module")
def samples(rays):
    return sample_rays(rays[0])


def fitted(samples, config=ADAPTED):
    model = LardHilbertMap().fit(samples.points, samples.labels, config=config)
    return model.requires_grad_(False)


def losses(model, rays):
    scores = evaluate(model, rays)
    return scores["unif"]["log_loss"], scores["near"]["log_loss"]


@pytest.fixture(scope="module")
def adapted(samples):
    return fitted(samples)


@pytest.fixture(scope="module")
def plain(samples):
    return fitted(samples, FitConfig())


def test_held_out_rays_are_predicted_better(rays, adapted, plain):
    for ours, theirs in zip(losses(adapted, rays[1]), losses(plain, rays[1]), strict=True):
        assert ours < 0.95 * theirs


def test_shapes_change_and_moments_do_not(samples, adapted, monkeypatch):
    monkeypatch.setattr(scene_clusters, "shaped", lambda state, samples, *_: (state, samples))
    before = fitted(samples)
    assert torch.equal(adapted.means, before.means)
    assert torch.equal(adapted.evidence, before.evidence)
    moved = torch.linalg.vector_norm(adapted.centers - before.centers, dim=1)
    assert float(moved.median()) > 1e-3
    assert float(moved.max()) < 2


def test_of_many_points_those_of_the_first_batches_train_the_shapes(
    rays, samples, adapted, monkeypatch
):
    for module in ("shaping", "fitting"):
        monkeypatch.setattr(f"lardhm_torch.learning.{module}.CHUNK_ROWS", len(samples) // 2)
    chunked = fitted(samples)
    assert not torch.equal(chunked.centers, adapted.centers)
    for ours, theirs in zip(losses(chunked, rays[1]), losses(adapted, rays[1]), strict=True):
        assert abs(ours - theirs) < 0.15 * theirs


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("count", [2, 5, 300])
def test_few_points_can_be_fitted(dim, count):
    points = torch.randn(count, dim, generator=torch.Generator().manual_seed(0))
    labels = (torch.arange(count) % 2).float()
    model = LardHilbertMap(dim=dim).fit(points, labels, config=ADAPTED)
    assert bool(model(points).isfinite().all())


def test_plain_torch_gives_the_same_map(ops, samples, monkeypatch):
    few = slice(None, None, 40)
    points, labels, _ = training_points(
        samples.points[few], samples.labels[few], torch.zeros(0, 3, dtype=F64)
    )

    def fit() -> MapState:
        task = FitTask(LardHilbertMap().kernel, ADAPTED, torch.Generator().manual_seed(0))
        return scene_clusters.fit_scene(points, labels, 40, task)

    fast = fit()
    monkeypatch.setattr("lardhm_torch.native.supports", lambda *_: False)
    monkeypatch.setattr("lardhm_torch.native.descends", lambda *_: False)
    slow = fit()
    torch.testing.assert_close(fast.centers, slow.centers, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(fast.weights, slow.weights, rtol=1e-6, atol=1e-6)


def test_points_with_larger_gradients_are_drawn_more_often():
    wanted = torch.tensor(90 * [0.0] + 9 * [1.0] + [100.0], dtype=F64)
    chance = shaping.chances(wanted)
    assert float(chance.mean()) <= shaping.SHARE
    assert chance[0] > 0
    assert chance[95] > chance[0]
    assert chance[99] == 1
    assert shaping.chances(0 * wanted).tolist() == 100 * [0.0]


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_misfits_are_those_of_plain_torch(ops, monkeypatch, dtype):
    rng = torch.Generator().manual_seed(1)
    indices = torch.randint(30, (333, 16), generator=rng).int()
    values = torch.rand(333, 16, generator=rng, dtype=dtype)
    labels = (torch.arange(333) % 3 / 2).to(dtype)
    weights = torch.randn(30, generator=rng, dtype=dtype)
    fast = shaping.misfits(indices, values, labels, weights)
    monkeypatch.setattr(native, "descends", lambda *_: False)
    torch.testing.assert_close(fast, shaping.misfits(indices, values, labels, weights))
    assert 0 <= float(fast.min()) < 0.1
    assert 0.9 < float(fast.max()) <= 1


def test_opcheck_accepts_the_operators(ops):
    indices, values = torch.zeros(4, 2, dtype=torch.int32), torch.ones(4, 2)
    torch.library.opcheck(ops.errors.default, (indices, values, values[:, 0], values[0], 1, False))
    torch.library.opcheck(ops.in_cells_around.default, (values, values, 0.1))
    table = torch.zeros(3, 6)
    torch.library.opcheck(
        ops.tuned_features.default, (values, indices, table, table, table, 4.0, 0.01)
    )
