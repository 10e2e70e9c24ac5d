"""Two folders of tiles to one, and the verbs of the command line that make folders."""

from dataclasses import replace

import pytest
import torch
from room_tiles import CONFIG, EDGE, contents, room_folder, room_pieces

from lardhm_torch import LardHilbertMap, Scans, save_scans
from lardhm_torch.cli import main
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.folders import join_folders
from lardhm_torch.tiles.indexing import tile_path
from lardhm_torch.tiles.ledger import read_ledger
from lardhm_torch.tiles.manifest import read_manifest, write_manifest
from lardhm_torch.tiles.routing import TilingConfig, tile_scans
from lardhm_torch.tiles.tiled_map import TiledMap

FAR = torch.tensor([20 * EDGE, 0.0, 0.0], dtype=torch.float64)  # whole tiles


def moved(scans: Scans, by: torch.Tensor) -> Scans:
    return Scans(scans.origins + by, scans.ends + by, scans.scan_id, scans.is_return)


def test_two_robots_in_one_room_make_the_map_of_all_their_scans(tmp_path):
    pieces = room_pieces(pieces=2)
    folders = [room_folder(tmp_path / f"{i}", [piece]) for i, piece in enumerate(pieces)]
    fit_tiles(folders[0])
    before = [contents(folder) for folder in folders]
    kept = join_folders(*folders, tmp_path / "joined")
    assert not kept.tiles  # every tile has points of the other robot in or next to it
    fit_tiles(tmp_path / "joined")
    assert [contents(folder) for folder in folders] == before
    ledgers = [read_ledger(folder) for folder in (*folders, tmp_path / "joined")]
    for index, counts in ledgers[2].tiles.items():
        parts = [ledger.tiles[index].core for ledger in ledgers[:2] if index in ledger.tiles]
        assert counts.core == sum(parts)
    both, alone = TiledMap.open(tmp_path / "joined"), TiledMap.open(folders[0])
    hits = pieces[1].hits
    assert (both(hits) > 0.5).double().mean() > (alone(hits) > 0.5).double().mean()


def test_tiles_far_from_the_other_robot_stay_as_they_are(tmp_path):
    (piece,) = room_pieces(600, 1)
    folders = [
        room_folder(tmp_path / "here", [piece]),
        room_folder(tmp_path / "there", [moved(piece, FAR)]),
    ]
    for folder in folders:
        fit_tiles(folder)
    origins = [read_manifest(folder).origin for folder in folders]
    assert origins[0] != origins[1]  # each grid begins near its own first scan
    kept = join_folders(*folders, tmp_path / "joined")
    alone = [read_manifest(folder).tiles for folder in folders]
    assert 0 < len(kept.tiles) <= sum(map(len, alone))
    assert {entry.checksum for entry in kept.tiles.values()} <= {
        entry.checksum for tiles in alone for entry in tiles.values()
    }
    fit_tiles(tmp_path / "joined")
    joined = read_manifest(tmp_path / "joined")
    assert len(joined.tiles) == sum(map(len, alone))
    for index in kept.tiles:
        assert joined.tiles[index] == kept.tiles[index]
    points = torch.cat([piece.ends, piece.ends + FAR])
    assert (TiledMap.open(tmp_path / "joined")(points) > 0.5).double().mean() > 0.8


def test_tiles_of_the_second_folder_move_with_the_grid(tmp_path):
    (piece,) = room_pieces(600, 1)
    there = room_folder(tmp_path / "there", [moved(piece, 3 * FAR)])
    fit_tiles(there)
    joined = join_folders(room_folder(tmp_path / "here", [piece]), there, tmp_path / "joined")
    for index in joined.tiles:
        model = LardHilbertMap.load(tile_path(tmp_path / "joined", index))
        lower = torch.tensor(joined.origin) + EDGE * torch.tensor(index)
        means = model.means + model.origin
        assert bool(((means > lower - 1e-4) & (means < lower + EDGE + 1e-4)).all())


def test_folders_that_do_not_fit_together_are_refused(tmp_path):
    pieces = room_pieces(300, 1)
    first, second = (room_folder(tmp_path / name, pieces) for name in ("first", "second"))
    tile_scans(pieces, tmp_path / "coarse", TilingConfig(edge=5.0, halo=0.5))
    with pytest.raises(ValueError, match=r"the same edge; got 2\.5 and 5\.0"):
        join_folders(first, tmp_path / "coarse", tmp_path / "joined")
    manifest = read_manifest(second)
    write_manifest(second, replace(manifest, origin=(0.3, *manifest.origin[1:])))
    with pytest.raises(ValueError, match="tile borders at the same positions"):
        join_folders(first, second, tmp_path / "joined")
    with pytest.raises(ValueError, match="new or empty folder"):
        join_folders(first, first, second)
    with pytest.raises(FileNotFoundError, match=r"has no manifest\.json"):
        join_folders(first, tmp_path, tmp_path / "joined")


@pytest.fixture
def files(tmp_path):
    names = []
    for number, piece in enumerate(room_pieces(900)):
        names.append(str(tmp_path / f"scan_{number}.npz"))
        save_scans(piece, names[-1])
    return names


def test_the_verbs_make_a_map_of_tiles_and_add_to_it(tmp_path, files, capsys):
    folder = str(tmp_path / "room")
    assert main(["tile", *files[:2], "-o", folder, "--edge", str(EDGE), "--halo", "0.5"]) == 0
    assert "600 rays" in capsys.readouterr().out
    assert main(["fit-tiles", folder]) == 0
    assert f"tiles, {len(TiledMap.open(folder))} clusters" in capsys.readouterr().out
    fitted = read_manifest(folder)
    assert list(fitted.channels) == ["color", "class"]
    expected = room_manifest(tmp_path / "same", files[:2])
    assert fitted == replace(expected, tiles=fitted.tiles, channels=fitted.channels)
    assert main(["update", folder, files[2]]) == 0
    assert "tiles were updated" in capsys.readouterr().out
    assert read_ledger(folder).rays == 900


def room_manifest(folder, files):
    from lardhm_torch.io.scan_files import iter_pieces

    tile_scans(iter_pieces(files), folder, CONFIG)
    return read_manifest(folder)


def test_join_takes_two_folders_or_two_map_files(tmp_path, files, capsys):
    names = [str(tmp_path / name) for name in ("a", "b", "c")]
    for file, name in zip(files[:2], names, strict=False):
        assert main(["tile", file, "-o", name, "--edge", str(EDGE)]) == 0
        assert main(["fit", file, "-o", f"{name}.pt"]) == 0
    assert main(["join", *names[:2], "-o", names[2]]) == 0
    assert "of them unchanged" in capsys.readouterr().out
    assert len(TiledMap.open(names[2])) > 0
    assert main(["join", f"{names[0]}.pt", f"{names[1]}.pt", "-o", f"{names[2]}.pt"]) == 0
    assert len(LardHilbertMap.load(f"{names[2]}.pt")) > 0
    assert main(["join", names[0], f"{names[1]}.pt", "-o", names[2]]) == 1
    assert "two map files or two tiled maps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "elsewhere.pt"], "--output must be omitted"),
        (["--clusters", "5"], "--clusters, --radius and --max-age do not apply to tiled maps"),
    ],
)
def test_update_of_a_folder_refuses_what_it_cannot_do(tmp_path, files, capsys, options, message):
    folder = room_folder(tmp_path / "room", room_pieces(300, 1))
    assert main(["update", str(folder), files[0], *options]) == 1
    assert message in capsys.readouterr().err
    assert main(["update", str(tmp_path / "map.pt"), files[0]]) == 1
    assert "--output is required" in capsys.readouterr().err
