"""Channels in tiles: split and fitted maps answer as one map, and no hit is lost or counted twice."""

import numpy as np
import pytest
import torch
from colored_maps import channels_of, colored_map, colored_wall, surface_points
from room_tiles import CONFIG, contents, room_pieces
from small_maps import F64, same_map, wall

from lardhm_torch import LardHilbertMap, Scans, TiledMap, channel, extract_mesh, sample_rays
from lardhm_torch.cli import main
from lardhm_torch.tiles import layout, routing
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.folders import join_folders
from lardhm_torch.tiles.indexing import tile_path
from lardhm_torch.tiles.ledger import read_ledger
from lardhm_torch.tiles.manifest import read_manifest
from lardhm_torch.tiles.routing import add_scans, tile_scans
from lardhm_torch.tiles.store import DamagedTileError

NAMES = ("color", "intensity")


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", 16)


def queries_of(model, points):
    found = {name: channel(model, points, name) for name in NAMES if name in model.channel_layout}
    return {**found, "odds": model.class_log_odds(points), "all": model.class_posterior(points)}


def everywhere():
    points = surface_points(50)
    return torch.cat([points, points - 0.1, points + 40, torch.full((1, 3), torch.nan)])


def test_a_split_map_answers_as_the_map_did(tmp_path, small_blocks):
    model, points = colored_map(num_neighbors=6), everywhere()
    hits, labels, channels = colored_wall(100)
    given = hits[labels == 1], channels["class"][labels == 1]
    model.fit_classes(*given).calibrate_classes(*given)
    tiles = TiledMap.split(model, tmp_path / "tiles", 0.7)
    assert len(tiles.manifest.tiles) > 5
    assert tiles.classes == model.classes
    found = queries_of(tiles, points)
    for name, expected in queries_of(model, points).items():
        torch.testing.assert_close(found[name], expected, rtol=1e-9, atol=1e-9, equal_nan=True)
    merged = tiles.merge()
    assert merged.class_scale == model.class_scale
    assert merged.class_weights.shape == model.class_weights.shape
    assert merged.channels.keys() == model.channels.keys()
    for name, found in tiles.channels.items():
        torch.testing.assert_close(found.sums.sum(0), model.channels[name].sums.sum(0))


def test_gradients_of_channels_pass_through_tiles(tmp_path, small_blocks):
    model, points = colored_map(num_neighbors=6), surface_points(20)
    tiles = TiledMap.split(model, tmp_path / "tiles", 0.7)
    slopes = []
    for some in (model, tiles):
        given = points.clone().requires_grad_(True)
        (some.channel(given, "color").sum() + some.class_log_odds(given)[:, 0].sum()).backward()
        slopes.append(given.grad)
    torch.testing.assert_close(slopes[1], slopes[0])
    assert tiles.merge().class_weights is None


def test_tiles_without_the_channel_say_so(tmp_path):
    tiles = TiledMap.split(LardHilbertMap(3).double().fit(*wall(), 40), tmp_path / "tiles", 1.0)
    with pytest.raises(ValueError, match="must have the channel 'class'; it has none"):
        tiles.class_log_odds(surface_points())
    assert tiles.classes == []
    assert "channels" not in (tmp_path / "tiles" / "manifest.json").read_text()


def colored_pieces(count=400, seed=0):
    """Rays of the room in pieces; the last one has an intensity and another class beside colors."""
    *first, last = room_pieces(count, seed=seed)
    channels = {**last.channels, "intensity": last.channels["color"].mean(dim=1)}
    channels["class"] = torch.where(channels["class"] == 3, 77, channels["class"])
    return [*first, Scans(last.origins, last.ends, last.scan_id, last.is_return, None, channels)]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Pieces of scans, and the folder of their tiles."""
    pieces, folder = colored_pieces(), tmp_path_factory.mktemp("colored") / "tiles"
    tile_scans(pieces, folder, CONFIG)
    fit_tiles(folder)
    return pieces, folder


def expected_sums(pieces):
    """Sums of the channels of all training hits, and their number."""
    sums = {}
    for number, piece in enumerate(pieces):
        samples = sample_rays(piece, seed=number)
        for name in samples.channels:
            values = samples.channels[name][samples.labels == 1].double()
            values = values.reshape(len(values), -1)
            if name == "class":
                values = torch.nn.functional.one_hot(values[:, 0].long(), 100).double()
            sums[name] = sums.get(name, 0) + values[~values.isnan().any(dim=1)].sum(dim=0)
    return sums


def assert_all_hits_are_counted(tiles, pieces):
    expected = expected_sums(pieces)
    assert set(tiles.channels) == {"color", "intensity", "class"}
    for name, found in tiles.channels.items():
        wanted = expected[name][list(found.classes)] if name == "class" else expected[name]
        torch.testing.assert_close(found.sums.sum(dim=0), wanted, rtol=1e-9, atol=1e-9)


def test_fitted_tiles_sum_up_every_hit_once(fitted):
    pieces, folder = fitted
    tiles = TiledMap.open(folder)
    assert_all_hits_are_counted(tiles, pieces)
    assert 77 in tiles.classes
    hits = torch.cat([piece.hits for piece in pieces])[:500]
    truth = torch.cat([piece.channels["color"][piece.is_return] for piece in pieces])[:500]
    errors = (channel(tiles, hits, "color") - truth).abs()
    one = LardHilbertMap(3)
    samples = [sample_rays(piece, seed=n) for n, piece in enumerate(pieces)]
    given = [torch.cat([getattr(s, name) for s in samples]) for name in ("points", "labels")]
    colors = torch.cat([s.channels["color"] for s in samples])
    one.fit(*given, channels={"color": colors})
    assert errors.nanmean() < 1.1 * (one.channel(hits, "color") - truth).abs().mean()
    assert errors.isnan().any(dim=1).float().mean() < 0.05


def test_tiles_are_meshed_in_class(tmp_path):
    tiles = TiledMap.split(colored_map(), tmp_path / "tiles", 1.0)
    mesh = extract_mesh(tiles, 0.1, color="class")
    vertices = torch.tensor(np.array(mesh.vertices))
    likely = tiles.merge().class_probability(vertices)
    numbers = torch.tensor(tiles.classes)[likely.argmax(dim=1)].numpy()
    labels = mesh.vertex_attributes["label"]
    assert (labels == numbers)[labels >= 0].mean() > 0.999
    assert (labels >= 0).mean() > 0.9


def test_scans_added_later_bring_their_channels(fitted, tmp_path):
    pieces, folder = fitted
    tile_scans(pieces[:2], tmp_path / "tiles", CONFIG)
    assert list(read_ledger(tmp_path / "tiles").channels) == ["color", "class"]
    add_scans(pieces[2:], tmp_path / "tiles")
    fit_tiles(tmp_path / "tiles")
    assert contents(tmp_path / "tiles", "values") == contents(folder, "values")
    assert_all_hits_are_counted(TiledMap.open(tmp_path / "tiles"), pieces)


def test_an_interrupted_tiling_ends_with_the_same_channels(fitted, tmp_path, monkeypatch):
    pieces, folder = fitted
    monkeypatch.setattr(routing, "BUFFER_BYTES", 1)

    def killed():
        yield pieces[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tile_scans(killed(), tmp_path / "tiles", CONFIG)
    assert read_ledger(tmp_path / "tiles").values
    some = next((tmp_path / "tiles" / "values").iterdir())
    some.write_bytes(some.read_bytes() + b"left by a killed run")
    tile_scans(pieces, tmp_path / "tiles", CONFIG)
    assert contents(tmp_path / "tiles", "values") == contents(folder, "values")


def test_joined_folders_have_the_channels_of_both(fitted, tmp_path):
    pieces, _ = fitted
    for name, some in (("a", pieces[2:]), ("b", pieces[:2])):
        tile_scans(some, tmp_path / name, CONFIG)
    join_folders(tmp_path / "a", tmp_path / "b", tmp_path / "both")
    fit_tiles(tmp_path / "both")
    joined = TiledMap.open(tmp_path / "both").channels
    samples = [sample_rays(piece, seed=n) for n, piece in enumerate(pieces[2:])]
    samples += [sample_rays(piece, seed=n) for n, piece in enumerate(pieces[:2])]
    hits = sum(int((some.labels == 1).sum()) for some in samples)
    assert float(joined["color"].counts.sum()) == pytest.approx(hits)
    assert float(joined["class"].sums.sum()) == pytest.approx(hits)


def test_tiles_with_different_classes_answer_together(tmp_path):
    """Folders far apart keep their tiles, each with the classes of its own scans."""
    folders = []
    for number, shift in enumerate((0.0, 100.0)):
        points, labels = wall(300, seed=number)
        classes = channels_of(points, labels)["class"][labels == 1] + 4 * number
        ends = points[labels == 1] + torch.tensor([shift, 0, 0])
        origins = ends.mean(dim=0, keepdim=True) - torch.tensor([0.5, 0, 0])
        scans = Scans(origins, ends, channels={"class": classes})
        folders.append(tmp_path / str(number))
        tile_scans([scans], folders[-1], CONFIG)
        fit_tiles(folders[-1])
    join_folders(*folders, tmp_path / "both")
    tiles = TiledMap.open(tmp_path / "both")
    assert tiles.classes == [3, 7, 11]
    middle = torch.tensor([[1.0, 0.5, 1.0], [101.0, 1.5, 1.0]], dtype=F64)
    assert tiles.class_probability(middle).argmax(dim=1).tolist() == [0, 2]
    merged = tiles.merge()
    torch.testing.assert_close(merged.class_probability(middle), tiles.class_probability(middle),
                               rtol=1e-4, atol=1e-4)  # fmt: skip


def test_damaged_channels_are_named(fitted, tmp_path):
    pieces, _ = fitted
    folder = tmp_path / "tiles"
    tile_scans(pieces, folder, CONFIG)
    victim = max((folder / "values").iterdir(), key=lambda path: path.stat().st_size)
    victim.write_bytes(victim.read_bytes()[:-9])
    with pytest.raises(ValueError, match=f"{victim.name} must hold .* bytes of channels"):
        fit_tiles(folder)


def test_a_tile_with_channels_that_the_manifest_lacks_is_damaged(tmp_path):
    model = colored_map()
    tiles = TiledMap.split(model.drop_channels(), tmp_path / "tiles", 5.0)
    index = next(iter(tiles.manifest.tiles))
    path = tile_path(tiles.folder, index)
    other = LardHilbertMap.load(path)
    points, labels, channels = colored_wall(100)
    other.fit(points, labels, len(other), channels=channels).save(path)
    from lardhm_torch.tiles.entries import tile_record

    entry = tile_record(LardHilbertMap.load(path), path, 1)
    changed = type(tiles.manifest)(**{**vars(tiles.manifest), "tiles": {index: entry}})
    with pytest.raises(DamagedTileError, match="channels must be those of the manifest"):
        TiledMap(tiles.folder, changed).merge()


def test_the_commands_keep_channels_in_tiles(tmp_path, capsys):
    from lardhm_torch import save_scans

    save_scans(colored_pieces()[2], tmp_path / "scans.npz")
    folder = tmp_path / "tiles"
    assert main(["tile", str(tmp_path / "scans.npz"), "-o", str(folder), "--edge", "4"]) == 0
    assert main(["fit-tiles", str(folder)]) == 0
    assert main(["info", str(folder)]) == 0
    assert "['color', 'class', 'intensity']" in capsys.readouterr().out
    np.save(tmp_path / "points.npy", colored_pieces()[2].hits[:20].numpy())
    words = ["query", folder, tmp_path / "points.npy", "-o", tmp_path / "c.npy"]
    assert main([*map(str, words), "--channel", "color"]) == 0
    assert np.load(tmp_path / "c.npy").shape == (20, 3)
    assert list(read_manifest(folder).channels) == ["color", "class", "intensity"]
    assert same_map(TiledMap.open(folder).merge(), TiledMap.open(folder).in_memory())
