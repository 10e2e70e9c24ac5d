"""Channels of maps: exact sums, interpolation, and the same occupancy with and without them."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_maps import F64, same_map, wall

from lardhm_torch import (
    LardHilbertMap,
    TiledMap,
    channel,
    extract_mesh,
    features,
    merge_maps,
    native,
    save_mesh,
)
from lardhm_torch.surfaces.channel_colors import UNKNOWN_COLOR, class_labels

CLASSES = (3, 7)


def ramp(points):
    """A color that is linear in space, 0 to 1 on the wall."""
    return torch.stack([points[:, 1] / 2, points[:, 2] / 2, 0.5 + 0 * points[:, 0]], dim=1)


def channels_of(points, labels):
    """Channels of the hits of a wall: linear values, and two classes that meet at y = 1."""
    is_hit = labels == 1
    classes = torch.where(points[:, 1] < 1, *CLASSES)
    return {
        "color": torch.where(is_hit[:, None], ramp(points).clamp(0, 1), torch.nan),
        "intensity": torch.where(is_hit, 100 * points[:, 1], torch.nan),
        "class": torch.where(is_hit, classes, -1),
    }


def colored_wall(count=600, seed=0):
    points, labels = wall(count, seed=seed)
    return points, labels, channels_of(points, labels)


def colored_map(dtype=F64, **settings):
    points, labels, channels = colored_wall()
    model = LardHilbertMap(3, **settings).to(dtype)
    return model.fit(points, labels, 40, channels=channels)


def surface_points(count=50, seed=3):
    rng = torch.Generator().manual_seed(seed)
    points = 0.2 + 1.6 * torch.rand(count, 3, generator=rng, dtype=F64)
    points[:, 0] = 1
    return points


def total(model, name):
    return model.channels[name].sums.sum(dim=0)


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


def test_linear_values_are_interpolated_linearly_and_unknown_is_nan():
    model, points = colored_map(), surface_points()
    torch.testing.assert_close(model.channel(points, "color"), ramp(points), rtol=0, atol=0.01)
    values = model.channel(points.reshape(5, 10, 3), "intensity")
    torch.testing.assert_close(values.reshape(-1), 100 * points[:, 1], rtol=0, atol=2)
    far = points + 50
    assert model.channel(far, "color").isnan().all()
    assert model.channel(torch.full((1, 3), math.nan), "intensity").isnan().all()
    assert model.channel(points[:0], "color").shape == (0, 3)


def test_the_native_mixture_equals_the_definition():
    if not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    rng = torch.Generator().manual_seed(0)
    model = colored_map()
    points = surface_points(300) - model.origin + 0.05 * torch.randn(300, 3, generator=rng).double()
    points[7] = math.nan
    for width, columns in ((4, 3), (1, 20)):
        table = torch.randn(len(model), columns, width, generator=rng, dtype=F64)
        given = (points, model.centers.detach(), model.raw_scale_tril.detach(), table)
        for sharp in (True, False):
            ours = native.mixture(*given, model.kernel, model._fresh_index(), sharp=sharp)
            indices = features.nearest_centers(points, model.centers, model.num_neighbors)
            plain = features.mixture(
                points, model.centers, model.scale_tril, table, indices, sharp=sharp
            ).detach()
            torch.testing.assert_close(ours, plain, equal_nan=True)


def test_channels_and_classes_are_differentiable():
    points, labels, channels = colored_wall(100)
    model = LardHilbertMap(3, 5).double().fit(points, labels, 12, channels=channels)
    model.class_weights = torch.nn.Parameter(0.1 * torch.ones(len(model), 2, dtype=F64))
    points = surface_points(4).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: model.channel(x, "intensity"), points)
    tensors = (points, model.centers.detach(), model.raw_scale_tril.detach(), model.class_weights)

    def log_odds(points, centers, raw, weights):
        parameters = {"centers": centers, "raw_scale_tril": raw, "class_weights": weights}
        return torch.func.functional_call(_Classes(model), _prefixed(parameters), (points,))

    inputs = tuple(tensor.detach().clone().requires_grad_(True) for tensor in tensors)
    assert torch.autograd.gradcheck(log_odds, inputs)


class _Classes(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, points):
        return self.model.class_log_odds(points)


def _prefixed(parameters):
    return {f"model.{name}": value for name, value in parameters.items()}


def test_class_posteriors_are_distributions():
    model, points = colored_map(), surface_points()
    everywhere = torch.cat([points, points + 50, points - 0.3])
    for probability in (model.class_probability(everywhere), model.class_posterior(everywhere)):
        torch.testing.assert_close(probability.sum(dim=-1), torch.ones(150, dtype=F64))
        assert (probability >= 0).all()
    assert torch.equal(model.class_probability(points + 50), torch.full((50, 2), 0.5, dtype=F64))
    clear = (points[:, 1] - 1).abs() > 0.1
    found = torch.tensor(model.classes)[model.class_probability(points).argmax(dim=1)]
    assert (found[clear] == torch.where(points[clear, 1] < 1, *CLASSES)).all()
    free = model.class_posterior(points - torch.tensor([0.7, 0, 0]))[:, 0]
    assert (free > 0.9).all()


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
    torch.testing.assert_close(
        model.channel(surface_points(), "color"), ramp(surface_points()), rtol=0, atol=0.03
    )
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


def test_merged_maps_have_the_sums_of_both():
    first = colored_map()
    points, labels, channels = colored_wall(seed=6)
    second = LardHilbertMap(3).double().fit(
        points + torch.tensor([10.0, 0, 0]), labels, 40,
        channels={"class": torch.where(channels["class"] == 3, 4, -1)},
    )  # fmt: skip
    joined = merge_maps(first, second)
    assert sorted(joined.classes) == [3, 4, 7]
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


def test_maps_with_channels_are_exported_and_compiled():
    model, points = colored_map(), surface_points()
    exported = torch.export.export(model, (points,)).module()
    torch.testing.assert_close(exported(points), model(points))
    program = torch.export.export(_Classes(model), (points,)).module()
    torch.testing.assert_close(program(points), model.class_log_odds(points))


def test_dropped_channels_leave_the_map_without_them(tmp_path):
    model = colored_map()
    with pytest.raises(ValueError, match=r"tiles cannot hold channels.*drop_channels"):
        TiledMap.split(model, tmp_path / "tiles", 5.0)
    bare = LardHilbertMap(3).double().fit(*wall(), 40)
    assert same_map(model.drop_channels(), bare)
    TiledMap.split(model, tmp_path / "tiles", 5.0)


def test_the_function_answers_as_the_map_does():
    model, points = colored_map(), surface_points()
    assert torch.equal(channel(model, points, "color"), model.channel(points, "color"))
    assert torch.equal(channel(model, points, "class"), model.class_probability(points))
    with pytest.raises(ValueError, match="color, intensity, class; got 'infrared'"):
        channel(model, points, "infrared")


def test_a_map_without_a_channel_names_those_it_has():
    with pytest.raises(ValueError, match="'infrared'; it has color, intensity, class"):
        colored_map().channel(surface_points(), "infrared")
    bare = LardHilbertMap(3).double().fit(*wall(), 40)
    with pytest.raises(ValueError, match="it has none"):
        bare.class_log_odds(surface_points())
    assert bare.classes == []


def test_meshes_have_the_colors_and_classes_of_the_map(tmp_path):
    model = colored_map(torch.float32)
    mesh = extract_mesh(model, 0.1, color="color")
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    expected = ramp(torch.tensor(np.array(mesh.vertices))).clamp(0, 1).numpy()
    assert np.abs(colors - expected).mean() < 0.03
    mesh = extract_mesh(model, 0.1, color="class")
    labels = np.asarray(mesh.vertex_attributes["label"])
    clear = np.abs(mesh.vertices[:, 1] - 1) > 0.1
    assert (labels == np.where(mesh.vertices[:, 1] < 1, *CLASSES))[clear].all()
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra dev)")
    far = mesh.copy()
    far.vertices += 5e5  # then .ply holds float64
    for name, one in (("a.ply", mesh), ("b.ply", far)):
        save_mesh(one, tmp_path / name)
        vertex = plyfile.PlyData.read(tmp_path / name)["vertex"]
        assert np.array_equal(vertex["label"], labels)
        assert np.array_equal(vertex["red"], np.asarray(one.visual.vertex_colors)[:, 0])
    save_mesh(mesh, tmp_path / "a.glb")
    trimesh = pytest.importorskip("trimesh")
    glb = trimesh.load(tmp_path / "a.glb", force="mesh")
    ours = np.asarray(mesh.visual.vertex_colors)[:, :3]
    assert len(np.unique(np.asarray(glb.visual.vertex_colors)[:, :3], axis=0)) == len(
        np.unique(ours, axis=0)
    )
    with pytest.raises(ValueError, match=r"color must be one of .*intensity, class"):
        extract_mesh(model, 0.1, color="infrared")


def test_unknown_vertices_are_gray_and_have_no_class():
    from lardhm_torch.surfaces.channel_colors import channel_colors

    model, far = colored_map(torch.float32), np.full((2, 3), 50.0)
    for name in ("color", "intensity", "class"):
        assert (channel_colors(model, far, name)[:, :3] == UNKNOWN_COLOR).all()
    assert class_labels(model, far).tolist() == [-1, -1]
