"""Meshes in color, intensity and class."""

import numpy as np
import pytest
import torch
from colored_maps import CLASSES, colored_map, ramp

from lardhm_torch import extract_mesh, save_mesh
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
