"""Channels of maps: exact sums, files, and the same occupancy with and without them."""

import copy
import math

import pytest
import torch
from colored_maps import (
    CLASSES,
    channels_of,
    colored_map,
    colored_wall,
    ramp,
    surface_points,
    total,
)
from scipy.spatial.transform import Rotation
from small_maps import F64, same_map, wall

from lardhm_torch import LardHilbertMap, merge_maps


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_occupancy_is_the_same_to_the_last_bit_with_and_without_channels(dtype):
    points, labels, _ = colored_wall()
    bare, colored = LardHilbertMap(3).to(dtype).fit(points, labels, 40), colored_map(dtype)
    assert torch.equal(bare(points), colored(points))
    more = wall(300, seed=5, at=1.5)
    bare.update(*more, seed=1)
    colored.update(*more, seed=1, channels=channels_of(*more))
    assert torch.equal(bare(points), colored(points))
    ours = {n: t for n, t in colored.state_dict().items() if n != "channel_sums"}
    ours["_extra_state"] = bare.state_dict()["_extra_state"]
    assert ours.keys() == bare.state_dict().keys()
    assert bare.channels == {}
    assert bare.channel_sums is None


def test_every_cluster_sums_up_the_hits_that_are_nearest_to_it():
    points, labels, channels = colored_wall()
    model = colored_map()
    hits = points[labels == 1]
    means = model.means[model.is_occupied] + model.origin
    nearest = torch.cdist(hits, means).argmin(dim=1)
    rows = model.is_occupied.nonzero().squeeze(1)
    for name in ("color", "intensity"):
        values = channels[name][labels == 1].float().double().reshape(len(hits), -1)
        found = model.channels[name]
        for number, row in enumerate(rows):
            own = values[nearest == number]
            torch.testing.assert_close(found.sums[row], own.sum(dim=0), rtol=1e-9, atol=1e-9)
            assert found.counts[row] == len(own)
        assert found.counts[~model.is_occupied].sum() == 0
    classes = model.channels["class"]
    assert sorted(classes.classes) == list(CLASSES)
    for number, count in zip(classes.classes, classes.sums.sum(dim=0), strict=True):
        assert count == (channels["class"] == number).sum()


def test_missing_values_are_counted_and_are_not_zero():
    points, labels, channels = colored_wall()
    lost = torch.arange(len(points)) % 3 == 0
    for name, values in channels.items():
        channels[name] = values.clone()
        channels[name][lost] = -1 if name == "class" else torch.nan
    model = LardHilbertMap(3).double().fit(points, labels, 40, channels=channels)
    seen = (labels == 1) & ~lost
    assert model.channels["intensity"].counts.sum() == seen.sum()
    torch.testing.assert_close(model.channel(surface_points(), "color"), ramp(surface_points()),
                               rtol=0, atol=0.02)  # fmt: skip


def test_soft_labels_are_summed_up_as_probabilities():
    points, labels, channels = colored_wall()
    soft = torch.full((len(points), 8), math.nan)
    soft[labels == 1] = 0.0
    hard = channels["class"].clamp(min=0)
    soft[labels == 1] = 0.8 * torch.nn.functional.one_hot(hard, 8).float()[labels == 1] + 0.025
    model = LardHilbertMap(3).double().fit(points, labels, 40, channels={"class": soft})
    assert model.classes == list(range(8))
    torch.testing.assert_close(
        total(model, "class"), soft[labels == 1].double().sum(dim=0), rtol=1e-6, atol=1e-6
    )
    model.update(*wall(100, seed=4), channels={"class": channels_of(*wall(100, seed=4))["class"]})
    assert torch.argmax(model.class_probability(surface_points(1)[0])) in CLASSES


def test_updates_keep_every_hit_and_add_new_classes_and_channels():
    points, labels, channels = colored_wall()
    model = (
        LardHilbertMap(3).double().fit(points, labels, 40, channels={"class": channels["class"]})
    )
    expected = {"class": 600, "color": 0, "intensity": 0}
    for seed in range(1, 4):  # the same wall again, now with colors and one more class
        points, labels = wall(200, seed=seed)
        channels = channels_of(points, labels)
        channels["class"] = torch.where(channels["class"] == 7, 9, channels["class"])
        model.update(points, labels, seed=seed, channels=channels)
        expected = {name: count + 200 for name, count in expected.items()}
        for name, count in expected.items():
            assert model.channels[name].counts.sum().item() == pytest.approx(count, rel=1e-9)
    assert sorted(model.classes) == [3, 7, 9]
    errors = (model.channel(surface_points(), "color") - ramp(surface_points())).abs()
    assert errors.mean() < 0.01
    assert errors.max() < 0.05  # halves of a cluster have the same color at first
    before = total(model, "class")
    model.update(*wall(100, seed=9), seed=9)  # a scan without channels
    torch.testing.assert_close(total(model, "class"), before)


def test_a_failing_update_leaves_channels_as_they_were(monkeypatch):
    from lardhm_torch.learning import parameters

    model = LardHilbertMap(3).double().fit(*wall(), 40)
    before = copy.deepcopy(model.state_dict())
    points, labels, channels = colored_wall(seed=2)
    kept = parameters.assign_rows
    calls = []

    def fails_once(*arguments):
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("no memory")
        kept(*arguments)

    monkeypatch.setattr(parameters, "assign_rows", fails_once)
    with pytest.raises(RuntimeError, match="no memory"):
        model.update(points, labels, channels=channels)
    restored = LardHilbertMap(3).double()
    restored.load_state_dict(before)
    assert same_map(model, restored)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"color": torch.zeros(3, 3)}, "must have 1200 rows"),
        ({"class": torch.full((1200,), 1 << 17)}, "must be 0 to 65535"),
        ({"intensity": torch.zeros(1200, 2)}, "'intensity' must have 0 values as in the map"),
    ],
)
def test_wrong_channels_are_refused_and_change_nothing(channels, message):
    model = colored_map()
    before = copy.deepcopy(model)
    with pytest.raises(ValueError, match=message):
        model.update(*wall(seed=1), channels=channels)
    assert same_map(model, before)


def test_too_many_classes_are_refused():
    points, labels = wall(1200)
    numbers = torch.where(labels == 1, torch.arange(2400), -1)
    model = colored_map()
    with pytest.raises(ValueError, match="at most 1024 classes; got 120"):
        model.update(points, labels, channels={"class": numbers})


def counts_by_class(model):
    return dict(zip(model.classes, total(model, "class").tolist(), strict=True))


def test_merged_maps_have_the_sums_of_both():
    first = colored_map()
    points, labels, channels = colored_wall(seed=6)
    second = LardHilbertMap(3).double().fit(
        points + torch.tensor([10.0, 0, 0]), labels, 40,
        channels={"class": torch.where(channels["class"] == 3, 4, -1)},
    )  # fmt: skip
    joined = merge_maps(first, second)
    assert sorted(joined.classes) == [3, 4, 7]
    assert counts_by_class(joined) == counts_by_class(first) | counts_by_class(second)
    reverse = counts_by_class(merge_maps(second, first))  # the classes of the second come last
    assert reverse == pytest.approx(counts_by_class(joined))
    torch.testing.assert_close(total(joined, "color"), total(first, "color"))
    counts = joined.channels["class"].counts.sum()
    both = first.channels["class"].counts.sum() + second.channels["class"].counts.sum()
    torch.testing.assert_close(counts, both)
    here = surface_points()
    torch.testing.assert_close(joined.channel(here, "color"), first.channel(here, "color"))
    twice = merge_maps(first, first)
    torch.testing.assert_close(total(twice, "color"), 2 * total(first, "color"))
    # more hits regularize the slopes a little less
    ours = twice.channel(here, "color")
    torch.testing.assert_close(ours, first.channel(here, "color"), rtol=0, atol=5e-3)
    assert joined.class_probability(here + torch.tensor([10.0, 0, 0])).argmax(1).unique().tolist()


def test_channels_move_with_the_map_and_are_cropped():
    model, points = colored_map(), surface_points()
    before = model.channel(points, "color"), model.class_probability(points)
    turn = torch.tensor(Rotation.from_euler("xyz", [0.3, -0.5, 1.2]).as_matrix())
    shift = torch.tensor([50.3, -20.0, 7.7], dtype=F64)
    model.transform(turn, shift)
    there = points @ turn.T + shift
    torch.testing.assert_close(model.channel(there, "color"), before[0], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(model.class_probability(there), before[1], rtol=1e-5, atol=1e-6)
    whole = model.channels["color"].counts.sum()
    model.crop(turn @ torch.tensor([1.0, 0.5, 1], dtype=F64) + shift, 0.6)
    assert 0 < model.channels["color"].counts.sum() < whole


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_files_keep_channels_and_class_weights(tmp_path, suffix):
    model = colored_map(torch.float32)
    points, labels, channels = colored_wall()
    is_hit = labels == 1
    model.fit_classes(points[is_hit], channels["class"][is_hit], wrong_labels=0.05)
    model.calibrate_classes(points[is_hit], channels["class"][is_hit])
    model.save(tmp_path / f"map{suffix}")
    loaded = LardHilbertMap.load(tmp_path / f"map{suffix}")
    assert same_map(model, loaded)
    assert loaded.class_scale == model.class_scale
    here = surface_points()
    assert torch.equal(loaded.channel(here, "color"), model.channel(here, "color"))
    assert torch.equal(loaded.class_log_odds(here), model.class_log_odds(here))
    model.save(tmp_path / f"small{suffix}", evidence=False)
    small = LardHilbertMap.load(tmp_path / f"small{suffix}")
    assert torch.equal(small.class_log_odds(here), model.class_log_odds(here))


def test_damaged_channels_of_a_state_dict_are_refused():
    state = colored_map().state_dict()
    wrong = {
        "channels must list": {"channels": {"class": [1, 1]}},
        "channel_sums must be": {"channels": {"color": 3}},
        "must have channel_sums of the channels": {"channels": {}},
        "class_scale must be": {"class_scale": -1.0},
    }
    for message, change in wrong.items():
        extra = {**state["_extra_state"], **change}
        with pytest.raises(ValueError, match=message):
            LardHilbertMap(3).double().load_state_dict({**state, "_extra_state": extra})


def test_half_precision_keeps_exact_sums():
    model = colored_map()
    sums = model.channel_sums.clone()
    model.half()
    assert model.channel_sums.dtype == F64
    assert torch.equal(model.channel_sums, sums)


def test_dropped_channels_leave_the_map_without_them():
    model = colored_map()
    bare = LardHilbertMap(3).double().fit(*wall(), 40)
    assert same_map(model.drop_channels(), bare)
