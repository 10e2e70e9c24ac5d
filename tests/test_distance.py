import math

import numpy as np
import pytest
import torch
from small_maps import F64, ball, random_map
from tiled_maps import tiled

from lardhm_torch import LardHilbertMap, native, sample_rays, signed_distance, simulate_room
from lardhm_torch.features import raw_factors
from lardhm_torch.queries import nearest_face as module
from lardhm_torch.queries.distance import surface_distance
from lardhm_torch.queries.faces import surface_faces

EDGE = 0.2  # [m] of a tile of the wall


def wall_of_tiles(dim=3, dtype=torch.float32, origin=0.0, tiles=6):
    """A flat wall of square tiles at x_0 = 0 without noise, free before it, at x_0 > 0."""
    places = (torch.arange(tiles, dtype=F64) - (tiles - 1) / 2) * EDGE
    places = torch.stack(torch.meshgrid(*[places] * (dim - 1), indexing="ij"), -1)
    places = places.reshape(-1, dim - 1)
    wall = torch.cat([torch.zeros(len(places), 1, dtype=F64), places], dim=1)
    free = [wall + torch.eye(dim, dtype=F64)[0] * height for height in (0.25, 0.4, 0.6)]
    centers = torch.cat([wall, *free])
    is_occupied = torch.arange(len(centers)) < len(wall)
    covariance = torch.diag(torch.tensor([0.0] + [EDGE**2 / 12] * (dim - 1), dtype=F64))
    model = LardHilbertMap(dim, num_neighbors=6, dtype=dtype)
    thin, thick = (centers.new_tensor([edge] + [0.1] * (dim - 1)) for edge in (0.02, 0.05))
    factors = torch.where(is_occupied[:, None], thin, thick)
    model.load_state_dict(
        model.state_dict()
        | {
            "weights": torch.where(is_occupied, 8.0, -8.0),
            "centers": centers,
            "raw_scale_tril": raw_factors(torch.diag_embed(factors)),
            "is_occupied": is_occupied,
            "counts": torch.full((len(centers),), 100),
            "means": centers,
            "scatters": 100 * covariance.expand(len(centers), dim, dim),
            "posterior_means": torch.zeros(len(centers)),
            "posterior_variances": torch.zeros(len(centers)),
            "origin": torch.full((dim,), origin, dtype=F64),
        }
    )
    return model.requires_grad_(False)


@pytest.fixture(scope="module")
def room():
    samples = sample_rays(simulate_room(6000))
    return LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)


def places(count, seed=0, lower=(-1.0, -1.0, -1.0), upper=(9.0, 6.0, 3.6)):
    rng = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(lower, dtype=F64), torch.tensor(upper, dtype=F64)
    return low + torch.rand(count, len(low), generator=rng, dtype=F64) * (high - low)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_before_and_behind_a_flat_wall_the_distance_is_the_height(dim, dtype):
    model = wall_of_tiles(dim, dtype)
    points = places(200, lower=(-0.5,) * dim, upper=(0.5,) * dim)
    points[:, 0] *= 6
    found = signed_distance(model, points)
    gaps = 1e-6 if dim == 2 else 2e-3  # between the rounded corners of squares
    torch.testing.assert_close(found, points[:, 0], rtol=0, atol=gaps)
    assert torch.equal(surface_distance(model, points), found.abs())


def test_beside_the_wall_the_nearest_place_is_on_its_border():
    model = wall_of_tiles()
    side = 3 * EDGE
    points = torch.tensor([[0.4, side + 0.3, 0.1], [-0.4, 0.1, -side - 0.3]], dtype=F64)
    expected = torch.tensor([0.5, -0.5], dtype=F64)
    torch.testing.assert_close(signed_distance(model, points), expected, atol=1e-6, rtol=0)


def test_nothing_nearer_than_the_largest_distance_gives_that():
    model = wall_of_tiles()
    points = torch.tensor([[0.3, 0.1, 0.1], [3.0, 0.1, 0.1]], requires_grad=True)
    found = signed_distance(model, points, max_distance=0.5)
    torch.testing.assert_close(found.detach(), torch.tensor([0.3, 0.5]))
    found.sum().backward()
    torch.testing.assert_close(points.grad, torch.tensor([[1.0, 0, 0], [0.0, 0, 0]]))


@pytest.mark.parametrize("model", [LardHilbertMap(), ball(weight=-3.0)])
def test_without_surfaces_the_distance_is_the_largest(model):
    points = torch.zeros(2, 5, 3)
    assert (signed_distance(model, points) == math.inf).all()
    assert (signed_distance(model, points, 2.5) == 2.5).all()


def test_shapes_dtypes_and_points_that_are_not_finite():
    model = wall_of_tiles(origin=100.0)
    points = np.array([[100.5, 100.1, 100.1], [np.nan, 0, 0], [np.inf, 100, 100]])
    found = signed_distance(model, points)
    assert found.dtype == F64
    assert found[0].item() == pytest.approx(0.5, abs=1e-6)
    assert found[1:].isnan().all()
    assert signed_distance(model, torch.zeros(0, 2, 3)).shape == (0, 2)
    assert signed_distance(model, torch.zeros(3)).dtype == torch.float32
    assert signed_distance(model, torch.zeros(3)).shape == ()


@pytest.mark.skipif(not native.available(), reason="the native search is what is compared")
@pytest.mark.parametrize("dim", [2, 3])
def test_the_native_search_finds_what_the_definition_finds(dim):
    model = LardHilbertMap(dim).double()
    points, labels = places(3000, 1)[:, :dim], torch.arange(3000) % 2
    model.fit(points, labels.double(), 400).requires_grad_(False)
    faces = surface_faces(model)
    assert len(faces.centers) > 150
    points = places(500, 2)[:, :dim] - model.origin
    points[:3] *= 1e3
    for most in (math.inf, 0.3):
        values, gradients, nearest = native.nearest_face(points, faces, most, True)
        plain = module.plain_nearest(points, faces, most)
        inputs = points.clone().requires_grad_()
        expected = module.face_distances(inputs, faces, plain, most)
        tolerance = 1e-6 * (1 + expected.detach().nan_to_num(0, 0, 0).abs())  # search: float32
        assert ((values - expected.detach()).abs() <= tolerance)[expected.isfinite()].all()
        (slopes,) = torch.autograd.grad(expected.sum(), inputs)
        same = nearest == plain
        assert same.double().mean() > 0.99
        torch.testing.assert_close(gradients[same], slopes[same])


def test_gradients_pass_gradcheck_and_have_length_one(room):
    points = places(40, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: signed_distance(room, x), points)
    assert torch.autograd.gradgradcheck(lambda x: signed_distance(room, x, 0.5), points)
    points = places(2000, 4).requires_grad_()
    signed_distance(room, points).sum().backward()
    torch.testing.assert_close(points.grad.norm(dim=1), torch.ones(2000, dtype=F64))


def test_the_distance_changes_by_no_more_than_the_way_gone(room):
    here, there = places(500, 5), places(500, 6)
    change = (surface_distance(room, here) - surface_distance(room, there)).abs()
    assert (change <= (here - there).norm(dim=1) + 1e-9).all()


def test_free_space_is_in_front_of_the_room_s_surfaces(room):
    scans = simulate_room(3000, seed=9)
    share = torch.rand(len(scans), 1, dtype=F64, generator=torch.Generator().manual_seed(0))
    points = scans.ray_origins + share * (scans.ends - scans.ray_origins)
    far = surface_distance(room, points) > 0.1
    assert (signed_distance(room, points)[far] > 0).double().mean() > 0.99
    outside = torch.tensor([[4.0, 2.5, -0.5], [4.0, 2.5, 3.1], [4.0, 5.5, 2.0]], dtype=F64)
    assert (signed_distance(room, outside) < 0).all()


def test_tiles_answer_as_the_whole_map_without_its_kept_hits(room, tmp_path, monkeypatch):
    tiles = tiled(room, tmp_path, monkeypatch, edge=2.0)
    room.save(tmp_path / "map.pt", evidence=False)
    room = LardHilbertMap.load(tmp_path / "map.pt").requires_grad_(False)
    points = places(60, 7).requires_grad_()
    points.data[0] = 40.0  # far outside
    for most in (math.inf, 0.7):
        whole, found = (signed_distance(m, points, most) for m in (room, tiles))
        torch.testing.assert_close(found, whole, rtol=0, atol=1e-5)
    slopes = [torch.autograd.grad(v.sum(), points)[0] for v in (whole, found)]
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0, atol=1e-4)


def test_after_an_update_the_distances_are_those_of_a_map_asked_for_the_first_time(tmp_path):
    scans = simulate_room(4000)
    model = LardHilbertMap()
    for scan in range(3):
        samples = sample_rays(scans.select(scans.scan_id == scan))
        model.update(samples.points, samples.labels)
        found = signed_distance(model, places(300, 8))
        model.save(tmp_path / "map.pt")
        fresh = LardHilbertMap.load(tmp_path / "map.pt")
        torch.testing.assert_close(found, signed_distance(fresh, places(300, 8)))


def test_kept_hits_far_from_every_face_are_surfaces_if_the_map_holds_them_to_be_occupied():
    model = wall_of_tiles()
    last = 35  # the tile in a corner, which ends at 0.6 m
    model.evidence[last, 0] = torch.tensor([0.0, 0.68, 0.5])
    model.evidence[last, 1] = torch.tensor([0.0, 0.5, 5.0])  # nothing is occupied there
    model.evidence[0, 0] = model.centers[0]  # on a face
    faces = surface_faces(model)
    assert len(faces.centers) == len(surface_faces(wall_of_tiles()).centers) + 1
    ahead = torch.tensor([[0.3, 0.68, 0.5]], dtype=F64)
    assert float(surface_distance(wall_of_tiles(), ahead)) > 0.305
    assert float(signed_distance(model, ahead)) == pytest.approx(0.3, abs=1e-6)


def test_a_cluster_that_the_map_holds_to_be_free_is_no_surface():
    model = wall_of_tiles()
    point = torch.tensor([1.0, 0.1, 0.1], dtype=F64)
    assert float(signed_distance(model, point)) == pytest.approx(1.0)
    model.weights[: 6 * 6] = 0.0
    assert float(signed_distance(model, point)) == math.inf


def test_a_map_of_another_kind_has_distances_too():
    model = random_map(3, dim=1)
    points = torch.linspace(-3, 3, 50, dtype=F64)[:, None].requires_grad_()
    assert signed_distance(model, points).isfinite().all()
    assert torch.autograd.gradcheck(lambda x: signed_distance(model, x), points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": torch.zeros(1, 2)}, r"points must be \(\.\.\., 3\); got \(1, 2\)"),
        ({"max_distance": 0.0}, "max_distance must be > 0 m; got 0.0"),
        ({"max_distance": math.nan}, "max_distance must be > 0 m; got nan"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        signed_distance(wall_of_tiles(), **{"points": torch.zeros(1, 3), **arguments})
