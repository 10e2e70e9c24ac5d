import argparse
import json
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
import trimesh
from command_runs import fails, room_folder, run
from healthy_files import BagMaker, bag_messages

from lardhm_torch import LardHilbertMap, Scans, load_scans, save_scans, signed_distance
from lardhm_torch.cli import main
from lardhm_torch.cli.parser import make_parser
from lardhm_torch.io.map_files import save_state


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return room_folder(tmp_path_factory.mktemp("cli"))


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


def test_grid_writes_distances_and_fit_the_uncertainty(folder, capsys):
    words = ("grid", folder / "map.pt", "--resolution", "0.5", "--distance")
    run(*words, "-o", folder / "far.npz")
    with np.load(folder / "far.npz") as cells:
        lower = cells["lower"] + 0.5 * cells["resolution"]
        model = LardHilbertMap.load(folder / "map.pt")
        assert cells["distance"][0, 0, 0] == pytest.approx(float(signed_distance(model, lower)))
    assert main([str(word) for word in (*words, "-o", folder / "map.bt")]) != 0
    assert "--output must end in .npz with --distance" in capsys.readouterr().err
    run("fit", folder / "train.npz", "--uncertainty", "-o", folder / "unsure.pt")
    model = LardHilbertMap.load(folder / "unsure.pt")
    assert (model.posterior_variances > 0).all()


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
    assert "--reliability must end in .png; got" in fails(capsys, *bad)


def test_tuning_that_was_interrupted_goes_on_from_its_state(folder, monkeypatch):
    words = ("fit", folder / "train.npz", "--clusters", 60)
    run(*words, "--tune", "-o", folder / "whole.pt")

    def interrupt(state, path):
        save_state(state, path)
        if state.get("epoch") == 2:
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


def test_fit_makes_a_map_of_a_size_and_one_with_trained_shapes(folder):
    run("fit", folder / "train.npz", "--size", "2kB", "-o", folder / "sized.pt")
    run("pack", folder / "sized.pt", "-o", folder / "sized.lhm")
    assert 1700 < (folder / "sized.lhm").stat().st_size <= 2000
    run("fit", folder / "train.npz", "--small", "-o", folder / "trained.pt")
    small, default = (LardHilbertMap.load(folder / name) for name in ("trained.pt", "map.pt"))
    assert torch.equal(default.centers, default.means)
    assert not torch.allclose(small.centers, small.means)
    assert len(small) < len(default)


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


def test_a_warning_is_one_line_without_its_source(capsys, monkeypatch):
    def info(arguments):
        """Show what a warning would look like."""
        print(warnings.formatwarning("two\nlines", UserWarning, "file.py", 1), end="")

    usual = warnings.formatwarning
    monkeypatch.setattr("lardhm_torch.cli.queries.info", info)
    run("info", "map.pt")
    assert capsys.readouterr().out == "lardhm info: warning: two lines\n"
    assert warnings.formatwarning is usual


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["fly"],
        ["fit"],
        ["fit", "a.npz", "-o", "m.pt", "--origin", "x"],
        ["render", "m.pt", "-o", "a.png", "--slice", "nan"],
    ],
)
def test_an_invalid_command_line_exits_with_code_2(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_every_option_says_its_default():
    parser = make_parser()
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices
    for verb, sub in verbs.items():
        assert re.fullmatch(r"[A-Z].*\.", sub.description), verb
        for action in sub._actions:
            assert action.help, f"{verb} {action.dest}"
            if action.default not in (None, False, argparse.SUPPRESS, []):
                default = str(action.default).removesuffix(".0")
                assert f"(default: {default})" in action.help % vars(action), action.dest


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
