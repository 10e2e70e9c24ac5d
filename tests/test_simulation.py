import math

import numpy as np
import pytest
import torch

from lardhm_torch.simulation import (
    BOXES,
    CYLINDERS,
    MAX_RANGE,
    ROOM,
    SCANNERS,
    SPHERES,
    room_mesh,
    simulate_room,
    true_ranges,
)


@pytest.fixture(scope="module")
def mesh():
    return room_mesh()


def rays_meet_triangles(triangles, origins, directions):
    """First distance and triangle of each ray, every triangle tried: Moeller and Trumbore 1997."""
    corner, first, second = triangles[:, 0], *(triangles[:, i] - triangles[:, 0] for i in (1, 2))
    ranges, faces = [], []
    for origin, direction in zip(origins, directions, strict=True):
        across = torch.linalg.cross(direction.expand_as(second), second)
        determinant = (first * across).sum(dim=1)
        offset = origin - corner
        u = (offset * across).sum(dim=1) / determinant
        turned = torch.linalg.cross(offset, first)
        v = (direction * turned).sum(dim=1) / determinant
        depth = (second * turned).sum(dim=1) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 1e-9)
        nearest = torch.where(inside, depth, torch.inf).min(dim=0)
        ranges.append(nearest.values)
        faces.append(nearest.indices)
    return torch.stack(ranges), torch.stack(faces)


def unit_directions(scans):
    return (scans.ends - scans.ray_origins) / scans.ranges[:, None]


def test_without_noise_every_ray_ends_on_the_mesh_and_no_triangle_lies_before_it(mesh):
    scans = simulate_room(900, noise=0.0)
    triangles = torch.tensor(mesh.triangles)
    ranges, _ = rays_meet_triangles(triangles, scans.ray_origins, unit_directions(scans))
    assert torch.equal(ranges.isfinite(), scans.is_return)
    # round shapes are polygons in the mesh: below 0.2 mm off, more where a ray grazes them
    hits = scans.is_return
    torch.testing.assert_close(ranges[hits], scans.ranges[hits], rtol=0, atol=3e-3)


def test_the_faces_that_rays_meet_look_toward_the_scanner(mesh):
    scans = simulate_room(600, noise=0.0)
    directions = unit_directions(scans)
    _, faces = rays_meet_triangles(torch.tensor(mesh.triangles), scans.ray_origins, directions)
    normals = torch.tensor(np.array(mesh.face_normals))[faces]
    assert ((normals * directions).sum(dim=1) < 0)[scans.is_return].all()


def test_the_mesh_is_as_large_as_the_shapes_say(mesh):
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], ROOM])
    assert ROOM[0] * ROOM[1] == 40
    shell = 2 * (8 * 5 + 8 * 2.6 + 5 * 2.6) - 0.9 * 2.05 - 1.8 * 1.2
    below_hip_height = np.isclose(mesh.triangles, 0.0).all(axis=1).any(axis=1)
    at_far_wall = np.isclose(mesh.triangles, ROOM).all(axis=1).any(axis=1)
    assert mesh.area_faces[below_hip_height | at_far_wall].sum() == pytest.approx(shell)


def test_free_segments_pass_through_no_shape():
    scans = simulate_room(1500, noise=0.0)
    shares = torch.linspace(0.0, 0.999, 60, dtype=torch.float64)[:, None, None]
    points = scans.ray_origins + shares * (scans.ends - scans.ray_origins)
    points = points[:, scans.is_return].reshape(-1, 3)
    for box in torch.tensor(BOXES, dtype=torch.float64):
        assert not ((points > box[:3] + 1e-6) & (points < box[3:] - 1e-6)).all(dim=1).any()
    for x, y, radius, low, high in CYLINDERS:
        across = torch.hypot(points[:, 0] - x, points[:, 1] - y) < radius - 1e-6
        assert not (across & (points[:, 2] > low + 1e-6) & (points[:, 2] < high - 1e-6)).any()
    for *center, radius in SPHERES:
        assert not ((points - torch.tensor(center)).norm(dim=1) < radius - 1e-6).any()


def test_noise_lies_along_the_ray_with_the_given_standard_deviation():
    exact, noisy = simulate_room(6000, noise=0.0, seed=3), simulate_room(6000, noise=0.05, seed=3)
    torch.testing.assert_close(unit_directions(exact), unit_directions(noisy))
    error = (noisy.ranges - exact.ranges)[exact.is_return]
    assert abs(float(error.mean())) < 0.003
    assert float(error.std()) == pytest.approx(0.05, rel=0.04)


def test_some_beams_leave_through_the_openings_and_end_at_the_maximum_range():
    scans = simulate_room(6000)
    lost = ~scans.is_return
    assert 0.01 < lost.double().mean() < 0.1
    torch.testing.assert_close(scans.ranges[lost], torch.full_like(scans.ranges[lost], MAX_RANGE))


def test_a_beam_through_the_middle_of_the_window_is_lost_and_one_beside_it_is_not():
    origin = torch.tensor([[4.0, 2.6, 1.5]]).double().expand(2, 3)
    directions = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, 0.0, 0.22]]).double()
    directions /= directions.norm(dim=1, keepdim=True)
    ranges = true_ranges(origin, directions)
    assert ranges[0] == math.inf
    assert float(ranges[1]) == pytest.approx(4.0 * math.hypot(1.0, 0.22))


@pytest.mark.parametrize("count", [3, 100, 1001])
def test_the_rays_are_shared_among_three_scanners(count):
    scans = simulate_room(count)
    assert len(scans) == count
    assert scans.origins.tolist() == [list(origin) for origin in SCANNERS]
    shares = scans.scan_id.bincount()
    assert len(shares) == 3
    assert shares.max() - shares.min() <= 1


def test_the_seed_decides_the_rays():
    assert torch.equal(simulate_room(99, seed=1).ends, simulate_room(99, seed=1).ends)
    assert not torch.equal(simulate_room(99, seed=1).ends, simulate_room(99, seed=2).ends)


def test_too_few_rays_and_negative_noise_are_refused():
    with pytest.raises(ValueError, match=r"num_rays must be at least 3.*got 2"):
        simulate_room(2)
    with pytest.raises(ValueError, match=r"noise must be >= 0 m; got -0.1"):
        simulate_room(10, noise=-0.1)
    with pytest.raises(ValueError, match="noise must be >= 0 m; got nan"):
        simulate_room(10, noise=math.nan)
