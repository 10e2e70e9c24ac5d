"""Bad input of the command line: one line on standard error, and no file is lost."""

import os
import shutil

import numpy as np
import pytest
import torch
from command_runs import fails, room_folder, run

from lardhm_torch import LardHilbertMap, Scans, save_scans


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return room_folder(tmp_path_factory.mktemp("cli"))


def test_errors_are_one_line_and_old_files_stay(folder, capsys, tmp_path):
    (tmp_path / "broken.pt").write_bytes(b"not a map")
    (tmp_path / "old.npy").write_bytes(b"old")
    message = fails(capsys, "info", tmp_path / "broken.pt")
    assert "broken.pt must be a complete map file" in message
    assert "does not exist" in fails(capsys, "info", tmp_path / "none.pt")
    flat = tmp_path / "flat.npy"
    np.save(flat, np.zeros((4, 2)))
    message = fails(capsys, "query", folder / "map.pt", flat, "-o", tmp_path / "old.npy")
    assert "points must be (..., 3)" in message
    assert (tmp_path / "old.npy").read_bytes() == b"old"
    message = fails(capsys, "fit", folder / "train.npz", "--dim", 2, "-o", tmp_path / "m.pt")
    assert "last coordinate must be constant" in message
    message = fails(capsys, "fit", folder / "train.npz", "--dim", 5, "-o", tmp_path / "m.pt")
    assert "5 coordinates; got 3" in message
    assert not (tmp_path / "m.pt").exists()


@pytest.fixture(scope="module")
def bad(folder, tmp_path_factory):
    """A working folder with maps and scans, good ones and bad ones of every kind."""
    bad = tmp_path_factory.mktemp("bad")
    shutil.copy(folder / "map.pt", bad / "map.pt")
    shutil.copy(folder / "test.npz", bad / "scans.npz")
    (bad / "drive").mkdir()
    shutil.copy(folder / "test.npz", bad / "drive/0.npz")
    (bad / "nothing").mkdir()
    for name in ("broken.pt", "broken.npz", "broken.ply"):
        (bad / name).write_bytes(b"not what it seems")
    torch.save({"a": torch.zeros(3)}, bad / "other.pt")
    np.save(bad / "points.npy", np.random.default_rng(0).random((5, 3)))
    save_scans(Scans(torch.zeros(1, 3), torch.zeros(0, 3)), bad / "empty.npz")
    flat = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    save_scans(Scans(torch.zeros(1, 2), flat + 1), bad / "flat.npz")
    run("fit", bad / "flat.npz", "-o", bad / "flat.pt")
    LardHilbertMap().save(bad / "untrained.pt")
    run("tile", bad / "scans.npz", "--edge", 4, "-o", bad / "city")
    return bad


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


MAP_COMMANDS = (
    "query {} points.npy -o p.npy",
    "mesh {} -o m.ply --resolution 1",
    "grid {} -o g.npz --resolution 1",
    "render {} -o r.png --resolution 1",
    "view {} --export v.html --resolution 1",
    "evaluate {} scans.npz",
    "update {} scans.npz -o u.pt",
    "join {} map.pt -o j.pt",
    "join map.pt {} -o j.pt",
    "info {}",
    "fit-tiles {}",
)
SCAN_COMMANDS = (
    "split {} -o a.npz b.npz",
    "fit {} -o o.pt",
    "fit {} --tune -o o.pt",
    "fit {} --incremental -o o.pt",
    "update map.pt {} -o u.pt",
    "update city {}",
    "evaluate map.pt {}",
    "view map.pt {} --export v.html",
    "query map.pt {} -o p.npy",
    "tile {} -o t",
)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (command, name)
        for command in MAP_COMMANDS
        for name in ("missing.pt", "nothing", "broken.pt", "other.pt", "scans.npz")
        if (command.split()[0], name) != ("info", "scans.npz")  # info describes scans, too
    ],
)
def test_what_is_no_map_is_an_error_of_one_line(bad, monkeypatch, capsys, command, name):
    monkeypatch.chdir(bad)
    before = contents(bad)
    error = fails(capsys, *command.format(name).split())
    assert error.startswith(f"lardhm {command.split()[0]}: ")
    assert contents(bad) == before


@pytest.mark.parametrize("name", ["missing.npz", "nothing", "broken.npz", "broken.ply", "map.pt"])
@pytest.mark.parametrize("command", SCAN_COMMANDS)
def test_what_are_no_scans_is_an_error_of_one_line(bad, monkeypatch, capsys, command, name):
    monkeypatch.chdir(bad)
    before = contents(bad)
    assert name in fails(capsys, *command.format(name).split())
    assert contents(bad) == before


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("split empty.npz -o a.npz b.npz", "at least one point is needed"),
        ("fit empty.npz -o o.pt", "at least one point is needed"),
        ("update map.pt flat.npz -o u.pt", "3 coordinates; got 2"),
        ("update flat.pt scans.npz -o u.pt", "must be constant"),
        ("evaluate map.pt flat.npz", "3 coordinates; got 2"),
        ("query flat.pt points.npy -o p.npy", "points must be (..., 2)"),
        ("view map.pt flat.npz --export v.html", "3 coordinates; got 2"),
        ("join map.pt flat.pt -o j.pt", "same settings"),
        ("join map.pt city -o j.pt", "two map files or two tiled maps"),
        ("mesh flat.pt -o m.ply", "3-D map; got 2-D"),
        ("mesh untrained.pt -o m.ply", "it is empty"),
        ("mesh map.pt -o m.ply --resolution 0", "--resolution must be > 0 m"),
        ("mesh map.pt -o m.ply --resolution 1e-5", "resolution must be at least"),
        ("grid map.pt -o g.npz --resolution 1e-5", "resolution must be at least"),
        ("render map.pt -o r.png --slice 1 --resolution 1e-9", "resolution must be at least"),
        ("grid map.pt -o g.npz --resolution nan", "--resolution must be > 0 m"),
        ("view map.pt --export v.html --resolution inf", "--resolution must be > 0 m"),
        ("view map.pt --export v.html --port 99999", "--port must be 1 to 65535"),
        ("view map.pt --export v.html --host 203.0.113.1", "must be an address of this machine"),
        ("fit scans.npz -o o.pt --clusters 0", "num_clusters must be"),
        ("fit scans.npz -o o.pt --size 100B", "max_bytes must be a whole number"),
        ("fit scans.npz -o o.pt --size 2kB --clusters 9", "exclude each other"),
        ("fit scans.npz -o o.pt --clear-rays --small", "cannot be used with --size"),
        ("fit scans.npz -o o.pt --clear-rays --tune", "cannot be used with --size"),
        ("fit scans.npz -o o.pt --clear-rays --incremental", "omit --incremental"),
        (
            "fit scans.npz -o o.pt --size 2kB --tune",
            "--size and --small cannot be used with --tune",
        ),
        ("fit scans.npz -o o.pt --small --incremental", "cannot be used with --incremental"),
        ("fit scans.npz -o o.pt --neighbors 0", "num_neighbors must be"),
        ("fit scans.npz -o o.pt --dim 0", "0 coordinates; got 3"),
        ("fit scans.npz -o o.pt --resume", "need --incremental"),
        ("fit scans.npz -o o.pt --incremental --tune", "omit --incremental"),
        ("fit scans.npz -o map.pt --incremental --resume", "checkpoint of a stream"),
        ("fit scans.npz -o o.pt --tune-state map.pt", "must be a checkpoint of fine-tuning"),
        ("split scans.npz -o a.npz b.npz --ratio 1", "ratio must be"),
        ("simulate -o s.npz --rays 0", "num_rays must be"),
        ("update map.pt scans.npz", "--output is required"),
        ("update city scans.npz -o u.pt", "--output must be omitted"),
    ],
)
def test_bad_input_is_an_error_of_one_line(bad, monkeypatch, capsys, command, message):
    monkeypatch.chdir(bad)
    before = contents(bad)
    assert message in fails(capsys, *command.split())
    assert contents(bad) == before


@pytest.mark.parametrize("name", ["scans.xyz", "nothing", "none"])
@pytest.mark.parametrize(
    "command",
    [
        "simulate -o {}",
        "split scans.npz -o a.npz {}",
        "fit scans.npz -o {}",
        "fit scans.npz -o o.pt --tune-state {}",
        "update map.pt scans.npz -o {}",
        "query map.pt points.npy -o {}",
        "mesh map.pt -o {}",
        "grid map.pt -o {}",
        "render map.pt -o {}",
        "evaluate map.pt scans.npz --reliability {}",
        "view map.pt --export {}",
        "join map.pt map.pt -o {}",
    ],
)
def test_an_output_is_checked_before_anything_is_read(bad, monkeypatch, capsys, command, name):
    monkeypatch.chdir(bad)
    monkeypatch.setattr("lardhm_torch.io.scan_files.load_scans", None)  # would not be callable
    monkeypatch.setattr("lardhm_torch.io.map_files.load_state", None)
    option = command.split()[-2] if "--" in command else "--output"
    assert fails(capsys, *command.format(name).split()).startswith(
        f"lardhm {command.split()[0]}: {option} must end in ."
    )


def test_an_output_needs_an_existing_folder_and_is_no_folder(bad, monkeypatch, capsys):
    monkeypatch.chdir(bad)
    (bad / "folder.pt").mkdir()
    assert "in an existing folder" in fails(capsys, "fit", "scans.npz", "-o", "no/map.pt")
    assert "must be a file" in fails(capsys, "fit", "scans.npz", "-o", "folder.pt")
    assert "must be a folder" in fails(capsys, "tile", "scans.npz", "-o", "map.pt")
    (bad / "folder.pt").rmdir()


@pytest.mark.parametrize(
    "command",
    [
        "fit scans.npz -o scans.npz",
        "split scans.npz -o a.npz scans.npz",
        "split drive -o drive/0.npz a.npz",
        "split scans.npz -o a.npz a.npz",
        "query map.pt points.npy -o points.npy",
        "join map.pt map.pt -o map.pt",
        "join city city -o city",
        "tile drive -o drive",
        "tile scans.npz -o scans.npz",
        "fit scans.npz -o map.pt --tune-state map.pt",
        "update map.pt scans.npz -o scans.npz",
    ],
)
def test_an_input_is_never_overwritten(bad, monkeypatch, capsys, command):
    monkeypatch.chdir(bad)
    before = contents(bad)
    fails(capsys, *command.split())
    assert contents(bad) == before


def test_a_link_to_an_input_is_an_input(bad, monkeypatch, capsys):
    monkeypatch.chdir(bad)
    (bad / "link.npz").symlink_to("scans.npz")
    error = fails(capsys, "split", "scans.npz", "-o", "a.npz", "link.npz")
    assert "must not overwrite an input" in error
    (bad / "link.npz").unlink()


@pytest.mark.parametrize(
    ("command", "link"),
    [
        ("split scans.npz -o a.npz hard.npz", "scans.npz"),
        ("query map.pt points.npy -o ./drive/../points.npy", None),
        ("split drive -o drive/deep/hard.npz a.npz", "drive/0.npz"),
        ("fit scans.npz -o o.pt --tune-state hard.pt", None),
    ],
)
def test_other_names_of_an_input_are_that_input(bad, monkeypatch, capsys, command, link, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(bad, folder)
    monkeypatch.chdir(folder)
    (folder / "drive" / "deep").mkdir()
    for name in (word for word in command.split() if "hard" in word and link):
        os.link(link, name)
    if "--tune-state" in command:  # an output that is linked to the checkpoint
        (folder / "o.pt").write_bytes(b"old")
        os.link("o.pt", "hard.pt")
    before = contents(folder)
    assert "must not overwrite an input" in fails(capsys, *command.split())
    assert contents(folder) == before


def test_update_may_replace_its_own_map(bad, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    shutil.copy(bad / "map.pt", "map.pt")
    run("update", "map.pt", bad / "scans.npz", "-o", "map.pt")
    assert len(LardHilbertMap.load("map.pt")) >= len(LardHilbertMap.load(bad / "map.pt"))


def test_an_incremental_fit_needs_a_usable_ray(tmp_path, capsys):
    save_scans(Scans(torch.zeros(1, 3), torch.zeros(3, 3)), tmp_path / "short.npz")
    with pytest.warns(UserWarning, match="scan 0"):
        error = fails(
            capsys, "fit", tmp_path / "short.npz", "--incremental", "-o", tmp_path / "m.pt"
        )
    assert "SCANS must hold a usable ray" in error


def test_tiles_need_a_usable_ray(bad, tmp_path, capsys):
    error = fails(capsys, "tile", bad / "empty.npz", "-o", tmp_path / "t")
    assert "at least one usable ray" in error
