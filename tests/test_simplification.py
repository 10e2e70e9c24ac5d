import sys

import numpy as np
import pytest
import trimesh
from small_maps import ball

from lardhm_torch import cli, extract_mesh, simplify_mesh


@pytest.fixture
def needs_library():
    pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")


@pytest.mark.parametrize("shift", [0.0, 4.5e6])
def test_a_sphere_of_fewer_faces_is_closed_round_and_keeps_its_colors(needs_library, shift):
    mesh = trimesh.creation.icosphere(5)  # 20,480 faces
    mesh.apply_translation([0, shift, 0])
    left = mesh.vertices[:, 0] < 0
    mesh.visual.vertex_colors = np.where(left[:, None], [10, 200, 30, 255], [9, 9, 9, 255])
    fewer = simplify_mesh(mesh, 2000)
    assert 1000 < len(fewer.faces) <= 2000
    assert len(mesh.faces) == 20_480
    assert fewer.is_watertight
    assert np.abs(np.linalg.norm(fewer.vertices - [0, shift, 0], axis=1) - 1).max() < 0.02
    right = fewer.vertices[:, 0] > 0.05
    assert (fewer.visual.vertex_colors[right] == [9, 9, 9, 255]).all()
    assert simplify_mesh(mesh, 30_000) is mesh


def test_what_is_closed_stays_closed(needs_library):
    mesh = extract_mesh(ball(), 0.02, 0.73, surface="crossing", log_odds_margin=None, color=None)
    fewer = simplify_mesh(mesh, 500)
    assert mesh.is_watertight
    assert fewer.is_watertight
    assert fewer.volume == pytest.approx(mesh.volume, rel=0.02)


def test_bad_counts_and_a_missing_library_are_errors(monkeypatch):
    mesh = trimesh.creation.icosphere(2)
    with pytest.raises(ValueError, match="num_faces must be at least 1; got 0"):
        simplify_mesh(mesh, 0)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ImportError, match=r"lardhm_torch\[view\]"):
        simplify_mesh(mesh, 10)


def test_the_command_writes_about_so_many_faces(needs_library, tmp_path, capsys):
    from small_maps import wall_map

    wall_map().save(tmp_path / "map.pt")
    command = ["mesh", str(tmp_path / "map.pt"), "-o", str(tmp_path / "m.ply"), "--faces"]
    assert cli.main([*command, "200"]) == 0
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    assert 100 < len(mesh.faces) <= 200
    assert cli.main([*command, "0"]) == 1
    assert "--faces must be at least 1; got 0" in capsys.readouterr().err
