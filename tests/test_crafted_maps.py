"""State that no map has is refused wherever it is loaded, and nothing is changed by it."""

import copy
import dataclasses
import math
import warnings
import zipfile

import pytest
import torch
from small_maps import same_map, wall, wall_map

from lardhm_torch import LardHilbertMap, TiledMap, raycast, signed_distance
from lardhm_torch.io.map_files import save_state
from lardhm_torch.tiles.entries import file_checksum
from lardhm_torch.tiles.indexing import tile_path
from lardhm_torch.tiles.manifest import read_manifest, write_manifest

POINTS = wall()[0]


def with_value(name, value, row=3):
    def craft(state):
        state[name] = state[name].clone()
        state[name].view(-1)[row] = value

    return craft


def replaced(name, make):
    def craft(state):
        state[name] = make(state[name])

    return craft


CRAFTED = {
    "NaN center": (with_value("centers", math.nan), "centers must be finite; got nan"),
    "infinite center": (with_value("centers", -math.inf), "centers must be finite; got -inf"),
    "NaN factor": (with_value("raw_scale_tril", math.nan), "raw_scale_tril must be finite"),
    "huge factor": (
        with_value("raw_scale_tril", 1e6, 0),
        "raw_scale_tril must be at most 709.8 on",
    ),
    "NaN weight": (with_value("weights", math.nan), "weights must be finite"),
    "negative count": (with_value("counts", -1), "counts must be 0 or more; got -1"),
    "infinite mean": (with_value("means", math.inf), "means must be finite; got inf"),
    "NaN scatter": (with_value("scatters", math.nan), "scatters must be finite"),
    "NaN evidence": (with_value("evidence", math.nan), "evidence must be finite; got nan"),
    "negative loss": (with_value("losses", -2.0), "losses must be 0 or more; got -2"),
    "negative variance": (with_value("posterior_variances", -1.0), "posterior_variances must be 0"),
    "NaN origin": (with_value("origin", math.nan, 0), "origin must be finite"),
    "complex weights": (replaced("weights", lambda t: t.to(torch.complex64)), "of real numbers"),
    "too many weights": (replaced("weights", lambda t: t.repeat(2)), r"must be \(80,"),
    "weights in rows": (replaced("weights", lambda t: t[None]), "in a map of 1 clusters"),
    "scalar counts": (replaced("counts", lambda t: t[0]), r"counts must be \(40,\)"),
    "2-D centers": (replaced("centers", lambda t: t[:, :2].contiguous()), r"centers must be"),
}
IN_TILES = [name for name in CRAFTED if "evidence" not in name and "loss" not in name]


@pytest.fixture(scope="module")
def fitted():
    return wall_map()


@pytest.mark.parametrize("suffix", [".pt", ".safetensors", ""])
@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_state_is_refused_by_name_of_the_tensor(fitted, tmp_path, name, suffix):
    craft, message = CRAFTED[name]
    state = fitted.state_dict()
    craft(state)
    if suffix:
        path = tmp_path / f"map{suffix}"
        save_state(state, path)
        with pytest.raises(ValueError, match=rf"{path} must hold a LardHilbertMap; .*{message}"):
            LardHilbertMap.load(path)
        return
    model = copy.deepcopy(fitted)
    with pytest.raises(ValueError, match=message):
        model.load_state_dict(state)
    assert same_map(model, fitted)


@pytest.mark.parametrize("name", IN_TILES)
def test_a_crafted_tile_is_refused(fitted, tmp_path, name):
    tiles = TiledMap.split(fitted, tmp_path / "tiles", edge=100.0)
    manifest = read_manifest(tiles.folder)
    index = max(manifest.tiles, key=lambda index: manifest.tiles[index].num_clusters)
    path = tile_path(tiles.folder, index)
    state = LardHilbertMap.load(path).state_dict()
    CRAFTED[name][0](state)
    save_state(state, path)
    entry = dataclasses.replace(manifest.tiles[index], checksum=file_checksum(path))
    entries = {**manifest.tiles, index: entry}
    write_manifest(tiles.folder, dataclasses.replace(manifest, tiles=entries))
    with pytest.raises(ValueError, match=r"tile .* of the map cannot be used"):
        TiledMap.open(tiles.folder)(POINTS)


def test_a_tensor_that_claims_more_values_than_its_file_holds_is_refused(fitted, tmp_path):
    state = fitted.state_dict()
    for name in ("weights", "centers", "raw_scale_tril"):
        state[name] = state[name][:1].expand(10**12, *state[name].shape[1:])
    torch.save(state, tmp_path / "map.pt")
    with pytest.raises(ValueError, match=r"weights must store all its values; \(1000000000000,\)"):
        LardHilbertMap.load(tmp_path / "map.pt")


def test_a_compressed_entry_is_refused(fitted, tmp_path):
    path, packed = tmp_path / "map.pt", tmp_path / "packed.pt"
    fitted.save(path)
    with zipfile.ZipFile(path) as plain, zipfile.ZipFile(packed, "w") as archive:
        for entry in plain.infolist():
            archive.writestr(entry.filename, plain.read(entry), zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="must not be compressed"):
        LardHilbertMap.load(packed)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
@pytest.mark.parametrize("rows", [1, 40])
def test_centers_that_are_not_finite_hang_no_query(fitted, value, rows):
    model = copy.deepcopy(fitted)
    with torch.no_grad():
        model.centers[:rows] = value
    inputs = POINTS.clone().requires_grad_()
    answer = model(inputs)
    answer.sum().backward()
    assert len(answer) == len(POINTS)
    assert rows == 40 or bool(answer.isfinite().all())  # spoils no other cluster
    model.unknown(POINTS)
    model.query_lattice([torch.linspace(0, 2, 5)] * 3)
    ways = torch.nn.functional.normalize(POINTS - 5)
    for query in (
        lambda: raycast(model, POINTS, ways, max_range=3.0),
        lambda: signed_distance(model, POINTS),
        lambda: model.update(*wall(50)),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                query()
            except (ValueError, RuntimeError):
                continue  # refused
