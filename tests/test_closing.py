"""Watertight meshes: closed, in place where something was measured, and closed when simplified."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from small_maps import GaussianMap, wall_map

from lardhm_torch import LardHilbertMap, cli, extract_mesh, sample_rays, save_mesh, simulate_room
from lardhm_torch.surfaces.marching import plain_march
from lardhm_torch.surfaces.simplification import _closed, simplify_mesh
from lardhm_torch.tiles import layout
from lardhm_torch.tiles.tiled_map import TiledMap


def is_closed(mesh):
    return mesh.is_watertight and mesh.is_winding_consistent


@pytest.fixture(scope="module")
def room():
    scans = simulate_room(6000, seed=0)
    samples = sample_rays(scans)
    return scans, LardHilbertMap().fit(samples.points, samples.labels)


def free_ball():
    """A ball of free space in the unknown: its boundary is known in closed form, nothing is measured."""
    return GaussianMap(torch.zeros(1, 3), 0.3 * torch.eye(3)[None], [-6.0])


def test_the_boundary_of_a_free_ball_closes_a_gap_everywhere():
    mesh = extract_mesh(free_ball(), 0.03, watertight=True)
    assert is_closed(mesh)
    assert mesh.volume < 0  # normals point into the free space
    radius = 0.3 * np.sqrt(2 * np.log(6.0))  # log-odds of -1, one margin below 1/2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), radius, atol=0.002)
    assert (mesh.vertex_attributes["closing"] == 1).all()
    assert (mesh.visual.vertex_colors[:, :3] == 150).all()


def test_bounds_close_the_surface_where_they_cut_it():
    bounds = [-1.0, -1.0, -1.0], [0.1, 1.0, 1.0]
    mesh = extract_mesh(free_ball(), 0.05, bounds=bounds, watertight=True)
    assert is_closed(mesh)
    radius, height = 0.3 * np.sqrt(2 * np.log(6.0)), 0.1
    cap = np.pi * (radius - height) ** 2 * (2 * radius + height) / 3
    assert -mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3 - cap, rel=0.02)
    assert mesh.vertices[:, 0].max() == pytest.approx(0.1, abs=0.01 * 0.05 + 1e-6)
    inside = [[-0.1] * 3, [0.1] * 3]  # only free space
    box = extract_mesh(free_ball(), 0.01, bounds=inside, watertight=True)
    assert is_closed(box)
    assert -box.volume == pytest.approx(0.2**3, rel=0.1)


def test_every_ray_in_a_room_hits_the_mesh_from_its_free_side(room):
    scans, model = room
    mesh = extract_mesh(model, 0.1, watertight=True)
    assert is_closed(mesh)
    winding = [winding_number(mesh, origin) for origin in scans.origins.numpy()]
    np.testing.assert_allclose(winding, -1, atol=1e-6)
    assert winding_number(mesh, np.array([100.0, 0, 0])) == pytest.approx(0, abs=1e-6)


def winding_number(mesh, point):
    """How often a closed surface goes around a point: solid angle of its faces over that of a sphere."""
    a, b, c = (mesh.triangles - point).transpose(1, 0, 2)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    over = np.einsum("ij,ij->i", a, np.cross(b, c))
    under = la * lb * lc + lc * (a * b).sum(axis=1) + la * (b * c).sum(axis=1) + lb * (c * a).sum(1)
    return np.arctan2(over, under).sum() / (2 * np.pi)


def test_measured_parts_lie_where_those_of_the_open_mesh_do(room):
    model = room[1]
    closed, opened = extract_mesh(model, 0.1, watertight=True), extract_mesh(model, 0.1)
    measured = closed.vertices[closed.vertex_attributes["closing"] == 0]
    assert 0.3 < len(measured) / len(closed.vertices) < 1
    points = trimesh.sample.sample_surface(opened, 200_000, seed=0)[0]
    assert np.median(cKDTree(points).query(measured)[0]) < 0.03
    level = extract_mesh(model, 0.1, surface="crossing", watertight=True)
    assert is_closed(level)
    assert len(level.faces) == len(closed.faces)
    assert -level.volume < -closed.volume  # in front of the surfaces


def test_the_mesh_of_tiles_is_that_of_the_merged_map(tmp_path, monkeypatch):
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", 1)
    tiles = TiledMap.split(wall_map(), tmp_path / "tiles", 1.5)
    one, ours = (extract_mesh(m, 0.12, watertight=True) for m in (tiles.merge(), tiles))
    assert is_closed(ours)
    assert len(one.faces) == len(ours.faces) > 500
    assert ours.volume == pytest.approx(one.volume, rel=1e-6)


def test_a_simplified_mesh_is_still_closed():
    pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")
    for seed in range(5):  # random numbers: sheets that nearly touch everywhere
        values = -np.ones((17,) * 3, dtype=np.float32)
        values[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).normal(size=(15,) * 3)
        cut = plain_march(values[None], 0.1, np.full((1, 3), 16))
        points, axes = np.divmod(cut.edges, 3)
        places = np.stack(np.unravel_index(points, values.shape), axis=1).astype(float)
        places[np.arange(len(places)), axes] += cut.shares
        mesh = trimesh.Trimesh(places, cut.faces, process=False)
        for faces in (2000, 500):
            assert is_closed(simplify_mesh(mesh, faces))


def test_faces_back_to_back_go_and_sheets_that_touch_at_an_edge_are_parted():
    apexes = np.array([[1.0, 1, 0.5], [1, -1, 0.5], [-1, 1, 0.5], [-1, -1, 0.5]])
    vertices = np.concatenate([[[0.0, 0, 0], [0, 0, 1]], apexes])
    tetrahedra = [trimesh.convex.convex_hull(vertices[[0, 1, *pair]]) for pair in ((2, 3), (4, 5))]
    joined = trimesh.util.concatenate(tetrahedra)
    joined.merge_vertices()
    back_to_back = [[0, 1, 2], [2, 1, 0]]
    joined = trimesh.Trimesh(
        joined.vertices, [*joined.faces.tolist(), *back_to_back], process=False
    )
    assert not joined.is_watertight
    mesh = trimesh.Trimesh(*_closed(joined.vertices, joined.faces), process=True)
    assert is_closed(mesh)
    assert len(mesh.faces) == 8 + 4
    assert mesh.volume == pytest.approx(joined.volume, rel=0.02)


def test_the_command_writes_a_closed_mesh_with_the_mark_or_says_why_not(room, tmp_path, capsys):
    room[1].save(tmp_path / "map.pt")
    command = ["mesh", str(tmp_path / "map.pt"), "-o", str(tmp_path / "m.ply"), "--watertight"]
    assert cli.main([*command, "--resolution", "0.15"]) == 0
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    assert is_closed(mesh)
    marks = mesh.metadata["_ply_raw"]["vertex"]["data"]["closing"]
    assert set(np.unique(marks)) == {0, 1}
    capsys.readouterr()
    assert cli.main([*command, "--threshold", "0.9"]) == 1
    assert "threshold must be lower with watertight" in capsys.readouterr().err


def test_what_cannot_be_closed_is_refused():
    with pytest.raises(ValueError, match="log_odds_margin must be a number"):
        extract_mesh(free_ball(), 0.1, log_odds_margin=None, watertight=True)
    with pytest.raises(ValueError, match=r"threshold must be lower.*got 0\.8"):
        extract_mesh(free_ball(), 0.1, 0.8, watertight=True)


def test_the_mark_is_kept_far_from_zero(tmp_path):
    mesh = extract_mesh(free_ball(), 0.1, watertight=True)
    mesh.apply_translation([4.5e5, 5.1e6, 0])
    save_mesh(mesh, tmp_path / "m.ply")
    found = trimesh.load(tmp_path / "m.ply", process=False)
    assert (found.metadata["_ply_raw"]["vertex"]["data"]["closing"] == 1).all()
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
