import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from command_runs import run
from small_maps import same_map, wall

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    StreamConfig,
    iter_scans,
    load_scans,
    resume_stream,
    save_scans,
    simulate_room,
    stream_scans,
)
from lardhm_torch.cli import main
from lardhm_torch.io.map_files import save_state
from lardhm_torch.streaming import Progress, real_time

STREAM = Path(__file__).parents[1] / "scripts" / "stream.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Nine scans of the simulated room, a file each."""
    folder = tmp_path_factory.mktemp("scans")
    for number in range(9):
        room = simulate_room(num_rays=3000, seed=number)
        scan = room.select(room.scan_id == number % 3)
        place = room.origins[number % 3][None]
        save_scans(Scans(place, scan.ends, None, scan.is_return), folder / f"scan_{number}.npz")
    return folder


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """The map of all scans in one go, through a file."""
    path = tmp_path_factory.mktemp("whole") / "map.pt"
    stream_scans(LardHilbertMap(), iter_scans(folder), path=path)
    return path


def test_scans_come_one_by_one_in_order_with_their_own_origin(folder):
    together, apart = load_scans(folder), list(iter_scans(folder))
    assert len(apart) == together.num_scans == 9
    assert torch.equal(torch.cat([scan.ends for scan in apart]), together.ends)
    assert torch.equal(torch.cat([scan.origins for scan in apart]), together.origins)
    assert all(scan.num_scans == 1 for scan in apart)


def test_a_stream_is_one_update_after_the_other(folder, whole):
    from lardhm_torch import sample_rays

    model = LardHilbertMap()
    for seed, scan in enumerate(iter_scans(folder)):
        samples = sample_rays(scan, seed=seed)
        model.update(samples.points, samples.labels, seed=seed, rays=scan)
    assert same_map(model, LardHilbertMap.load(whole))


@pytest.mark.parametrize("stop", [1, 4, 9])
def test_a_stream_that_stopped_goes_on_to_the_very_same_map(folder, whole, tmp_path, stop):
    path = tmp_path / "map.pt"

    def breaks():
        for number, scan in enumerate(iter_scans(folder)):
            if number == stop:
                raise KeyboardInterrupt
            yield scan

    try:
        stream_scans(LardHilbertMap(), breaks(), path=path)
    except KeyboardInterrupt:
        assert stop < 9
    (tmp_path / ".abcd4567.map.pt").write_bytes(b"half a map")
    (tmp_path / ".map.pt.backup").write_bytes(b"mine")
    (tmp_path / ".abcd4567.other.pt").write_bytes(b"of another writer")
    model, done = resume_stream(path)
    assert done.scans == stop
    left = {file.name for file in tmp_path.iterdir()}
    assert left == {"map.pt", ".map.pt.backup", ".abcd4567.other.pt"}
    assert stream_scans(model, iter_scans(folder), path=path, done=done).scans == 9
    assert same_map(LardHilbertMap.load(path), LardHilbertMap.load(whole))


def test_checkpoints_come_as_often_as_asked_and_at_the_end(folder, tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(
        "lardhm_torch.io.map_files.save_state",
        lambda state, path: saved.append(state["_stream"]["scans"]) or save_state(state, path),
    )
    config = StreamConfig(checkpoint_every=4)
    stream_scans(LardHilbertMap(), iter_scans(folder), config, path=tmp_path / "map.pt")
    assert saved == [4, 8, 9]


def test_fit_incremental_shows_the_map_after_every_scan(folder, tmp_path, monkeypatch):
    shown = []

    class Page:
        def update(self, model):
            shown.append(len(model))

        def close(self):
            shown.append("closed")

    monkeypatch.setattr("lardhm_torch.viewing.viewer.LiveView", Page)
    path = tmp_path / "map.pt"
    assert main(["fit", str(folder), "-o", str(path), "--incremental", "--view"]) == 0
    assert len(shown) == 10
    assert shown[-2:] == [len(LardHilbertMap.load(path)), "closed"]


def test_other_scans_than_those_of_the_checkpoint_are_refused(folder, whole):
    model, done = resume_stream(whole)
    files = sorted(folder.iterdir())
    with pytest.raises(ValueError, match="which holds 9; got 5"):
        stream_scans(model, iter_scans(files[:5]), done=done)
    more = Progress(done.scans, done.rays + 1)
    with pytest.raises(ValueError, match=f"{more.rays} rays in the first 9; got {done.rays}"):
        stream_scans(model, iter_scans(files), done=more)


def test_a_map_that_no_stream_wrote_cannot_be_resumed(tmp_path):
    path = tmp_path / "map.pt"
    LardHilbertMap().fit(*wall(), num_clusters=10).save(path)
    with pytest.raises(ValueError, match="must be the checkpoint of a stream; it is another map"):
        resume_stream(path)
    with pytest.raises(FileNotFoundError):
        resume_stream(tmp_path / "none.pt")


def test_a_scan_without_a_usable_ray_is_passed_over_with_a_warning(folder, whole):
    empty = Scans(torch.zeros(1, 3), torch.zeros(5, 3))
    model = LardHilbertMap()
    with pytest.warns(UserWarning, match="scan 0 was skipped: no usable ray"):
        seen = stream_scans(model, [empty, *iter_scans(folder)])
    assert seen.scans == 10
    assert len(model) > 0


def test_a_stream_with_a_radius_forgets_what_is_far_from_the_sensor():
    def drive():
        for number in range(6):
            ends = wall(100, seed=number, at=3.0 + 10 * number)[0][:100]
            yield Scans(torch.tensor([[10.0 * number, 1.0, 1.0]]), ends)

    model = LardHilbertMap()
    stream_scans(model, drive(), StreamConfig(radius=12.0))
    assert model.centers[:, 0].min() + model.origin[0] >= 50 - 12


def test_the_real_time_setting_learns_the_same_room_with_fewer_points(folder, whole):
    from lardhm_torch.evaluation.held_out import evaluate

    model = LardHilbertMap()
    stream_scans(model, iter_scans(folder), real_time())
    scans = load_scans(folder)
    with torch.no_grad():
        fast, full = (evaluate(m, scans)["unif"] for m in (model, LardHilbertMap.load(whole)))
    assert fast["balanced_accuracy"] > full["balanced_accuracy"] - 0.02


def test_a_limit_of_clusters_holds_for_every_scan_and_changes_nothing_below_it(folder, whole):
    first = list(iter_scans(folder))[:1]
    limited, free, high = LardHilbertMap(), LardHilbertMap(), LardHilbertMap()
    stream_scans(limited, first, StreamConfig(max_clusters=40))
    stream_scans(free, first)
    stream_scans(high, first, StreamConfig(max_clusters=100_000))
    assert len(limited) <= 40 < len(free)
    assert same_map(high, free)


@pytest.mark.parametrize(
    "name", ["num_clusters", "max_clusters", "max_rays", "radius", "checkpoint_every"]
)
def test_settings_are_checked_when_made(name):
    with pytest.raises(ValueError, match=f"{name} must be > 0; got 0"):
        StreamConfig(**{name: 0})


# --- the command line and the script ---


def test_fit_incremental_and_its_resume_are_the_stream(folder, whole, tmp_path, capsys):
    path = tmp_path / "map.pt"
    run("fit", folder, "--incremental", "-o", path)
    assert same_map(LardHilbertMap.load(path), LardHilbertMap.load(whole))
    run("fit", folder, "--incremental", "--resume", "-o", path)
    assert capsys.readouterr().out.count("9 scans") == 2
    assert same_map(LardHilbertMap.load(path), LardHilbertMap.load(whole))


def test_update_adds_scans_to_a_map_and_query_reads_it(folder, tmp_path, capsys):
    path, more = tmp_path / "map.pt", tmp_path / "more.pt"
    files = sorted(folder.iterdir())
    run("fit", files[0], "-o", path)
    run("update", path, *files[1:3], "-o", more)
    assert len(LardHilbertMap.load(more)) > len(LardHilbertMap.load(path))
    assert "2 scans" in capsys.readouterr().out


def test_what_does_not_go_together_is_refused(folder, tmp_path, capsys):
    for words in (["--incremental", "--tune"], ["--resume"], ["--radius", "5"]):
        assert main(["fit", str(folder), "-o", str(tmp_path / "map.pt"), *words]) == 1
        assert "--incremental" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [0, 1])
def test_a_stream_killed_at_any_moment_ends_as_if_it_had_not_been(folder, whole, tmp_path, seed):
    """`make soak` kills 50 times; here it is a few, at seeded moments."""
    rng = torch.Generator().manual_seed(seed)
    path = tmp_path / "map.pt"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for attempt in range(4):
        words = [str(folder), str(path), *(["--resume"] if path.exists() else [])]
        process = subprocess.Popen(
            [sys.executable, str(STREAM), *words], stdout=subprocess.PIPE, env=environment
        )
        while process.poll() is None and not path.exists():
            time.sleep(0.01)
        if attempt == 3:
            process.communicate()
            break
        if path.exists() and attempt:
            process.stdout.readline()  # it is past its imports
        time.sleep(float(torch.rand(1, generator=rng)) * 0.3)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        resume_stream(path)  # the file is whole
        assert list(tmp_path.iterdir()) == [path]
    assert process.returncode == 0
    assert same_map(LardHilbertMap.load(path), LardHilbertMap.load(whole))
