"""Tiles to maps: the same whoever does the work, and whole whatever happens."""

import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch
from room_tiles import CONFIG, contents, room_folder, room_pieces

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    SamplingConfig,
    Scans,
    load_scans,
    sample_rays,
    split_rays,
)
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.tiles import fitting
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.indexing import clusters_path, tile_path
from lardhm_torch.tiles.ledger import Counts, read_ledger
from lardhm_torch.tiles.manifest import read_manifest, write_manifest
from lardhm_torch.tiles.ranks import Ranks, one_thread
from lardhm_torch.tiles.routing import TilingConfig, add_scans, tile_scans
from lardhm_torch.tiles.tiled_map import TiledMap
from lardhm_torch.tiles.training import make_budget

CLI = ["-m", "lardhm_torch.cli", "fit-tiles"]
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A fitted room; read, never written."""
    folder = room_folder(tmp_path_factory.mktemp("tiles") / "room")
    fit_tiles(folder)
    return folder


def test_every_tile_with_points_has_a_map_of_clusters_of_its_core(fitted):
    manifest, ledger = read_manifest(fitted), read_ledger(fitted)
    assert list(manifest.tiles) == ledger.cores
    for index, entry in manifest.tiles.items():
        model = LardHilbertMap.load(tile_path(fitted, index))
        counts = ledger.tiles[index]
        assert entry.num_points == int(model.counts.sum()) == counts.core
        assert int(model.counts[model.is_occupied].sum()) == counts.hits
        lower = torch.tensor(manifest.origin) + manifest.edge * torch.tensor(index)
        means = model.means + model.origin
        assert bool(((means >= lower - 1e-5) & (means <= lower + manifest.edge + 1e-5)).all())
    assert not (fitted / "fitted").exists()


def test_the_result_does_not_depend_on_the_order_of_the_tiles(fitted, tmp_path, monkeypatch):
    take = Ranks.take
    monkeypatch.setattr(Ranks, "take", lambda self, name, work: take(self, name, work[::-1]))
    folder = room_folder(tmp_path / "room")
    fit_tiles(folder)
    assert contents(folder) == contents(fitted)


def test_two_ranks_under_torchrun_give_the_same_files_as_one(fitted, tmp_path):
    folder = room_folder(tmp_path / "room")
    command = [sys.executable, *TORCHRUN, "2", *CLI, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("tiles, ") == 1  # rank 0 alone says so
    assert contents(folder) == contents(fitted)


def test_a_map_of_tiles_is_as_good_as_one_map(tmp_path):
    (piece,) = room_pieces(6_000, 1)
    train, test = split_rays(piece, 0.5)
    samples = sample_rays(train)
    single = evaluate(LardHilbertMap().fit(samples.points, samples.labels), test)
    tile_scans([train], tmp_path / "room", TilingConfig(edge=5.0))
    fit_tiles(tmp_path / "room")
    tiled = evaluate(TiledMap.open(tmp_path / "room"), test)
    for kind in ("unif", "near"):
        lost = single[kind]["balanced_accuracy"] - tiled[kind]["balanced_accuracy"]
        assert lost < 0.01, kind  # 2,000 points a tile; real scans below are held to 0.002


@pytest.mark.parametrize(("name", "edge"), [("kitti00_mulls", 20.0), ("balm_realworld", 10.0)])
def test_real_scans_lose_nothing_by_being_cut_into_tiles(data, tmp_path, name, edge):
    rays = protocol_rays(load_scans(data / name / "scans.npz"), 120_000)
    train, test = split_rays(rays, 0.5)
    samples = sample_rays(train, SamplingConfig(behind_samples=0))  # tiles learn no unknown points
    single = evaluate(LardHilbertMap().fit(samples.points, samples.labels), test)
    tile_scans([train], tmp_path / name, TilingConfig(edge=edge))
    fit_tiles(tmp_path / name)
    tiled = evaluate(TiledMap.open(tmp_path / name), test)
    for kind in ("unif", "near"):
        lost = single[kind]["balanced_accuracy"] - tiled[kind]["balanced_accuracy"]
        assert lost < 0.002, kind


def test_a_failed_job_goes_on_where_it_was_and_changes_nothing_before(
    fitted, tmp_path, monkeypatch
):
    folder = room_folder(tmp_path / "room")
    before = read_manifest(folder)
    train, calls = fitting.train_tile, []

    def failing(*arguments):
        calls.append(arguments)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return train(*arguments)

    monkeypatch.setattr(fitting, "train_tile", failing)
    with pytest.raises(KeyboardInterrupt):
        fit_tiles(folder)
    assert read_manifest(folder) == before
    assert not list((folder / "tiles").iterdir())
    fit_tiles(folder)
    assert len(calls) == 5 + len(before.tiles or read_ledger(folder).cores) - 4
    assert contents(folder) == contents(fitted)


def test_a_job_that_failed_while_tiles_were_taken_over_goes_on(fitted, tmp_path, monkeypatch):
    folder = room_folder(tmp_path / "room")

    def fails(*_):
        raise OSError("disk full")

    monkeypatch.setattr(fitting, "write_manifest", fails)
    with pytest.raises(OSError, match="disk full"):
        fit_tiles(folder)
    monkeypatch.undo()
    fit_tiles(folder)
    assert contents(folder) == contents(fitted)


def test_what_a_killed_job_left_half_written_is_gone_at_the_end(fitted, tmp_path):
    folder = room_folder(tmp_path / "room")
    (folder / "clusters").mkdir()
    for name in ("clusters/.1ba2c849.1_-2_-1", ".00ffab12.manifest.json"):
        (folder / name).write_bytes(b"cut")
    (folder / ".notes").write_text("of someone else")
    fit_tiles(folder)
    (folder / ".notes").unlink()
    assert contents(folder) == contents(fitted)


@pytest.mark.parametrize(("seed", "launcher"), [(0, []), (1, [*TORCHRUN, "2"])])
def test_killed_at_a_random_moment_the_job_ends_with_the_same_files(
    fitted, tmp_path, seed, launcher
):
    folder = room_folder(tmp_path / "room")
    process = subprocess.Popen(
        [sys.executable, *launcher, *CLI, str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    while process.poll() is None and not (folder / "clusters").is_dir():
        time.sleep(0.01)
    time.sleep(random.Random(seed).uniform(0.0, 0.3))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # a session of its own: nothing else is in it
    process.wait()
    fit_tiles(folder)
    assert contents(folder) == contents(fitted)


def test_an_update_touches_only_the_tiles_of_its_scans(tmp_path):
    begin, more = room_pieces(pieces=2)
    far = Scans(begin.origins + 100, begin.ends + 100, begin.scan_id, begin.is_return)
    folder = room_folder(tmp_path / "room", [begin, far])
    fit_tiles(folder)
    before, known = contents(folder, "tiles"), read_manifest(folder)
    _, touched = add_scans([more], folder)
    fit_tiles(folder)
    after, manifest = contents(folder, "tiles"), read_manifest(folder)
    paths = {str(tile_path("", index)) for index in touched}
    assert 0 < len(paths) < len(after)
    assert {name for name in after if after[name] != before.get(name)} == paths
    assert {i: t for i, t in manifest.tiles.items() if i not in touched} == {
        i: t for i, t in known.tiles.items() if i not in touched
    }
    scratch = room_folder(tmp_path / "scratch", [begin, far, more])
    fit_tiles(scratch)
    anew = contents(scratch, "tiles")
    inner = [i for i in touched if neighbors(i) & set(manifest.tiles) <= set(touched)]
    names = [str(tile_path("", index)) for index in inner]
    assert names
    assert [after[name] for name in names] == [anew[name] for name in names]


def neighbors(index):
    steps = itertools.product((-1, 0, 1), repeat=len(index))
    return {tuple(i + s for i, s in zip(index, step, strict=True)) for step in steps}


def test_lost_and_damaged_tiles_are_fitted_again(fitted, tmp_path):
    folder = room_folder(tmp_path / "room")
    fit_tiles(folder)
    index, other = read_ledger(folder).cores[3:5]
    tile_path(folder, index).unlink()
    content = bytearray(tile_path(folder, other).read_bytes())
    content[len(content) // 2] ^= 1
    tile_path(folder, other).write_bytes(content)
    clusters_path(folder, index).write_bytes(b"cut by a power failure")
    fit_tiles(folder)
    assert contents(folder) == contents(fitted)


def test_nothing_is_done_where_all_tiles_are_fitted(fitted, monkeypatch):
    monkeypatch.setattr(fitting, "cluster_tile", None)
    monkeypatch.setattr(fitting, "train_tile", None)
    before = contents(fitted)
    fit_tiles(fitted)
    assert contents(fitted) == before


def test_double_precision_is_kept(tmp_path):
    folder = room_folder(tmp_path / "room", room_pieces(600, 1))
    write_manifest(folder, replace(read_manifest(folder), dtype="float64"))
    fit_tiles(folder)
    index = read_ledger(folder).cores[0]
    assert LardHilbertMap.load(tile_path(folder, index)).centers.dtype == torch.float64


def test_a_flat_map_of_free_space_alone_is_fitted(tmp_path):
    (piece,) = room_pieces(600, 1)
    flat = type(piece)(
        piece.origins[:, :2], piece.ends[:, :2], piece.scan_id, torch.zeros_like(piece.is_return)
    )
    tile_scans([flat], tmp_path / "flat", CONFIG)
    fit_tiles(tmp_path / "flat")
    probability = TiledMap.open(tmp_path / "flat")(flat.origins)
    assert bool((probability < 0.4).all())


def test_tiles_share_the_clusters_that_one_map_of_all_points_would_have():
    config = FitConfig(occupied_share=0.6)
    budget = make_budget({0: Counts(1500, 0), 1: Counts(0, 9000, 50)}, config)
    assert budget.num_clusters(Counts(1500, 0)) == (100, 0)
    assert budget.num_clusters(Counts(0, 9000, 50)) == (0, 100)
    assert budget.loss_factors == pytest.approx((0.4 * 10500 / 9000, 0.6 * 10500 / 1500))
    assert make_budget({0: Counts(5, 5)}, FitConfig(balance=False)).loss_factors == (1.0, 1.0)
    halves = make_budget({i: Counts(1500, 9000) for i in range(4)}, config)
    assert halves.num_clusters(Counts(1500, 9000)) == (100, 100)
    assert halves.num_clusters(Counts(7, 3)) == (1, 1)  # five points a cluster at least


def test_a_folder_must_be_routed_to_its_end(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"has no manifest\.json"):
        fit_tiles(tmp_path)
    folder = room_folder(tmp_path / "room", room_pieces(300))
    (folder / "samples.json").unlink()
    with pytest.raises(FileNotFoundError, match="must hold the training points of its tiles"):
        fit_tiles(folder)


def test_the_number_of_threads_is_given_back():
    before = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
