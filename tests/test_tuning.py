import copy

import pytest
import torch

from lardhm_torch import LardHilbertMap, TuneConfig, fine_tune

F64 = torch.float64


def bent_wall(count=2000, seed=0):
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(2 * count, 2, generator=rng, dtype=F64) * 2
    wall = 1 + 0.3 * torch.sin(3 * points[:, 1])
    points[:count, 0] = wall[:count] + 0.01 * torch.randn(count, generator=rng, dtype=F64)
    points[count:, 0] = wall[count:] - 0.1 - 0.8 * points[count:, 0] / 2
    labels = torch.zeros(2 * count)
    labels[:count] = 1
    return points, labels


def fitted():
    points, labels = bent_wall()
    return LardHilbertMap(2).fit(points, labels, num_clusters=24), points, labels


def log_loss(model, points, labels):
    with torch.no_grad():
        p = model(points).clamp(1e-6, 1 - 1e-6)
    return float(torch.nn.functional.binary_cross_entropy(p, labels))


def test_tuning_lowers_the_loss_on_points_it_has_not_seen():
    model, points, labels = fitted()
    unseen = bent_wall(seed=1)
    before = log_loss(model, *unseen)
    losses = fine_tune(model, points, labels)
    assert len(losses) == 9
    assert losses[-1] < losses[0]
    assert log_loss(model, *unseen) < 0.7 * before


@pytest.mark.parametrize("frozen", ["weights", "centers", "scales"])
def test_each_kind_of_parameter_can_be_frozen(frozen):
    model, points, labels = fitted()
    before = copy.deepcopy(model)
    fine_tune(model, points, labels, config=TuneConfig(epochs=1, **{f"tune_{frozen}": False}))
    names = {"weights": "weights", "centers": "centers", "scales": "raw_scale_tril"}
    for kind, name in names.items():
        same = torch.equal(getattr(model, name), getattr(before, name))
        assert same == (kind == frozen)


def test_moments_and_flags_stay_and_the_seed_decides():
    model, points, labels = fitted()
    before, again = copy.deepcopy(model), copy.deepcopy(model)
    config = TuneConfig(epochs=1)
    fine_tune(model, points, labels, config=config, seed=3)
    fine_tune(again, points, labels, config=config, seed=3)
    assert torch.equal(model.means, before.means)
    assert torch.equal(model.counts, before.counts)
    assert [p.requires_grad for p in model.parameters()] == [True, False, False]
    torch.testing.assert_close(model.weights, again.weights)


def test_factors_stay_valid_at_absurd_rates():
    model, points, labels = fitted()
    fine_tune(model, points, labels, config=TuneConfig(epochs=1, scale_rate=50.0))
    assert model.scale_tril.isfinite().all()
    assert (model.scale_tril.diagonal(dim1=-2, dim2=-1) > 0).all()


def test_held_out_rays_do_not_train_and_choose_the_epoch():
    model, points, labels = fitted()
    ray_id = torch.arange(len(points)) % 50
    config = TuneConfig(epochs=3, hold_out=0.3)
    losses = fine_tune(model, points, labels, ray_id=ray_id, config=config)
    assert len(losses) == 4


def test_a_failure_leaves_the_map_as_it_was(monkeypatch):
    model, points, labels = fitted()
    before = model.centers.clone()
    monkeypatch.setattr("lardhm_torch.tuning._Tunable.epochs", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fine_tune(model, points, labels)
    assert torch.equal(model.centers, before)


def test_what_cannot_be_tuned_is_refused():
    model, points, labels = fitted()
    with pytest.raises(ValueError, match="must be fitted before it is tuned"):
        fine_tune(LardHilbertMap(2), points, labels)
    nothing = TuneConfig(tune_weights=False, tune_centers=False, tune_scales=False)
    with pytest.raises(ValueError, match="it freezes all"):
        fine_tune(model, points, labels, config=nothing)
    with pytest.raises(ValueError, match=r"ray_id must be \(4000,\)"):
        fine_tune(model, points, labels, ray_id=torch.zeros(3))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs must be 1 or more; got 0"),
        ({"batch_size": 0}, "batch_size must be 1 or more; got 0"),
        ({"weight_rate": 0.0}, "rates must be > 0"),
        ({"hold_out": 1.0}, "hold_out must be at least 0 and below 1; got 1"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        TuneConfig(**settings)
