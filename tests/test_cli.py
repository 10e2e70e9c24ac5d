import json
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh
from healthy_files import BagMaker, bag_messages

from lardhm_torch import LardHilbertMap, Scans, load_scans, save_scans
from lardhm_torch.cli import main
from lardhm_torch.io.map_files import save_state


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small simulated room, split, and a map of its training half."""
    folder = tmp_path_factory.mktemp("cli")
    run("simulate", "--rays", "6000", "-o", folder / "room.npz")
    run("split", folder / "room.npz", "-o", folder / "train.npz", folder / "test.npz")
    run("fit", folder / "train.npz", "-o", folder / "map.pt")
    return folder


def run(*words):
    assert main([str(word) for word in words]) == 0


def fails(capsys, *words):
    """The one line that a verb prints when it fails."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    return err


def test_split_shares_the_rays_out(folder):
    parts = [load_scans(folder / name) for name in ("train.npz", "test.npz")]
    assert [len(part) for part in parts] == [3000, 3000]


def test_query_answers_in_the_order_of_the_points_as_float32(folder):
    points = load_scans(folder / "test.npz").ends
    np.save(folder / "points.npy", points.numpy())
    run("query", folder / "map.pt", folder / "points.npy", "-o", folder / "p.npy")
    answer = np.load(folder / "p.npy")
    assert answer.dtype == np.float32
    with torch.no_grad():
        expected = LardHilbertMap.load(folder / "map.pt")(points)
    np.testing.assert_array_equal(answer, expected.numpy())


def test_mesh_writes_a_surface(folder, capsys):
    run("mesh", folder / "map.pt", "-o", folder / "mesh.ply", "--resolution", "0.1")
    assert (folder / "mesh.ply").stat().st_size > 10_000
    assert "faces" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_mesh_writes_the_format_of_the_extension(folder, suffix):
    run("mesh", folder / "map.pt", "-o", folder / f"mesh.{suffix}", "--resolution", "0.2")
    assert len(trimesh.load(folder / f"mesh.{suffix}", force="mesh").faces) > 1000


def test_grid_writes_probabilities_or_an_octomap(folder, capsys, tmp_path):
    run("grid", folder / "map.pt", "-o", folder / "grid.npz", "--resolution", "0.5")
    with np.load(folder / "grid.npz") as cells:
        assert cells["probability"].ndim == 3
        assert f"{cells['probability'].size} cells of 0.5 m" in capsys.readouterr().out
    pytest.importorskip("octomap", reason="octomap-python is not installed (extra octomap)")
    run("grid", folder / "map.pt", "-o", folder / "map.bt", "--resolution", "0.5")
    assert (folder / "map.bt").read_bytes().startswith(b"# Octomap OcTree binary file")


def test_maps_in_safetensors_are_maps_as_others(folder, capsys):
    pytest.importorskip("safetensors", reason="safetensors is not installed (extra io)")
    run("fit", folder / "train.npz", "--clusters", 50, "-o", folder / "map.safetensors")
    run("evaluate", folder / "map.safetensors", folder / "test.npz")
    run("info", folder / "map.safetensors", "--json")
    assert "clusters" in capsys.readouterr().out


def test_a_bag_of_a_robot_makes_a_map(folder, tmp_path, capsys):
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")
    scans, maker = load_scans(folder / "train.npz"), BagMaker(is_ros1=False)
    poses = np.tile(np.eye(4), (scans.num_scans, 1, 1))
    poses[:, :3, 3] = scans.origins
    local = [
        (scans.ends[scans.scan_id == number] - scans.origins[number]).numpy()
        for number in range(scans.num_scans)
    ]
    messages = bag_messages(maker, local, poses)
    messages.append(maker.pose(poses[0], 100.0, topic="/goal"))
    maker.write(tmp_path / "robot.mcap", messages)
    error = fails(capsys, "fit", tmp_path / "robot.mcap", "-o", tmp_path / "map.pt")
    assert "2 topics hold poses" in error
    assert "--topic" in error
    words = [tmp_path / "robot.mcap", "--topic", "/odom", "-o", tmp_path / "map.pt"]
    run("fit", *words, "--clusters", 100)
    run("evaluate", tmp_path / "map.pt", folder / "test.npz", "--json")
    table = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert table["unif"]["balanced_accuracy"] > 0.9


def test_depth_images_make_a_map(data, tmp_path):
    pytest.importorskip("PIL", reason="pillow is not installed (extra io)")
    frames = data / "sevenscenes_rgbd/frames"
    options = ["--camera", "585,585,320,240", "--pixel-step", 20]
    run("fit", frames, *options, "--clusters", 100, "-o", tmp_path / "map.pt")
    run("info", tmp_path / "map.pt")
    assert 0 < len(LardHilbertMap.load(tmp_path / "map.pt")) <= 100


def test_scans_of_the_sensors_frame_are_moved_by_a_pose_file(tmp_path):
    np.savetxt(tmp_path / "a.xyz", [[1, 2, 3], [4, 5, 6]])
    np.savetxt(tmp_path / "poses.txt", [[1, 0, 0, 10, 0, 1, 0, 20, 0, 0, 1, 30]])
    words = ["--frame", "sensor", "-o", tmp_path / "one.npz", tmp_path / "two.npz"]
    run("split", tmp_path / "a.xyz", *words)
    ends = torch.cat([load_scans(tmp_path / name).ends for name in ("one.npz", "two.npz")])
    assert sorted(ends.tolist()) == [[11, 22, 33], [14, 25, 36]]


def test_evaluate_prints_a_table_or_json(folder, capsys):
    run("evaluate", folder / "map.pt", folder / "test.npz")
    assert "balanced_accuracy" in capsys.readouterr().out
    run("evaluate", folder / "map.pt", folder / "test.npz", "--json")
    table = json.loads(capsys.readouterr().out)
    assert table["unif"]["balanced_accuracy"] > 0.97


def test_evaluate_draws_reliability_diagrams(folder, capsys):
    run("evaluate", folder / "map.pt", folder / "test.npz", "--reliability", folder / "r.png")
    assert (folder / "r.png").read_bytes().startswith(b"\x89PNG")
    bad = ("evaluate", folder / "map.pt", folder / "test.npz", "--reliability", folder / "r.gif")
    assert "path must end in .png" in fails(capsys, *bad)


def test_tuning_that_was_interrupted_goes_on_from_its_state(folder, monkeypatch):
    words = ("fit", folder / "train.npz", "--clusters", 60)
    run(*words, "--tune", "-o", folder / "whole.pt")

    def interrupt(state, path):
        save_state(state, path)
        if state.get("epoch") == 5:
            raise KeyboardInterrupt

    kept = ("--tune-state", folder / "state.pt", "-o", folder / "resumed.pt")
    monkeypatch.setattr("lardhm_torch.io.map_files.save_state", interrupt)
    assert main([str(word) for word in (*words, *kept)]) == 130
    monkeypatch.undo()
    run(*words, *kept)
    whole, resumed = (LardHilbertMap.load(folder / name) for name in ("whole.pt", "resumed.pt"))
    assert torch.equal(whole.raw_scale_tril, resumed.raw_scale_tril)


def test_info_tells_what_the_map_holds(folder, capsys):
    run("info", folder / "map.pt", "--json")
    facts = json.loads(capsys.readouterr().out)
    assert facts["clusters"] == facts["occupied clusters"] + facts["free clusters"]
    assert facts["dim"] == 3
    run("info", folder / "map.pt")
    assert "clusters" in capsys.readouterr().out


def test_fit_takes_settings(folder):
    options = ["--clusters", 60, "--neighbors", 4, "--seed", 3]
    run("fit", folder / "train.npz", *options, "-o", folder / "small.pt")
    model = LardHilbertMap.load(folder / "small.pt")
    assert model.num_neighbors == 4
    assert 50 <= len(model) <= 60


def test_flat_scans_make_a_two_dimensional_map_on_request(tmp_path):
    angle = torch.linspace(0, 6.28, 800, dtype=torch.float64)
    ends = torch.stack([3 * angle.cos(), 2 * angle.sin(), torch.full_like(angle, 0.5)], dim=1)
    save_scans(Scans(torch.tensor([[0.0, 0, 0.5]]), ends), tmp_path / "flat.npz")
    run("fit", tmp_path / "flat.npz", "--dim", 2, "-o", tmp_path / "flat.pt")
    assert LardHilbertMap.load(tmp_path / "flat.pt").dim == 2
    run("evaluate", tmp_path / "flat.pt", tmp_path / "flat.npz")
    run("query", tmp_path / "flat.pt", tmp_path / "flat.npz", "-o", tmp_path / "p.npy")
    assert len(np.load(tmp_path / "p.npy")) == 800
    run("fit", tmp_path / "flat.npz", "-o", tmp_path / "solid.pt")
    assert LardHilbertMap.load(tmp_path / "solid.pt").dim == 3


def test_errors_are_one_line_and_old_files_stay(folder, capsys, tmp_path):
    (tmp_path / "broken.pt").write_bytes(b"not a map")
    (tmp_path / "old.npy").write_bytes(b"old")
    message = fails(capsys, "info", tmp_path / "broken.pt")
    assert "broken.pt must be a map file" in message
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


def test_help_needs_no_torch():
    code = (
        "import sys, lardhm_torch.cli as cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'numpy', 'sklearn'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "evaluate" in done.stdout


@pytest.mark.parametrize(
    "name", ["la3dm_sim_structured/pcd", "hilbert2015_intel/scans.npz", "tdtk_dat/scans.npz"]
)
def test_real_scans_go_through_every_verb(data, tmp_path, capsys, name):
    flat = ["--dim", 2] if "intel" in name else []
    scans = load_scans(data / name)
    if "intel" in name:
        scans = scans.drop_constant_column()
    keep = torch.randperm(len(scans), generator=torch.Generator().manual_seed(0))[:30000]
    save_scans(scans.select(keep.sort().values), tmp_path / "scans.npz")
    run("split", tmp_path / "scans.npz", "-o", tmp_path / "train.npz", tmp_path / "test.npz")
    run("fit", tmp_path / "train.npz", *flat, "-o", tmp_path / "map.pt")
    capsys.readouterr()
    run("evaluate", tmp_path / "map.pt", tmp_path / "test.npz", "--json")
    table = json.loads(capsys.readouterr().out)
    assert table["unif"]["balanced_accuracy"] > 0.9
    run("query", tmp_path / "map.pt", tmp_path / "test.npz", "-o", tmp_path / "p.npy")
    run("info", tmp_path / "map.pt")
    if not flat:
        run("mesh", tmp_path / "map.pt", "-o", tmp_path / "m.ply", "--resolution", "0.2")
