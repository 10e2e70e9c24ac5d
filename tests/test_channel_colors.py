"""Meshes and grids in color, intensity and class."""

import numpy as np
import pytest
import torch
from colored_maps import CLASSES, colored_map, ramp

from lardhm_torch import channel, extract_mesh, save_grid, save_mesh
from lardhm_torch.cli import main
from lardhm_torch.surfaces.channel_colors import UNKNOWN_COLOR, class_labels


def test_meshes_have_the_colors_and_classes_of_the_map(tmp_path):
    model = colored_map(torch.float32)
    mesh = extract_mesh(model, 0.1, color="color")
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    expected = ramp(torch.tensor(np.array(mesh.vertices))).clamp(0, 1).numpy()
    assert np.abs(colors - expected).mean() < 0.03
    mesh = extract_mesh(model, 0.1, color="class")
    labels = np.asarray(mesh.vertex_attributes["label"])
    clear = np.abs(mesh.vertices[:, 1] - 1) > 0.1
    assert (labels == np.where(mesh.vertices[:, 1] < 1, *CLASSES))[clear].all()
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra dev)")
    far = mesh.copy()
    far.vertices += 5e5  # then .ply holds float64
    for name, one in (("a.ply", mesh), ("b.ply", far)):
        save_mesh(one, tmp_path / name)
        vertex = plyfile.PlyData.read(tmp_path / name)["vertex"]
        assert np.array_equal(vertex["label"], labels)
        assert np.array_equal(vertex["red"], np.asarray(one.visual.vertex_colors)[:, 0])
    save_mesh(mesh, tmp_path / "a.glb")
    trimesh = pytest.importorskip("trimesh")
    glb = trimesh.load(tmp_path / "a.glb", force="mesh")
    ours = np.asarray(mesh.visual.vertex_colors)[:, :3]
    assert len(np.unique(np.asarray(glb.visual.vertex_colors)[:, :3], axis=0)) == len(
        np.unique(ours, axis=0)
    )
    with pytest.raises(ValueError, match=r"color must be one of .*intensity, class"):
        extract_mesh(model, 0.1, color="infrared")


def test_unknown_vertices_are_gray_and_have_no_class():
    from lardhm_torch.surfaces.channel_colors import channel_colors

    model, far = colored_map(torch.float32), np.full((2, 3), 50.0)
    for name in ("color", "intensity", "class"):
        assert (channel_colors(model, far, name)[:, :3] == UNKNOWN_COLOR).all()
    assert class_labels(model, far).tolist() == [-1, -1]


CORNERS = ([0.8, 0.2, 0.2], [1.2, 1.8, 1.8])


def cell_centers(arrays):
    """Centers of the cells of a dense grid, (nx, ny, nz, 3)."""
    first, resolution = arrays["lower"], float(arrays["resolution"])
    axes = [
        f + resolution * (np.arange(n) + 0.5)
        for f, n in zip(first, arrays["probability"].shape, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def test_grids_hold_channels_beside_the_probability(tmp_path):
    model = colored_map(torch.float32)
    for name in ("color", "intensity", "class"):
        save_grid(model, tmp_path / f"{name}.npz", 0.1, CORNERS, channel=name)
        arrays = np.load(tmp_path / f"{name}.npz")
        points = cell_centers(arrays)
        assert arrays[name].shape[:3] == arrays["probability"].shape
        if name == "class":
            assert np.array_equal(
                arrays[name], class_labels(model, points.reshape(-1, 3)).reshape(points.shape[:3])
            )
            likely = arrays["probability"] > 0.5
            clear = likely & (np.abs(points[..., 1] - 1) > 0.1)
            assert (arrays[name] == np.where(points[..., 1] < 1, *CLASSES))[clear].all()
        else:
            expected = channel(model, torch.tensor(points), name).detach().numpy()
            assert np.array_equal(arrays[name], expected, equal_nan=True)


def test_sparse_grids_hold_channels_of_the_same_cells(tmp_path):
    model = colored_map(torch.float32)
    save_grid(model, tmp_path / "dense.npz", 0.1, CORNERS, channel="color")
    save_grid(model, tmp_path / "sparse.npz", 0.1, CORNERS, channel="color", sparse=True)
    dense, sparse = np.load(tmp_path / "dense.npz"), np.load(tmp_path / "sparse.npz")
    assert sparse["color"].shape == (*sparse["probability"].shape, 3)
    for corner, block in zip(sparse["blocks"], sparse["color"], strict=True):
        there = dense["color"][tuple(slice(c, c + 8) for c in corner)]
        inside = block[tuple(slice(0, n) for n in there.shape[:3])]
        np.testing.assert_allclose(inside, there, rtol=1e-5, atol=1e-5, equal_nan=True)


def test_grids_refuse_channels_that_they_cannot_hold(tmp_path):
    model = colored_map(torch.float32)
    with pytest.raises(ValueError, match=r"must end in \.npz for a grid with a channel"):
        save_grid(model, tmp_path / "a.bt", 0.1, channel="color")
    with pytest.raises(ValueError, match="color, intensity, class; got 'infrared'"):
        save_grid(model, tmp_path / "a.npz", 0.1, channel="infrared")
    model.save(tmp_path / "map.pt")
    words = ["grid", str(tmp_path / "map.pt"), "-o", str(tmp_path / "g.npz")]
    assert main([*words, "--resolution", "0.2", "--channel", "class"]) == 0
    assert np.load(tmp_path / "g.npz")["class"].dtype == np.int32
