"""What readers say they assumed, sampling from the command line, and numbers that are negative."""

import argparse
import json
import re

import numpy as np
import pytest
import torch
from command_runs import fails, run
from room_scan import POSITION, sensor_points, with_zeros, world_points
from scan_files import pcd_header

from lardhm_torch import (
    LardHilbertMap,
    ScanReport,
    Scans,
    iter_scans,
    load_scans,
    save_scans,
    simulate_room,
)
from lardhm_torch.cli import main
from lardhm_torch.cli.scan_files import iter_pieces_of
from lardhm_torch.io.notes import Note
from lardhm_torch.io.scan_files import Reading, iter_pieces
from lardhm_torch.scans import every_scan, thin_rays


@pytest.fixture
def folder(tmp_path):
    """Two clouds with VIEWPOINT, one of them with points at zero."""
    for name, points in (("a", world_points()), ("b", with_zeros(world_points()))):
        header = pcd_header("binary", 240, viewpoint="1.5 -0.75 1.25 1 0 0 0")
        (tmp_path / f"{name}.pcd").write_bytes(header + points.astype("<f8").tobytes())
    return tmp_path


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The simulated room as a file."""
    path = tmp_path_factory.mktemp("report") / "room.npz"
    save_scans(simulate_room(num_rays=3000, seed=1), path)
    return path


@pytest.mark.filterwarnings("ignore::lardhm_torch.io.notes.ScanFileWarning")
@pytest.mark.parametrize(
    "read",
    [
        lambda folder, report: load_scans(folder, report=report),
        lambda folder, report: list(iter_scans(folder, report=report)),
        lambda folder, report: list(iter_pieces(folder, Reading(report=report))),
    ],
)
def test_a_report_counts_files_scans_rays_and_says_what_was_assumed(folder, read):
    report = ScanReport()
    read(folder, report)
    line = str(report)
    assert line.startswith("2 files: 2 scans, 400 rays; sensor at (1.5, -0.75, 1.25) m; ")
    assert "sensor position from VIEWPOINT; " in line
    assert '(guess: frame="world" confirms it' in line
    assert "80 points at exactly zero are left out (no measurement) (in 1 of them)" in line
    assert "\n" not in line


def test_pieces_of_one_file_count_as_one_file(tmp_path):
    report, scans = ScanReport(), Scans(torch.zeros(1, 3), torch.ones(4, 3))
    for _ in range(3):
        report.add(tmp_path, scans, [Note("points were left out", 2)])
    assert (len(report.files), report.num_scans, report.num_rays) == (1, 1, 12)
    assert report.notes == [Note("points were left out", 6)]


def test_info_prints_what_readers_assume_and_strict_refuses_it(folder, capsys):
    run("info", folder)
    line = capsys.readouterr().out
    assert len(line.splitlines()) == 1
    assert "2 scans, 400 rays" in line
    assert "(guess: " in line
    run("info", folder, "--json")
    table = json.loads(capsys.readouterr().out)
    assert (table["scans"], table["rays"]) == (2, 400)
    assert [note["count"] for note in table["notes"] if "zero" in note["text"]] == [80]
    assert "strict reading refuses a guess" in fails(capsys, "info", folder, "--strict")
    run("info", folder, "--strict", "--frame", "world")


def test_info_still_describes_maps(room, tmp_path, capsys):
    run("fit", room, "--clusters", 20, "-o", tmp_path / "map.pt")
    capsys.readouterr()
    run("info", tmp_path / "map.pt")
    assert re.search(r"clusters +20\n", capsys.readouterr().out)
    assert "PATH must be one map" in fails(capsys, "info", tmp_path / "map.pt", tmp_path / "map.pt")


def test_verbs_that_read_scans_end_with_what_was_assumed(folder, tmp_path, capsys):
    run("split", folder, "-o", tmp_path / "a.npz", tmp_path / "b.npz")
    out, err = capsys.readouterr()
    assert "200 rays" in out
    assert err.startswith("2 files: 2 scans, 400 rays")


@pytest.mark.parametrize("origin", ["-1,-2.5,3", "-1,2,3", "-.5,0,0", "-1e2,-1,-1"])
@pytest.mark.parametrize("joined", [True, False])
def test_negative_numbers_may_follow_an_option(tmp_path, origin, joined):
    np.savetxt(tmp_path / "a.xyz", sensor_points())
    words = [f"--origin={origin}"] if joined else ["--origin", origin]
    run("split", tmp_path / "a.xyz", *words, "-o", tmp_path / "a.npz", tmp_path / "b.npz")
    expected = [float(word) for word in origin.split(",")]
    assert load_scans(tmp_path / "a.npz").origins.tolist() == [expected]


def test_a_camera_may_have_a_negative_fy(tmp_path, capsys):
    np.savetxt(tmp_path / "a.xyz", sensor_points())
    words = ["--camera", "-481.2,480,319.5,239.5", "--origin", "0,0,0"]
    error = fails(capsys, "fit", tmp_path / "a.xyz", *words, "-o", tmp_path / "map.pt")
    assert "intrinsics must give fx, fy > 0" in error


def test_hits_beyond_the_maximum_range_are_counted_in_the_line_of_fit(room, tmp_path, capsys):
    scans = load_scans(room)
    far = int((scans.is_return & (scans.ranges > 2.5)).sum())
    near = int((scans.is_return & (scans.ranges <= 2.5) & (scans.ranges >= 0.3)).sum())
    assert 0 < far < near
    words = [room, "--max-range", 2.5, "--clusters", 50]
    run("fit", *words, "-o", tmp_path / "map.pt")
    out, err = capsys.readouterr()
    assert out.startswith(f"{near} hits and ")
    assert f"; {far} hits beyond 2.5 m (no hit" in out
    assert f"{far} rays: hits beyond 2.5 m (no hit, free space kept)\n" in err
    run("fit", *words, "--incremental", "-o", tmp_path / "stream.pt")
    assert f"; {far} hits beyond 2.5 m (no hit" in capsys.readouterr().out
    run("fit", room, "--clusters", 50, "-o", tmp_path / "map.pt")
    assert "hits beyond" not in "".join(capsys.readouterr())


def test_scans_whose_hits_are_all_too_far_away_make_no_map(tmp_path, capsys):
    np.savetxt(tmp_path / "a.xyz", sensor_points() + np.array([500_000, 4_500_000, 100]))
    words = ["fit", tmp_path / "a.xyz", "--origin", "0,0,0", "-o", tmp_path / "map.pt"]
    error = fails(capsys, *words)
    assert "240 of 240 hits are farther than max_range = 100 m" in error
    assert "correct the sensor positions (`lardhm info SCANS` prints them)" in error
    assert not (tmp_path / "map.pt").exists()


def test_a_minimum_range_drops_shorter_rays(room, tmp_path, capsys):
    short = int((load_scans(room).ranges < 1.5).sum())
    assert short > 0
    run("fit", room, "--min-range", 1.5, "--clusters", 20, "-o", tmp_path / "map.pt")
    assert f"{short} rays: shorter than 1.5 m" in capsys.readouterr().err


@pytest.mark.parametrize("incremental", [[], ["--incremental"]])
def test_every_takes_some_scans_and_voxel_some_rays(room, tmp_path, capsys, incremental):
    scans = load_scans(room)
    kept = thin_rays(every_scan(scans, 2), 0.25)
    words = [*incremental, "--every", 2, "--voxel", 0.25, "--clusters", 20]
    run("fit", room, *words, "-o", tmp_path / "map.pt")
    out = capsys.readouterr().out
    if incremental:
        assert out.startswith(f"2 scans, {len(kept)} rays")
    else:
        assert out.startswith(f"{int(kept.is_return.sum())} hits")
    assert len(LardHilbertMap.load(tmp_path / "map.pt")) > 0


def test_every_second_scan_is_numbered_anew():
    scans = simulate_room(num_rays=300, seed=0)
    kept = every_scan(scans, 2)
    assert kept.num_scans == 2
    for number in range(2):
        expected = scans.ends[scans.scan_id == 2 * number]
        assert torch.equal(kept.ends[kept.scan_id == number], expected)
        assert torch.equal(kept.origins[number], scans.origins[2 * number])


@pytest.mark.parametrize("voxel", [0.05, 0.3, 2.0, 1e9])
@pytest.mark.parametrize("shift", [0.0, 4_500_000.0])
def test_thinning_keeps_the_first_ray_of_every_voxel_and_scan(voxel, shift):
    scans = simulate_room(num_rays=2000, seed=0)
    scans = Scans(scans.origins + shift, scans.ends + shift, scans.scan_id, scans.is_return)
    seen, expected = set(), []
    cells = (scans.ends / voxel).floor().tolist()
    rows = zip(cells, scans.scan_id.tolist(), scans.is_return.tolist(), strict=True)
    for ray, (cell, scan, is_return) in enumerate(rows):
        key = (*cell, scan, is_return)
        if key not in seen:
            expected.append(ray)
        seen.add(key)
    assert torch.equal(thin_rays(scans, voxel).ends, scans.ends[expected])


def test_thinning_keeps_rays_that_are_not_finite_and_needs_a_size():
    scans = Scans(torch.zeros(1, 2), torch.tensor([[1.0, 1.0], [float("nan"), 1.0], [1.1, 1.1]]))
    assert len(thin_rays(scans, 1.0)) == 2
    assert thin_rays(scans, None) is scans
    with pytest.raises(ValueError, match="voxel must be > 0 m and finite; got 0"):
        thin_rays(scans, 0)


def test_every_is_refused_where_files_are_read_in_pieces():
    with pytest.raises(ValueError, match="--every cannot be used with tiled maps"):
        next(iter_pieces_of(argparse.Namespace(every=2)))


@pytest.mark.parametrize(
    "words",
    [
        "tile --every 2",
        "fit --every 0",
        "fit --voxel -1",
        "tile --voxel 0",
        "info --depth-scale inf",
    ],
)
def test_options_that_a_verb_lacks_and_wrong_numbers_are_refused_by_the_parser(words, capsys):
    verb, *option = words.split()
    with pytest.raises(SystemExit):
        main([verb, "scans.npz", *option] + ([] if verb == "info" else ["-o", "out"]))
    assert option[0] in capsys.readouterr().err


def test_origins_of_positions_are_read_as_given(tmp_path):
    np.savetxt(tmp_path / "a.xyz", world_points())
    report = ScanReport()
    scans = load_scans(tmp_path / "a.xyz", origin=POSITION, report=report, strict=True)
    assert scans.origins.tolist() == [POSITION.tolist()]
    assert "sensor position as given (origin)" in str(report)
