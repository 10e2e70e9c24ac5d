"""Packed maps with channels: close answers, small files, and damage that is found."""

import pytest
import torch
from colored_maps import channels_of, colored_map, colored_wall, surface_points
from small_maps import wall

from lardhm_torch import LardHilbertMap
from lardhm_torch.io.packed_files import encode
from lardhm_torch.learning.packing import rounded


def packed_and_loaded(model, path, **settings):
    model.pack(path, **settings)
    return LardHilbertMap.load(path)


@pytest.mark.parametrize("is_trained", [False, True])
def test_packed_channels_answer_as_the_map_did(tmp_path, is_trained):
    model, points = colored_map(), surface_points()
    hits, labels, channels = colored_wall()
    given = hits[labels == 1], channels["class"][labels == 1]
    if is_trained:
        model.fit_classes(*given)
    model.calibrate_classes(*given)
    loaded = packed_and_loaded(model, tmp_path / "map.lhm", precision=10)
    assert loaded.channel_layout == model.channel_layout
    assert loaded.class_scale == model.class_scale
    assert (loaded.class_weights is None) != is_trained
    for name, error in (("color", 3 / 255), ("intensity", 200 * 3 / 255), ("class", 0.03)):
        ours, theirs = model.channel(points, name), loaded.channel(points, name)
        assert (ours - theirs).abs().max() < error, name
    far = points + 50
    assert loaded.channel(far, "color").isnan().all()
    counts = loaded.channels["color"].counts / model.channels["color"].counts
    assert (counts[model.is_occupied] - 1).abs().max() < 0.05
    assert (loaded.channels["color"].counts[~model.is_occupied] == 0).all()


def test_packed_occupancy_is_the_same_with_channels_and_their_bytes_are_few(tmp_path):
    model, points = colored_map(), surface_points()
    loaded = packed_and_loaded(model, tmp_path / "with.lhm")
    bare = packed_and_loaded(model.drop_channels(), tmp_path / "without.lhm")
    assert torch.equal(loaded(points), bare(points))
    added = (tmp_path / "with.lhm").stat().st_size - (tmp_path / "without.lhm").stat().st_size
    assert 0 < added < 60 * int(model.is_occupied.sum()) + 300
    again = packed_and_loaded(loaded, tmp_path / "again.lhm")  # packed once more
    gap = (again.channel(points, "color") - loaded.channel(points, "color")).abs().max()
    assert gap < 3 / 255


def test_clusters_without_a_value_stay_without(tmp_path):
    points, labels = wall()
    channels = channels_of(points, labels)
    channels["color"][points[:, 1] > 1] = torch.nan
    model = LardHilbertMap(3).double().fit(points, labels, 40, channels=channels)
    loaded = packed_and_loaded(model, tmp_path / "map.lhm")
    ours, theirs = model.channels["color"].counts > 0, loaded.channels["color"].counts > 0
    assert torch.equal(ours, theirs)
    assert 0 < int(ours.sum()) < int(model.is_occupied.sum())


def test_damaged_packed_channels_are_found(tmp_path):
    model, path = colored_map(), tmp_path / "map.lhm"
    model.pack(path)
    content = path.read_bytes()
    for place in (8, 13, 17, 30, 200, len(content) // 3):
        path.write_bytes(content[:place] + bytes([content[place] ^ 64]) + content[place + 1 :])
        with pytest.raises(ValueError, match=r"map\.lhm must be a complete packed map"):
            LardHilbertMap.load(path)
    for length in (8, 20, 300, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"map\.lhm must be a complete packed map"):
            LardHilbertMap.load(path)
    other = LardHilbertMap(3).double().fit(*wall(), 20)
    block = content[: -len(encode(rounded(model)))]
    path.write_bytes(block + encode(rounded(other)))
    with pytest.raises(ValueError, match="must have a row per occupied cluster"):
        LardHilbertMap.load(path)
