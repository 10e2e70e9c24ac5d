import copy

import pytest
import torch

from lardhm_torch import FitConfig, LardHilbertMap, Samples, TuneConfig, fine_tune
from lardhm_torch.io.map_files import load_state, save_state
from lardhm_torch.learning.fine_tuning import _check, _hold_out
from lardhm_torch.scans import seeded_generator

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


def fitted(num_clusters=24, config=None):
    points, labels = bent_wall()
    return LardHilbertMap(2).fit(points, labels, num_clusters, config=config), points, labels


def log_loss(model, points, labels):
    with torch.no_grad():
        p = model(points).clamp(1e-6, 1 - 1e-6)
    return float(torch.nn.functional.binary_cross_entropy(p, labels))


def test_tuning_lowers_the_loss_on_points_it_has_not_seen():
    model, points, labels = fitted(num_clusters=8, config=FitConfig(passes=4))
    unseen = bent_wall(seed=1)
    before = log_loss(model, *unseen)
    losses = fine_tune(model, points, labels)
    assert len(losses) == 1 + TuneConfig().epochs
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


def test_the_epoch_that_predicts_held_out_rays_best_is_kept():
    model, points, labels = fitted()
    ray_id = torch.arange(len(points)) % 50
    config = TuneConfig(epochs=4, hold_out=0.3, weight_rate=3.0)  # so fast that it gets worse
    states = []
    losses = fine_tune(
        model, points, labels, ray_id=ray_id, config=config, after_epoch=states.append
    )
    best = losses.index(min(losses[1:]))
    assert 1 <= best < 4
    assert torch.equal(model.weights, states[best - 1]["best"][:, 0])


def test_held_out_rays_do_not_train_even_when_sampled_anew():
    model, points, labels = fitted()
    ray_id = torch.arange(len(points)) % 50
    liar, config = copy.deepcopy(model), TuneConfig(epochs=3, hold_out=0.3)
    samples = _check(model, points, labels, ray_id)
    held = _hold_out(samples, 0.3, seeded_generator(0, "fine_tune"))
    assert 5 < len(held) < 30
    lies = torch.where(torch.isin(ray_id, held), 1 - labels, labels)
    ends, epochs = [], []
    for tuned, told in ((model, labels), (liar, lies)):

        def resample(epoch, told=told):
            epochs.append(epoch)
            return Samples(points + 0.01 * epoch, told, ray_id, {})

        states = []
        fine_tune(
            tuned, points, told, ray_id=ray_id, resample=resample, config=config,
            after_epoch=states.append,
        )  # fmt: skip
        ends.append(states[-1]["offsets"])
    assert epochs == [1, 2, 1, 2]
    torch.testing.assert_close(*ends)


def test_tuning_stops_when_patience_is_over():
    model, points, labels = fitted()
    config = TuneConfig(epochs=50, hold_out=0.3, patience=2, weight_rate=30.0)
    losses = fine_tune(model, points, labels, config=config)
    assert len(losses) == 1 + losses.index(min(losses[1:])) + 2 < 51


@pytest.mark.parametrize("settings", [{}, {"hold_out": 0.2}, {"tune_centers": False}])
def test_an_interrupted_run_that_goes_on_equals_one_that_was_not(settings, tmp_path):
    model, points, labels = fitted()
    start, config = copy.deepcopy(model), TuneConfig(epochs=4, batch_size=500, **settings)
    losses = fine_tune(model, points, labels, config=config, seed=5)

    def interrupt(state):
        save_state(state, tmp_path / "state.pt")
        if state["epoch"] == 2:
            raise KeyboardInterrupt

    again = copy.deepcopy(start)
    with pytest.raises(KeyboardInterrupt):
        fine_tune(again, points, labels, config=config, seed=5, after_epoch=interrupt)
    assert torch.equal(again.centers, start.centers)
    state = load_state(tmp_path / "state.pt")
    assert fine_tune(again, points, labels, config=config, seed=5, state=state) == losses
    for one, other in zip(again.parameters(), model.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_finished_state_gives_the_tuned_map_at_once():
    model, points, labels = fitted()
    fresh, states = copy.deepcopy(model), []
    config = TuneConfig(epochs=1)
    fine_tune(model, points, labels, config=config, after_epoch=states.append)
    fine_tune(fresh, points, labels, config=config, state=states[-1])
    assert torch.equal(fresh.raw_scale_tril, model.raw_scale_tril)


def test_a_state_of_another_map_or_config_is_refused():
    model, points, labels = fitted()
    states, config = [], TuneConfig(epochs=1)
    fine_tune(model, points, labels, config=config, after_epoch=states.append)
    with pytest.raises(ValueError, match="state must belong to this config"):
        fine_tune(model, points, labels, state=states[0])
    other = LardHilbertMap(2).fit(points, labels, num_clusters=10)
    with pytest.raises(ValueError, match="state must be of a map with 10 clusters; got 24"):
        fine_tune(other, points, labels, config=config, state=states[0])


def test_many_points_are_tuned_in_groups(monkeypatch):
    model, points, labels = fitted(num_clusters=8, config=FitConfig(passes=4))
    apart, states = copy.deepcopy(model), []
    at_once = fine_tune(model, points, labels)
    monkeypatch.setattr("lardhm_torch.learning.fine_tuning.GROUP_ROWS", 1500)
    in_groups = fine_tune(apart, points, labels, after_epoch=states.append)
    assert states[-1]["step"] == 4 * 3 * 6  # three groups of two batches
    assert in_groups[-1] == pytest.approx(at_once[-1], rel=0.2)


def test_a_failure_leaves_the_map_as_it_was(monkeypatch):
    model, points, labels = fitted()
    before = model.centers.clone()
    monkeypatch.setattr("lardhm_torch.learning.fine_tuning.TuningRun.train", lambda *_: 1 / 0)
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
    held = TuneConfig(hold_out=0.2)
    with pytest.raises(ValueError, match="ray_id must be given"):
        fine_tune(model, points, labels, resample=lambda epoch: None, config=held)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epochs": 0}, "epochs must be 1 or more; got 0"),
        ({"passes": 0}, "passes must be 1 or more; got 0"),
        ({"batch_size": 0}, "batch_size must be 1 or more; got 0"),
        ({"weight_rate": 0.0}, "rates must be > 0"),
        ({"stiffness": -1.0}, "l2 and stiffness must be 0 or more"),
        ({"occupied_share": 1.0}, r"occupied_share must be in \(0, 1\); got 1.0"),
        ({"patience": 2}, "patience needs held-out rays; got hold_out = 0.0"),
        ({"unknown_share": -0.1}, "unknown_share must be 0 or more; got -0.1"),
        ({"hold_out": 1.0}, "hold_out must be at least 0 and below 1; got 1"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        TuneConfig(**settings)


def test_unknown_points_do_not_train_without_a_share_of_the_loss():
    model, points, labels = fitted(num_clusters=8, config=FitConfig(passes=4))
    other, rays = copy.deepcopy(model), torch.arange(len(points))
    fine_tune(model, points, labels, ray_id=rays)
    more, config = torch.cat([points, points[:50] + 0.3]), TuneConfig(unknown_share=0)
    fine_tune(
        other,
        more,
        torch.cat([labels, torch.full((50,), 0.5)]),
        ray_id=torch.cat([rays, rays[:50]]),
        config=config,
    )
    assert torch.equal(model.weights, other.weights)
    with pytest.raises(ValueError, match="all are 1/2"):
        fine_tune(model, points, torch.full_like(labels, 0.5))
