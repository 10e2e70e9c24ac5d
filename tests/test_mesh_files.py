import numpy as np
import pytest
import torch
import trimesh

from lardhm_torch import LardHilbertMap, extract_mesh, load_scans, sample_rays
from lardhm_torch.io.mesh_files import save_mesh


def some_ball(has_colors: bool = True) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    if has_colors:
        colors = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 4), dtype=np.uint8)
        colors[:, 3] = 255
        ball.visual.vertex_colors = colors
    return ball


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl", ".glb"])
def test_a_saved_mesh_is_read_back(suffix, tmp_path):
    mesh = some_ball()
    save_mesh(mesh, tmp_path / f"ball{suffix}")
    again = trimesh.load(tmp_path / f"ball{suffix}", force="mesh")
    assert len(again.faces) == len(mesh.faces)
    np.testing.assert_allclose(again.bounds, mesh.bounds, atol=1e-5)
    assert [p.name for p in tmp_path.iterdir()] == [f"ball{suffix}"]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".off"])
@pytest.mark.parametrize("has_colors", [True, False])
def test_a_mesh_far_from_zero_keeps_its_shape_in_a_file(tmp_path, suffix, has_colors):
    mesh = some_ball(has_colors)
    mesh.apply_translation([500_000.125, 4_500_000.25, 100])
    save_mesh(mesh, tmp_path / f"ball{suffix}")
    again = trimesh.load(tmp_path / f"ball{suffix}", force="mesh", process=False)
    assert np.array_equal(again.faces, mesh.faces)
    # a float32 near zero, or 8 digits of text
    np.testing.assert_allclose(again.vertices, mesh.vertices, rtol=0, atol=1e-6)
    if has_colors and suffix != ".off":
        assert np.array_equal(again.visual.vertex_colors, mesh.visual.vertex_colors)


def vertices_of(library: str, path: str) -> np.ndarray:
    """The vertices of a mesh file, as another library reads them."""
    reason = f"{library} is not installed, or lacks a library of the system"
    module = pytest.importorskip(library, reason=reason, exc_type=ImportError)
    if library == "trimesh":
        return module.load(path, force="mesh", process=False).vertices
    if library == "open3d":
        return np.asarray(module.io.read_triangle_mesh(path).vertices)
    if library == "pymeshlab":
        meshes = module.MeshSet()
        meshes.load_new_mesh(path)
        return meshes.current_mesh().transformed_vertex_matrix()
    return module.read(path).points[:, :3]  # meshio puts the colors of .obj behind x y z


READ_EXACTLY = {  # the table in docs/formats.md
    "trimesh": (".ply", ".obj", ".off", ".glb"),
    "pymeshlab": (".ply", ".obj", ".off", ".glb"),
    "meshio": (".ply", ".obj", ".off"),
    "pyvista": (".obj", ".off"),
    "open3d": (".ply",),
}


@pytest.mark.parametrize(
    ("library", "suffix"), [(name, s) for name, kinds in READ_EXACTLY.items() for s in kinds]
)
@pytest.mark.parametrize("has_colors", [True, False])
def test_other_libraries_read_a_mesh_far_from_zero_exactly(library, suffix, has_colors, tmp_path):
    mesh = some_ball(has_colors and suffix != ".off")
    mesh.apply_translation([500_000.125, 4_500_000.25, 100])
    save_mesh(mesh, tmp_path / f"ball{suffix}")
    vertices = vertices_of(library, str(tmp_path / f"ball{suffix}"))
    np.testing.assert_allclose(vertices, mesh.vertices, rtol=0, atol=1e-6)


def test_an_stl_far_from_zero_says_how_coarse_it_is(tmp_path):
    mesh = some_ball()
    mesh.apply_translation([0, 4_500_000.25, 0])
    with pytest.warns(UserWarning, match=r"moved vertices by up to 0\.2\d? m"):
        save_mesh(mesh, tmp_path / "ball.stl")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_mesh_of_real_scans_comes_back_with_its_colors(data, tmp_path, suffix):
    scans = load_scans(data / "paper_virtual/scans.npz")
    samples = sample_rays(scans.select(torch.arange(0, len(scans), 10)), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels, 300)
    mesh = extract_mesh(model, 0.2)
    save_mesh(mesh, tmp_path / f"room{suffix}")
    again = trimesh.load(tmp_path / f"room{suffix}", force="mesh", process=False)
    assert len(mesh.faces) > 500
    assert np.array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.vertices, mesh.vertices, rtol=0, atol=1e-6)
    assert np.array_equal(again.visual.vertex_colors, mesh.visual.vertex_colors)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "mesh.ply"
    path.write_text("old")

    def full_disk(partial, **_):
        partial.write_text("half")
        raise OSError("no space left")

    mesh = some_ball()
    monkeypatch.setattr(mesh, "export", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_mesh(mesh, path)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]
    assert path.read_text() == "old"


def test_an_unknown_mesh_format_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one of .glb, .obj, .off, .ply, .stl.*got 'a.xyz'"):
        save_mesh(trimesh.creation.box(), tmp_path / "a.xyz")
