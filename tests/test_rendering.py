import numpy as np
import pytest
import torch
import trimesh
from matplotlib.image import imread
from torch import nn

from lardhm_torch.viewing.rendering import render_mesh, render_slice

SIZE = (120, 90)


class BallMap(nn.Module):
    """Occupied around (1, 0), free around (-1, 0), in two or three dimensions."""

    def __init__(self, dim):
        super().__init__()
        self.dim = dim
        self.centers = torch.zeros(2, dim)
        self.centers[:, 0] = torch.tensor([1.0, -1.0])
        self.scale_tril = 0.3 * torch.eye(dim).repeat(2, 1, 1)
        self.weights = torch.tensor([6.0, -6.0])
        self.origin = torch.zeros(dim).double()

    def forward(self, points):
        squared = (points[..., None, :] - self.centers).square().sum(dim=-1)
        return torch.sigmoid(torch.exp(-squared / 0.18).float() @ self.weights)


def inked(image):
    return (image < 250).any(axis=2)


def test_a_sphere_is_a_disk_in_the_middle():
    image = render_mesh(trimesh.creation.icosphere(4), size=SIZE)
    assert image.shape == (90, 120, 3)
    assert image.dtype == np.uint8
    rows, columns = inked(image).nonzero()
    assert rows.mean() == pytest.approx(44.5, abs=0.6)
    assert columns.mean() == pytest.approx(59.5, abs=0.6)
    width, height = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert width == pytest.approx(height, abs=1)
    assert len(rows) == pytest.approx(np.pi / 4 * width * height, rel=0.03)


def test_the_nearer_face_hides_the_farther_one():
    red = trimesh.creation.box([1, 1, 0.1])
    red.visual.vertex_colors = [255, 0, 0, 255]
    blue = trimesh.creation.box([1, 1, 0.1]).apply_translation([0, 0, -1])
    blue.visual.vertex_colors = [0, 0, 255, 255]
    for order in ([red, blue], [blue, red]):
        image = render_mesh(trimesh.util.concatenate(order), elevation=89.9, size=SIZE)
        middle = image[40:50, 55:65].astype(int)
        assert (middle[..., 0] > 60).all()
        assert (middle[..., 2] < 20).all()


def test_a_room_is_seen_through_the_walls_in_front_of_it_unless_culling_is_off():
    room = trimesh.creation.box([2, 2, 2])
    room.invert()
    ball = trimesh.creation.icosphere(3, radius=0.5)
    ball.visual.vertex_colors = [255, 0, 0, 255]
    room.visual.vertex_colors = [200, 200, 200, 255]
    both = trimesh.util.concatenate([room, ball])
    center = (slice(40, 50), slice(55, 65))
    culled = render_mesh(both, size=SIZE)[center].astype(int)
    assert (culled[..., 0] > culled[..., 1] + 50).all()
    solid = render_mesh(both, size=SIZE, cull=False)[center].astype(int)
    assert (abs(solid[..., 0] - solid[..., 1]) <= 2).all()


def test_faces_above_the_cut_are_left_out():
    tower = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    roof = trimesh.creation.box(bounds=[[0, 0, 2], [1, 1, 3]])
    both = trimesh.util.concatenate([tower, roof])
    alone = render_mesh(tower, size=SIZE)
    assert np.array_equal(render_mesh(both, size=SIZE, cut_above=1.5), alone)
    assert not np.array_equal(render_mesh(both, size=SIZE), alone)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_up_is_up_in_the_picture(up):
    pole = trimesh.creation.cylinder(0.05, segment=[[0, 0, 0], np.array(up, dtype=float)])
    pole.visual.vertex_colors = np.where(
        (pole.vertices @ np.array(up) > 0.5)[:, None], [255, 0, 0, 255], [0, 0, 255, 255]
    )
    image = render_mesh(pole, size=SIZE, up=up, elevation=20).astype(int)
    red = (image[..., 0] > image[..., 2] + 60).nonzero()[0]
    blue = (image[..., 2] > image[..., 0] + 60).nonzero()[0]
    assert red.max() <= blue.min() + 2


def test_zoom_makes_it_larger_and_a_mesh_without_faces_is_white():
    sphere = trimesh.creation.icosphere(2)
    near, far = (inked(render_mesh(sphere, size=SIZE, zoom=z)).sum() for z in (1.0, 0.5))
    assert near == pytest.approx(4 * far, rel=0.1)
    assert (render_mesh(trimesh.Trimesh(), size=SIZE) == 255).all()


def test_pictures_are_written(tmp_path):
    image = render_mesh(trimesh.creation.icosphere(2), tmp_path / "mesh.png", size=SIZE)
    written = (imread(tmp_path / "mesh.png")[..., :3] * 255).round().astype(np.uint8)
    assert np.array_equal(written, image)


@pytest.mark.parametrize(("dim", "height"), [(2, None), (3, 0.0)])
def test_a_slice_is_red_where_occupied_and_blue_where_free(dim, height, tmp_path):
    path = tmp_path / "slice.png"
    render_slice(BallMap(dim), path, height, resolution=0.05)
    image = imread(path)[..., :3]
    image = image[:, : int(0.75 * image.shape[1])]  # without the color bar
    red = (image[..., 0] - image[..., 2] > 0.3).nonzero()[1]
    blue = (image[..., 2] - image[..., 0] > 0.3).nonzero()[1]
    assert len(red) > 100
    assert len(blue) > 100
    assert red.min() > blue.max()


def test_bad_pictures_are_refused(tmp_path):
    sphere = trimesh.creation.icosphere(1)
    with pytest.raises(ValueError, match=r"path must end in .png.*got 'a.jpg'"):
        render_mesh(sphere, tmp_path / "a.jpg")
    with pytest.raises(ValueError, match=r"path must end in .png.*got 'a'"):
        render_slice(BallMap(2), tmp_path / "a")
    with pytest.raises(ValueError, match="size and zoom must be > 0"):
        render_mesh(sphere, size=(0, 10))
    with pytest.raises(ValueError, match="size and zoom must be > 0"):
        render_mesh(sphere, zoom=0.0)
    with pytest.raises(ValueError, match="up must be a direction, not zero"):
        render_mesh(sphere, up=(0, 0, 0))
