"""The folder of a tiled map: its manifest, damage to it and to tiles, and the verbs that take it."""

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiled_maps import F64, border_points, random_map, tiled

from lardhm_torch import LardHilbertMap, TiledMap, cli, save_scans, simulate_room
from lardhm_torch.cli import main
from lardhm_torch.io.map_files import load_state, save_state
from lardhm_torch.tiles import blocks
from lardhm_torch.tiles.blocks import rows_by_number
from lardhm_torch.tiles.entries import file_checksum, tile_record
from lardhm_torch.tiles.indexing import tile_indices, tile_name, tile_path
from lardhm_torch.tiles.manifest import Manifest, read_manifest, write_manifest
from lardhm_torch.tiles.store import DamagedTileError
from lardhm_torch.tiles.tiled_map import open_map

SETTINGS = LardHilbertMap().settings


def a_manifest(model_folder):
    model = random_map(clusters=20)
    model.save(model_folder / "one.safetensors")
    tile = tile_record(model, model_folder / "one.safetensors", 77)
    return Manifest(
        edge=4.0,
        halo=6.5,
        origin=(0.1, -4e6, 1 / 3),
        settings=model.settings,
        dtype="float64",
        sampling={"max_range": 30.0},
        fitting={"l2": 0.01, "epochs": 4},
        seed=3,
        tiles={(3, -1, 0): tile, (0, 0, 12345678): replace(tile, num_points=0)},
    )


# --- the manifest ---


def test_a_manifest_written_and_read_is_the_same(tmp_path):
    manifest = a_manifest(tmp_path)
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
    assert {path.name for path in tmp_path.iterdir()} == {"one.safetensors", "manifest.json"}


def test_a_tile_is_named_by_its_index_and_points_belong_to_one():
    assert tile_name((3, -1, 0)) == "3_-1_0"
    points = torch.tensor([[0.0, 19.9, -0.1], [20.0, -20.0, 40.0]])
    assert tile_indices(points, [0.0, 0, 0], 20.0).tolist() == [[0, 0, -1], [1, -1, 2]]
    assert tile_indices(points, [10.0, 0, 0], 20.0)[0].tolist() == [-1, 0, -1]


@settings(deadline=None, max_examples=150)
@given(where=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut=st.booleans())
def test_a_damaged_manifest_is_never_taken_for_another(tmp_path_factory, where, flip, cut):
    folder = tmp_path_factory.mktemp("damaged")
    manifest = a_manifest(folder)
    write_manifest(folder, manifest)
    path = folder / "manifest.json"
    content = bytearray(path.read_bytes())
    place = int(where * len(content))
    if cut:
        content = content[:place]
    else:
        content[place] ^= flip
    path.write_bytes(content)
    try:
        found = read_manifest(folder)
    except ValueError:
        return
    assert found == manifest  # another layout of the same JSON


BAD_FIELDS = [
    ("edge", 0, "edge must be > 0 m"),
    ("edge", "20", "edge must be a finite number"),
    ("edge", 1e999, "edge must be a finite number|numbers must be finite|Out of range"),
    ("halo", -1.0, "halo must be a finite number, 0 or more; got -1.0"),
    ("origin", [0, 0], "origin must be 3 coordinates"),
    ("origin", [0, 0, 1e300], "origin must be coordinates in meters"),
    ("origin", {}, "a position must be a list"),
    ("seed", 1.5, "seed must be a whole number; got 1.5"),
    ("dtype", "int8", "dtype must be one of"),
    ("settings", {}, "settings must be"),
    ("settings", {**SETTINGS, "dim": True}, "settings.dim must be a whole number; got True"),
    ("settings", {**SETTINGS, "num_neighbors": 0}, "settings.num_neighbors must be 1 or more"),
    ("settings", {**SETTINGS, "covariance_scale": 0.0}, "settings.covariance_scale must be > 0"),
    ("sampling", [], "sampling must be a table"),
    ("tiles", [], "tiles must be a table"),
    ("tiles", {"../../x": {}}, "tile '../../x': the name of a tile must be whole numbers"),
    ("tiles", {"1_2_03": {}}, "tile '1_2_03': the name of a tile must be its index"),
    ("tiles", {"1_2_3": {}}, "tile '1_2_3': a tile must have"),
    ("more", 1, "unknown=.'more'."),
]


def rewrite(folder, change):
    """Edit the manifest's body by hand and make its checksum right again."""
    from lardhm_torch.tiles.manifest import body_checksum

    path = folder / "manifest.json"
    page = json.loads(path.read_text())
    change(page["content"])
    with contextlib.suppress(ValueError):  # for what is no JSON there is no checksum
        page["checksum"] = body_checksum(page["content"])
    path.write_text(json.dumps(page))


@pytest.mark.parametrize(("field", "value", "message"), BAD_FIELDS)
def test_a_bad_field_is_named(field, value, message, tmp_path):
    write_manifest(tmp_path, a_manifest(tmp_path))
    rewrite(tmp_path, lambda body: body.update({field: value}))
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(tmp_path)
    assert "manifest.json must be" in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("checksum", "abc", "checksum must be 64 hexadecimal digits; got 'abc'"),
        ("num_points", -1, "num_points must be 0 or more; got -1"),
        ("num_clusters", 0, "num_clusters must be 1 or more; got 0"),
        ("support_radius", None, "support_radius must be a finite number"),
        ("bounds", [[0, 0, 0]], "bounds must be a lower and an upper corner"),
        ("bounds", [[0, 0, 1], [0, 0, 0]], "bounds must be lower <= upper"),
        ("bounds", [[0, 0], [1, 1]], "bounds of tile 3_-1_0 must have 3 coordinates"),
        ("bounds", [[0, 0, "x"], [1, 1, 1]], "must be coordinates in meters"),
        ("thickness", [1, 2], r"thickness must be whole numbers; got \[1, 2\]"),
        ("thickness", "-80 1.5", "thickness must be whole numbers; got '-80 1.5'"),
        ("thickness", "-80", "thickness must be a bin and counts"),
        ("thickness", "-80 -1", "thickness must be 0 or more; got -1"),
        ("thickness", "5000 1", "thickness must be bins -4096 to 4096"),
    ],
)
def test_a_bad_field_of_a_tile_is_named(field, value, message, tmp_path):
    write_manifest(tmp_path, a_manifest(tmp_path))
    rewrite(tmp_path, lambda body: body["tiles"]["3_-1_0"].update({field: value}))
    with pytest.raises(ValueError, match=message):
        read_manifest(tmp_path)


def test_other_files_are_not_taken_for_a_manifest(tmp_path):
    with pytest.raises(FileNotFoundError, match="must be the folder of a tiled map"):
        read_manifest(tmp_path)
    for text, message in [
        ("", "manifest.json must be the manifest of a tiled map; it must be complete JSON"),
        (
            "[" * 100_000,
            "manifest.json must be the manifest of a tiled map; it must be complete JSON",
        ),
        ("[]", "format_version must be 3; got None"),
        ('{"format_version": 4}', "got 4. A newer folder needs a newer lardhm_torch"),
        ('{"format_version": 2}', "got 2. .*an older one must be tiled and fitted again"),
        ('{"format_version": 3, "content": 3}', "content must be a table; got int"),
        ('{"format_version": 3, "content": {}}', "the file was damaged or edited"),
    ]:
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_manifest(tmp_path)


# --- damaged tiles ---


def damage(path, how):
    content = bytearray(path.read_bytes())
    if how == "a flipped bit":
        content[len(content) // 2] ^= 1
    if how == "cut short":
        content = content[: len(content) // 2]
    path.unlink()
    if how != "missing":
        path.write_bytes(content)


@pytest.mark.parametrize("how", ["a flipped bit", "cut short", "missing"])
@pytest.mark.parametrize("block_clusters", [1, 10_000])
def test_a_damaged_tile_is_named_and_the_rest_answers(how, block_clusters, tmp_path, monkeypatch):
    model = random_map(clusters=1000)
    folder = tmp_path / "tiles"
    points = border_points(tiled(model, tmp_path, monkeypatch, block_clusters), 2000)
    expected = model(points)
    damage(tile_path(folder, (0, 0, 0)), how)
    tiles = TiledMap.open(folder)
    inside = torch.full((1, 3), 101.0, dtype=F64)
    with pytest.raises(DamagedTileError, match="tile 0_0_0 of the map cannot be used") as caught:
        tiles(inside)
    assert caught.value.index == (0, 0, 0)
    elsewhere = (points > 113).all(dim=1)
    assert elsewhere.sum() > 30
    torch.testing.assert_close(tiles(points[elsewhere]), expected[elsewhere])
    with pytest.raises(DamagedTileError, match="0_0_0"):
        tiles(points)
    with pytest.raises(DamagedTileError, match="0_0_0"):
        tiles.merge()
    with pytest.raises(DamagedTileError, match="0_0_0"):
        tiles.query_lattice([torch.linspace(100, 103, 4, dtype=F64)] * 3)


def test_a_damaged_tile_can_be_skipped(tmp_path, monkeypatch):
    whole = tiled(random_map(), tmp_path, monkeypatch)
    points, index = border_points(whole, 2000), (0, 0, 0)
    damage(tile_path(whole.folder, index), "cut short")
    tiles = TiledMap.open(whole.folder, skip_damaged=True)
    with pytest.warns(UserWarning, match="a damaged tile was skipped: tile 0_0_0"):
        found = tiles(points)
    manifest = read_manifest(whole.folder)
    without = {place: tile for place, tile in manifest.tiles.items() if place != index}
    write_manifest(whole.folder, replace(manifest, tiles=without))
    torch.testing.assert_close(found, TiledMap.open(whole.folder)(points))


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (random_map(dim=2), "dim must be 3;.*has 2"),
        (random_map(dtype=torch.float32), "dtype must be torch.float64;.*has torch.float32"),
        (random_map(clusters=7), r"num_clusters must be \d+;.*has 7"),
    ],
)
def test_a_tile_that_is_not_what_the_manifest_says_is_an_error(
    other, message, tmp_path, monkeypatch
):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    index = next(iter(tiles.manifest.tiles))
    path = tile_path(tiles.folder, index)
    other.save(path)
    checksum = tile_record(other, path, 0).checksum
    entry = replace(tiles.manifest.tiles[index], checksum=checksum)
    changed = {**tiles.manifest.tiles, index: entry}
    write_manifest(tiles.folder, replace(tiles.manifest, tiles=changed))
    with pytest.raises(ValueError, match=message):
        TiledMap.open(tiles.folder).merge()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("means"), r"must hold the tensors of a map; missing: \['means'\]"),
        (lambda state: state.update(counts=state["counts"].int()), "counts must be .* torch.int64"),
        (lambda state: state.update(means=state["means"][:1]), r"means must be \(\d+, 3\)"),
        (lambda state: state.pop("_extra_state"), "must hold the map's format version"),
    ],
)
def test_a_tile_with_other_tensors_is_an_error(change, message, tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    index, entry = next(iter(tiles.manifest.tiles.items()))
    path = tile_path(tiles.folder, index)
    state = load_state(path)
    change(state)
    save_state(state, path)
    changed = {**tiles.manifest.tiles, index: replace(entry, checksum=file_checksum(path))}
    write_manifest(tiles.folder, replace(tiles.manifest, tiles=changed))
    with pytest.raises(DamagedTileError, match=message):
        TiledMap.open(tiles.folder).merge()


def test_a_map_without_tiles_has_probability_one_half(tmp_path):
    write_manifest(tmp_path, Manifest(edge=1.0, origin=(0.0,) * 3, settings=SETTINGS))
    tiles = TiledMap.open(tmp_path)
    assert len(tiles) == 0
    assert tiles(torch.zeros(2, 3)).tolist() == [0.5, 0.5]
    assert len(tiles.merge()) == 0
    assert "0 tiles" in repr(tiles)


# --- groups of points ---


@given(numbers=st.lists(st.integers(-1, 3), max_size=30))
def test_every_row_is_in_the_group_of_its_number(numbers):
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(blocks, "SORTED_AT_ONCE", 7)
    numbers = torch.tensor(numbers, dtype=torch.int32)
    seen = torch.full_like(numbers, -1)
    for number, rows in rows_by_number(numbers):
        assert (seen[rows] == -1).all()
        seen[rows] = number
        order = torch.arange(len(numbers))[rows]
        assert torch.equal(order, order.sort()[0])
    monkeypatch.undo()
    assert torch.equal(seen, numbers)


# --- the command ---


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Scans, a map, and the same map in tiles."""
    folder = tmp_path_factory.mktemp("room")
    scans = simulate_room(3000, seed=0)
    save_scans(scans, folder / "scans.npz")
    assert main(["fit", str(folder / "scans.npz"), "-o", str(folder / "map.pt")]) == 0
    model = LardHilbertMap.load(folder / "map.pt")
    TiledMap.split(model.drop_channels(), folder / "tiles", 2.0)
    np.save(folder / "points.npy", scans.ends[:500].numpy())
    return folder


def run(room, capsys, *words):
    assert cli.main([str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_query_takes_a_folder(room, capsys):
    for name in ("map.pt", "tiles"):
        run(room, capsys, "query", room / name, room / "points.npy", "-o", room / f"{name}.npy")
    np.testing.assert_allclose(np.load(room / "map.pt.npy"), np.load(room / "tiles.npy"), atol=1e-4)


def test_mesh_grid_and_render_take_a_folder(room, capsys):
    for verb, ending, *more in [("mesh", "ply"), ("grid", "npz"), ("render", "png", "--slice", 1)]:
        output = ["-o", room / f"out.{ending}", "--resolution", 0.2, *more]
        said = [run(room, capsys, verb, room / name, *output) for name in ("map.pt", "tiles")]
        assert said[0] == said[1]


def test_evaluate_and_info_take_a_folder(room, capsys):
    tables = [
        json.loads(run(room, capsys, "evaluate", room / name, room / "scans.npz", "--json"))
        for name in ("map.pt", "tiles")
    ]
    for kind, scores in tables[0].items():
        assert tables[1][kind] == pytest.approx(scores, abs=1e-4)
    rows = json.loads(run(room, capsys, "info", room / "tiles", "--json"))
    model = LardHilbertMap.load(room / "map.pt")
    assert rows["clusters"] == len(model)
    assert rows["tiles"] == len(read_manifest(room / "tiles").tiles)
    assert rows["tile edge [m]"] == 2.0


def test_view_takes_a_folder(room, capsys):
    pytest.importorskip("viser", reason="viser is not installed")
    words = ["view", room / "tiles", "--export", room / "page.html", "--resolution", 0.3]
    assert "clusters" in run(room, capsys, *words)


def test_a_damaged_tile_is_a_one_line_error(room, tmp_path, capsys):
    model = LardHilbertMap.load(room / "map.pt").drop_channels()
    TiledMap.split(model, tmp_path / "broken", 2.0)
    victim = next(iter(read_manifest(tmp_path / "broken").tiles))
    damage(tile_path(tmp_path / "broken", victim), "cut short")
    output = str(tmp_path / "out.ply")
    assert cli.main(["mesh", str(tmp_path / "broken"), "-o", output]) == 1
    error = capsys.readouterr().err
    assert f"tile {tile_name(victim)} of the map cannot be used" in error
    assert error.count("\n") == 1


def test_a_path_opens_as_what_it_is(room, tmp_path):
    assert isinstance(open_map(room / "map.pt"), LardHilbertMap)
    assert isinstance(open_map(room / "tiles"), TiledMap)
    with pytest.raises(FileNotFoundError, match="it has no manifest"):
        open_map(tmp_path)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        open_map(tmp_path / "none.pt")
