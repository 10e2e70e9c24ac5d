import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import same_map, wall, wall_map

from lardhm_torch import (
    LardHilbertMap,
    UpdateConfig,
    load_scans,
    resize_optimizer,
    sample_rays,
    simulate_room,
    split_rays,
)
from lardhm_torch.learning import parameters
from lardhm_torch.learning.evidence import EVIDENCE, evidence_moments, keep_points, kept_counts

F64 = torch.float64
PAPER = UpdateConfig(as_in_paper=True)


# --- laws ---


@pytest.mark.parametrize("config", [None, PAPER], ids=["default", "as in the paper"])
def test_an_update_of_an_empty_map_is_a_fit(config):
    updated = LardHilbertMap().update(*wall(), num_clusters=40, seed=3, config=config)
    assert same_map(updated, LardHilbertMap().fit(*wall(), num_clusters=40, seed=3))


@pytest.mark.parametrize("model", [LardHilbertMap(), wall_map()], ids=["empty", "fitted"])
def test_an_update_with_no_points_is_the_identity(model):
    before = copy.deepcopy(model)
    assert model.update(torch.zeros(0, 3), torch.zeros(0)) is model
    assert same_map(model, before)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), parts=st.integers(1, 5))
def test_evidence_does_not_depend_on_order_parts_or_repetitions(seed, parts):
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(400, 3, generator=rng)
    owners = torch.randint(6, (400,), generator=rng)
    whole = keep_points(points, owners, 6)
    kept, of_kept = points[:0], owners[:0]
    for rows in torch.randperm(400, generator=rng).chunk(parts):
        more = torch.cat([rows, rows[:30]])
        found = keep_points(torch.cat([kept, points[more]]), torch.cat([of_kept, owners[more]]), 6)
        inside = found[:, :, 0].isfinite()
        kept, of_kept = found[inside], inside.nonzero()[:, 0]
    assert torch.equal(found, whole)
    assert torch.equal(kept_counts(whole), owners.bincount(minlength=6).clamp(max=EVIDENCE))


def test_clusters_are_those_of_points_that_were_seen():
    model, seen = LardHilbertMap().double(), []
    for seed in range(4):
        points, labels = wall(seed=seed)
        seen.append(points)
        model.update(points, labels, seed=seed)
    kept = (model.evidence[model.evidence.isfinite().all(dim=2)] + model.origin).float()
    everything = torch.cat(seen).float()
    assert torch.isin(kept[:, 1], everything[:, 1]).all()
    moments = evidence_moments(model.evidence)
    torch.testing.assert_close(model.means, moments.means)
    changed = model.counts > 1
    covariances = model.scatters / (model.counts - 1).clamp(min=1)[:, None, None]
    torch.testing.assert_close(covariances[changed], moments.covariances[changed])


# --- a map that is used while it grows ---


def test_what_a_tuned_cluster_learned_stays():
    tuned, plain = wall_map(), wall_map()
    rng = torch.Generator().manual_seed(0)
    with torch.no_grad():
        tuned.centers += 0.05 * torch.randn(tuned.centers.shape, generator=rng, dtype=F64)
        tuned.raw_scale_tril += 0.1 * torch.eye(3, dtype=F64)  # the diagonal is a logarithm
        tuned.raw_scale_tril += (torch.e**0.1 - 1) * tuned.raw_scale_tril.tril(-1)
    offset = tuned.centers - plain.centers
    for model in (tuned, plain):
        model.update(*wall(seed=1), num_clusters=40, seed=1)
    assert (plain.counts[: len(offset)] > wall_map().counts).double().mean() > 0.9
    assert torch.equal(tuned.means, plain.means)
    old = len(offset)
    torch.testing.assert_close(tuned.centers[:old] - plain.centers[:old], offset)
    torch.testing.assert_close(tuned.scale_tril[:old], torch.e**0.1 * plain.scale_tril[:old])


def test_parameters_stay_the_same_objects_and_old_clusters_keep_their_rows():
    model = wall_map()
    parameters, occupied = list(model.parameters()), model.is_occupied.clone()
    model.update(*wall(at=6.0), seed=1)
    assert len(model) > len(occupied)
    assert all(ours is theirs for ours, theirs in zip(model.parameters(), parameters, strict=True))
    assert torch.equal(model.is_occupied[: len(occupied)], occupied)
    torch.testing.assert_close(model.centers[: len(occupied)], wall_map().centers)


def test_a_map_that_grows_keeps_a_reserve_that_no_file_and_no_copy_holds(tmp_path):
    model = wall_map().update(*wall(at=6.0), num_clusters=40)
    place, size = model.centers.data_ptr(), len(model)
    assert model.centers.untyped_storage().nbytes() > model.centers.nbytes
    model.update(*wall(60, at=12.0, seed=1), num_clusters=4)
    assert len(model) > size
    assert model.centers.data_ptr() == place  # it grew in its reserve
    copied = copy.deepcopy(model).update(*wall(60, at=18.0), num_clusters=4)
    assert copied.centers.data_ptr() != place
    assert same_map(copied, copy.deepcopy(model).update(*wall(60, at=18.0), num_clusters=4))
    model.save(tmp_path / "map.pt")
    loaded = torch.load(tmp_path / "map.pt", weights_only=True)
    tensors = [value for value in loaded.values() if isinstance(value, torch.Tensor)]
    assert all(tensor.untyped_storage().nbytes() == tensor.nbytes for tensor in tensors)
    assert same_map(LardHilbertMap.load(tmp_path / "map.pt"), model)


def test_growth_leaves_alone_the_memory_behind_a_tensor_that_was_handed_in():
    model, whole = wall_map(), torch.arange(10_000)
    model.counts = whole[: len(model)]
    model.update(*wall(at=6.0), num_clusters=40)
    assert torch.equal(whole[len(wall_map()) :], torch.arange(10_000)[len(wall_map()) :])


def test_plain_sgd_goes_on_after_growth_and_adam_fails_loudly_until_its_state_is_resized():
    model = wall_map()
    points, labels = wall(seed=2)

    def step(optimizer):
        optimizer.zero_grad()
        loss = torch.nn.functional.binary_cross_entropy_with_logits
        loss(model.log_odds(points), labels.double()).backward()
        optimizer.step()

    sgd, adam = (
        kind(model.parameter_groups(), lr=0.1) for kind in (torch.optim.SGD, torch.optim.Adam)
    )
    step(adam)
    momentum = adam.state[model.weights]["exp_avg"].clone()
    model.update(*wall(at=6.0))
    before = model.weights.detach().clone()
    step(sgd)
    assert not torch.equal(model.weights, before)
    with pytest.raises(RuntimeError, match="size"):
        step(adam)
    resize_optimizer(adam, model)
    resized = adam.state[model.weights]["exp_avg"]
    assert torch.equal(resized[: len(momentum)], momentum)
    assert not resized[len(momentum) :].any()
    before = model.weights.detach().clone()
    step(adam)
    assert (model.weights != before).any()
    model.crop(torch.tensor([6.0, 1.0, 1.0]), 2.0)
    with pytest.raises(ValueError, match="Make a new optimizer after crop"):
        resize_optimizer(adam, model)


def test_weight_decay_moves_the_weights_alone():
    model = wall_map()
    model.requires_grad_(True)
    before = copy.deepcopy(model)
    optimizer = torch.optim.SGD(model.parameter_groups(weight_decay=0.5), lr=0.1)
    (0 * model.log_odds(wall()[0]).sum()).backward()
    optimizer.step()
    torch.testing.assert_close(model.weights, before.weights * 0.95)
    assert torch.equal(model.centers, before.centers)
    assert torch.equal(model.raw_scale_tril, before.raw_scale_tril)


@pytest.mark.parametrize("room", ["regrouped", "retrained"])
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_an_update_that_fails_or_is_interrupted_leaves_the_map_as_it_was(monkeypatch, room, error):
    def fail(*_):
        raise error

    model = wall_map()
    before = copy.deepcopy(model)
    monkeypatch.setattr(f"lardhm_torch.learning.update.{room}", fail)
    with pytest.raises(error):
        model.update(*wall(at=6.0))
    assert same_map(model, before)


@pytest.mark.parametrize("at", [1.0, 6.0], ids=["no growth", "growth"])
def test_an_interrupt_while_the_result_is_taken_over_leaves_the_map_as_it_was(monkeypatch, at):

    model = wall_map()
    before, assign = copy.deepcopy(model), parameters.assign_rows

    def interrupted(target, where, part):
        monkeypatch.setattr(parameters, "assign_rows", assign)
        with torch.no_grad():
            target.weights[where] = part.weights[: len(where)]
            target.centers[len(before) :] = part.centers[len(where) :]
        raise KeyboardInterrupt

    monkeypatch.setattr(parameters, "assign_rows", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.update(*wall(at=at, seed=1), seed=1)
    assert same_map(model, before)


@pytest.mark.parametrize(
    ("points", "labels", "message"),
    [
        (torch.zeros(4, 2), torch.ones(4), r"points must be \(N, 3\); got \(4, 2\)"),
        (torch.zeros(4, 3), torch.ones(3), r"labels must be \(4,\)"),
        (torch.zeros(4, 3), -torch.ones(4), "labels must be 0 or 1; got -1"),
        (torch.full((4, 3), float("nan")), torch.ones(4), "points must be finite"),
    ],
)
def test_bad_samples_are_refused_and_the_map_is_as_it_was(points, labels, message):
    model = wall_map()
    before = copy.deepcopy(model)
    with pytest.raises(ValueError, match=message):
        model.update(points, labels)
    with pytest.raises(ValueError, match=r"num_clusters must be a whole number.*; got 0"):
        model.update(*wall(), num_clusters=0)
    assert same_map(model, before)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"zeta": 0.0}, "zeta must be > 0; got 0.0"),
        ({"split_loss": -1.0}, "split_loss must be > 0; got -1.0"),
        ({"max_points": 0}, "max_points must be > 0; got 0"),
        ({"cell_edge": 0.0}, "cell_edge must be > 0; got 0.0"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        UpdateConfig(**settings)


@pytest.mark.parametrize("dim", [1, 2, 5])
@pytest.mark.parametrize("config", [None, PAPER], ids=["default", "as in the paper"])
def test_maps_of_any_dimension_learn_a_second_wall(dim, config):
    model = wall_map(dim).update(*wall(dim=dim, at=6.0), num_clusters=40, config=config)
    for at in (1.0, 6.0):
        points, labels = wall(dim=dim, seed=5, at=at)
        assert ((model(points) > 0.5) == (labels > 0.5)).double().mean() > 0.95


@pytest.mark.filterwarnings("ignore:none of 600 points is occupied")
def test_one_new_point_and_one_new_class_are_enough_for_an_update():
    model = wall_map()
    model.update(torch.tensor([[50.0, 0.0, 0.0]]), torch.ones(1))
    assert model(torch.tensor([50.0, 0.0, 0.0])).isfinite()
    free = LardHilbertMap().fit(wall()[0][600:], torch.zeros(600), num_clusters=10)
    free.update(wall()[0][:600], torch.ones(600), num_clusters=10)
    assert (free(wall()[0][:600]) > 0.5).double().mean() > 0.95


# --- real scans ---


def streamed(train, config=None):
    model = LardHilbertMap(dim=train.dim)
    for number, scan in enumerate(train.scan_id.unique().tolist()):
        samples = sample_rays(train.select(train.scan_id == scan), seed=number)
        model.update(samples.points, samples.labels, seed=number, config=config)
    return model


@torch.no_grad()
@pytest.mark.parametrize("name", ["la3dm_sim_structured", "sevenscenes_rgbd"])
def test_a_stream_predicts_held_out_rays_as_well_as_all_scans_at_once(data, name):
    from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

    train, test = split_rays(protocol_rays(load_scans(data / name / "scans.npz"), 40_000), 0.5)
    samples = sample_rays(train)
    model = streamed(train)
    batch = LardHilbertMap().fit(samples.points, samples.labels, num_clusters=len(model))
    ours, theirs = evaluate(model, test), evaluate(batch, test)
    for kind, loss in (("unif", 0.012), ("near", 0.02)):
        lost = theirs[kind]["balanced_accuracy"] - ours[kind]["balanced_accuracy"]
        assert lost <= loss


@torch.no_grad()
@pytest.mark.parametrize("name", ["paper_virtual", "balm_realworld"])
def test_revisits_make_hardly_more_clusters_than_all_rays_at_once(data, name):
    scans = load_scans(data / name / "scans.npz")
    order = torch.randperm(len(scans), generator=torch.Generator().manual_seed(0))[:24_000]
    model = LardHilbertMap()
    for number, rays in enumerate(order.chunk(6)):  # the same place, other rays
        samples = sample_rays(scans.select(rays), seed=number)
        model.update(samples.points, samples.labels, seed=number)
    samples = sample_rays(scans.select(order))
    whole = LardHilbertMap().fit(samples.points, samples.labels)
    assert len(model) <= 1.5 * len(whole)


@torch.no_grad()
def test_places_that_were_seen_once_have_enough_clusters(data):
    from lardhm_torch.evaluation.held_out import protocol_rays

    scans = protocol_rays(load_scans(data / "kitti00_mulls" / "scans.npz"), 32_000)
    samples = sample_rays(scans)
    whole = LardHilbertMap().fit(samples.points, samples.labels)
    assert 0.57 * len(whole) < len(streamed(scans)) < 1.3 * len(whole)


def test_a_robot_that_waits_gets_no_more_clusters():
    scans, model, sizes = simulate_room(num_rays=1000, seed=3), LardHilbertMap(), []
    for seed in range(20):  # other free points along the same rays
        samples = sample_rays(scans, seed=seed)
        model.update(samples.points, samples.labels, seed=seed)
        sizes.append(len(model))
    assert sizes[-1] <= 1.05 * sizes[9]
    assert sizes[-1] <= 1.3 * sizes[0]


def test_scans_that_each_see_a_little_more_make_finer_clusters():
    """A robot that comes nearer sees a wavy wall with a few more points each time."""
    model, rng = LardHilbertMap(), torch.Generator().manual_seed(0)
    sizes = []
    for turn in range(12):
        points = 8 * torch.rand(2, int(200 * 1.2**turn), 3, generator=rng, dtype=F64)
        points[..., 2] = 0.2 * torch.sin(4 * points[..., 0])
        points[1, :, 2] -= 0.3  # free space before the wall
        labels = torch.tensor([1.0, 0.0]).repeat_interleave(points.shape[1])
        sizes.append(len(model.update(points.reshape(-1, 3), labels, seed=turn)))
    assert sizes[-1] > 3 * sizes[0]


@pytest.mark.parametrize("number", [5, EVIDENCE + 7])
def test_maps_that_kept_other_numbers_of_points_are_read(number):
    model = wall_map()
    state = model.state_dict()
    more = torch.nn.functional.pad(state["evidence"], (0, 0, 0, 7), value=torch.inf)
    state["evidence"] = more[:, :number]
    other = LardHilbertMap().double()
    other.load_state_dict(state)
    kept = min(number, EVIDENCE)
    assert other.evidence.shape == model.evidence.shape
    assert torch.equal(other.evidence[:, :kept], model.evidence[:, :kept])
    assert other.evidence[:, kept:].isinf().all()
    points, labels = wall(seed=9)
    other.update(points, labels)
    assert ((other(points) > 0.5) == (labels > 0.5)).double().mean() > 0.95


def test_a_map_saved_without_its_evidence_is_small_and_learns_on(tmp_path):
    whole = wall_map()
    whole.save(tmp_path / "whole.pt")
    whole.save(tmp_path / "small.pt", evidence=False)
    assert (tmp_path / "small.pt").stat().st_size < 0.5 * (tmp_path / "whole.pt").stat().st_size
    small = LardHilbertMap.load(tmp_path / "small.pt")
    points, labels = wall(seed=9)
    assert torch.equal(small(points), whole(points))
    for seed in range(3):
        small.update(*wall(seed=20 + seed, at=6.0), seed=seed)
        small.update(*wall(seed=30 + seed), seed=seed)
    for at in (1.0, 6.0):
        points, labels = wall(seed=5, at=at)
        assert ((small(points) > 0.5) == (labels > 0.5)).double().mean() > 0.95
