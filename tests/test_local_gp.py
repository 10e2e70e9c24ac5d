import pytest
import torch
from test_gaussian_process import wall

from lardhm_torch.evaluation.baselines import local_gp
from lardhm_torch.evaluation.baselines.gaussian_process import (
    condition,
    predict,
    squared_exponential,
)
from lardhm_torch.evaluation.baselines.local_gp import LocalGP

F64 = torch.float64


def test_one_cluster_is_one_exact_process():
    points, labels = wall(40)
    model = LocalGP(points_per_cluster=1000, dtype=F64).fit(points, labels)
    unseen, scale = wall(10, seed=1)[0], model.fitted.scale
    targets, present = 2 * labels.double()[None] - 1, torch.ones(1, 80, dtype=torch.bool)
    exact = condition(points[None], targets, present, squared_exponential, scale)
    expected = predict(exact, unseen[None], squared_exponential, scale)
    for ours, theirs in zip(model.predict(unseen), expected, strict=True):
        torch.testing.assert_close(ours, theirs[0])


def test_the_nearest_processes_are_blended_by_inverse_variance():
    points, labels = wall(100)
    model = LocalGP(50, num_neighbors=2, dtype=F64).fit(points, labels)
    query = torch.tensor([[0.9, 0.5, 0.5]], dtype=F64)
    local = query - model.fitted.origin
    nearest = (model.fitted.means - local).norm(dim=1).argsort()[:2]
    parts = [
        predict(
            type(p)(*(t[None] for t in p)), local[None], squared_exponential, model.fitted.scale
        )
        for p in (model.fitted.posteriors[i] for i in nearest.tolist())
    ]
    means = torch.stack([mean[0, 0] for mean, _ in parts])
    inverses = torch.stack([1 / variance[0, 0] for _, variance in parts])
    mean, variance = model.predict(query)
    torch.testing.assert_close(mean[0], (means * inverses).sum() / inverses.sum())
    torch.testing.assert_close(variance[0], 2 / inverses.sum())


def test_it_maps_a_wall_and_knows_nothing_far_away():
    model = LocalGP(50).fit(*wall())
    unseen, truth = wall(seed=1)
    assert ((model(unseen) > 0.5) == (truth > 0.5)).double().mean() > 0.97
    far = torch.tensor([[50.0, 50.0, 50.0]])
    torch.testing.assert_close(model(far), torch.tensor([0.5]))
    torch.testing.assert_close(model.variance(far)[0], model.fitted.scale.signal)
    assert model.variance(unseen).median() < 0.3 * model.variance(far)


def test_far_from_zero_the_answers_are_the_same():
    points, labels = wall(60)
    shift = torch.tensor([5e5, 4e6, 100.0], dtype=F64)
    here = LocalGP(20, dtype=F64).fit(points, labels)(points)
    there = LocalGP(20, dtype=F64).fit(points + shift, labels)(points + shift)
    torch.testing.assert_close(there, here, atol=1e-5, rtol=1e-5)


def test_batches_do_not_change_the_answer(monkeypatch):
    points, labels = wall(60)
    together = LocalGP(20, dtype=F64).fit(points, labels)(points)
    monkeypatch.setattr(local_gp, "BATCH_ENTRIES", 1)
    torch.testing.assert_close(LocalGP(20, dtype=F64).fit(points, labels)(points), together)


def test_a_large_cluster_keeps_a_random_subset(monkeypatch):
    monkeypatch.setattr(local_gp, "MAX_POINTS", 16)
    model = LocalGP(1000).fit(*wall(100))
    assert len(model.fitted.posteriors) == 1
    assert len(model.fitted.posteriors[0].points) == 16


@pytest.mark.parametrize("count", [1, 2, 7])
def test_few_points_are_enough(count):
    points, labels = wall(10)
    answer = LocalGP(2).fit(points[:count], labels[:count])(points)
    assert bool(((answer >= 0) & (answer <= 1)).all())


def test_no_queries_give_no_answers():
    assert LocalGP(20).fit(*wall(30))(torch.zeros(0, 3)).shape == (0,)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="num_neighbors must be 1 or more; got 0"):
        LocalGP(num_neighbors=0)
    with pytest.raises(RuntimeError, match="call fit"):
        LocalGP().variance(torch.zeros(1, 3))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\); got \(3,\)"):
        LocalGP(20).fit(*wall(30))(torch.zeros(3))
    with pytest.raises(ValueError, match="points must hold at least one point"):
        LocalGP().fit(torch.zeros(0, 3), torch.zeros(0))
