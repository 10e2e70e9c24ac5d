import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from small_maps import wall_map
from torch import nn

from lardhm_torch import LardHilbertMap, grid, sample_rays, simulate_room, split_rays
from lardhm_torch.evaluation.mesh_distances import mesh_metrics
from lardhm_torch.simulation import room_mesh
from lardhm_torch.surfaces import following, meshing, ridge
from lardhm_torch.surfaces.following import Sheet
from lardhm_torch.surfaces.marching import plain_march
from lardhm_torch.surfaces.meshing import extract_mesh
from lardhm_torch.surfaces.ridge import mean_with_neighbors, sheet_on_ridge


class GaussianMap(nn.Module):
    """A map in a few lines: every cluster answers for every point."""

    def __init__(self, centers, scale_tril, weights, origin=None):
        super().__init__()
        self.centers = nn.Parameter(torch.as_tensor(centers, dtype=torch.float64))
        self.scale_tril = torch.as_tensor(scale_tril, dtype=torch.float64)
        self.weights = nn.Parameter(torch.as_tensor(weights, dtype=torch.float64))
        self.dim = self.centers.shape[1]
        self.origin = torch.zeros(self.dim).double() if origin is None else origin
        self.num_points = 0

    def log_odds(self, points):
        self.num_points += points[..., 0].numel()
        offsets = (points - self.origin)[..., None, :] - self.centers
        whitened = torch.linalg.solve_triangular(self.scale_tril, offsets[..., None], upper=False)
        return torch.exp(-0.5 * whitened.square().sum(dim=(-2, -1))) @ self.weights

    def forward(self, points):
        return torch.sigmoid(self.log_odds(points))


WEIGHT, SIGMA = 6.0, 0.3
FLOOR_BOX = ([-0.5, -0.5, -0.6], [0.5, 0.5, 1.0])


def ball(dim=3, origin=None):
    return GaussianMap(torch.zeros(1, dim), SIGMA * torch.eye(dim)[None], [WEIGHT], origin)


def ball_in_free_space(origin=None):
    """An occupied ball inside a wide free one: both sides of its surface are measured."""
    factors = torch.stack([SIGMA * torch.eye(3), 3 * torch.eye(3)])
    return GaussianMap(torch.zeros(2, 3), factors, [2 * WEIGHT, -WEIGHT], origin)


def wall_seen_from_the_left():
    """A flat occupied cluster at x = 0 with free space on its left and nothing on its right."""
    wall = torch.diag(torch.tensor([0.05, 1.0, 1.0]))
    free = torch.diag(torch.tensor([0.3, 1.0, 1.0]))
    centers = [[0.0, 0, 0], [-0.6, 0, 0]]
    return GaussianMap(centers, torch.stack([wall, free]), [12.0, -6.0])


def level_mesh(*arguments, **options):
    return extract_mesh(*arguments, surface="crossing", **options)


def radius_where(probability):
    """Distance from the center of `ball` at which it has this probability, in closed form."""
    level = math.log(probability / (1 - probability))
    return SIGMA * math.sqrt(2 * math.log(WEIGHT / level))


def random_map(seed, clusters=12):
    rng = torch.Generator().manual_seed(seed)
    factors = 0.1 * torch.randn(clusters, 3, 3, generator=rng).tril(-1)
    factors += torch.diag_embed(0.1 + 0.2 * torch.rand(clusters, 3, generator=rng))
    weights = 5 * torch.randn(clusters, generator=rng)
    return GaussianMap(torch.randn(clusters, 3, generator=rng), factors, weights)


@pytest.mark.parametrize("threshold", [0.6, 0.8, 0.95])
def test_the_mesh_of_a_ball_is_the_sphere_where_the_probability_is_the_threshold(threshold):
    mesh = level_mesh(ball(), 0.03, threshold, log_odds_margin=None)
    radius = radius_where(threshold)
    lengths = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(lengths, radius, atol=0.002)  # linear between lattice points
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.02)
    probability = ball()(torch.tensor(mesh.vertices)).detach()
    torch.testing.assert_close(
        probability, torch.full_like(probability, threshold), rtol=0, atol=0.01
    )


def test_normals_point_into_free_space():
    mesh = level_mesh(ball_in_free_space(), 0.05)
    assert mesh.volume > 0
    assert ((mesh.face_normals * mesh.triangles_center).sum(axis=1) > 0).all()


def triangles(mesh):
    """(F, 9) corners of all triangles in one order, whatever that of the mesh."""
    corners = mesh.triangles.round(5)
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]  # each begins at its lowest
    turned = np.take_along_axis(corners, (first[:, None] + np.arange(3))[..., None] % 3, axis=1)
    flat = turned.reshape(-1, 9)
    return flat[np.lexsort(flat.T[::-1])]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_mesh_is_that_of_the_whole_lattice(seed):
    model, bounds = random_map(seed), ([-1.6] * 3, [1.6] * 3)
    mesh = level_mesh(model, 0.08, 0.7, bounds, log_odds_margin=None)
    with torch.no_grad():
        values = model.log_odds(grid(*bounds, 0.08)).numpy().astype(np.float32)
    cut = plain_march(values[None], math.log(0.7 / 0.3), np.array([[40, 40, 40]]))
    points, axes = np.divmod(cut.edges, 3)
    places = np.stack(np.unravel_index(points, values.shape), axis=1).astype(float)
    places[np.arange(len(places)), axes] += cut.shares
    whole = trimesh.Trimesh(0.08 * places - 1.6, cut.faces, process=False)
    assert len(whole.faces) > 500
    assert len(mesh.vertices) == len(whole.vertices)
    np.testing.assert_allclose(triangles(mesh), triangles(whole), atol=2e-5)


def test_parts_of_a_map_fit_together():
    model = wall_seen_from_the_left()
    whole = extract_mesh(model, 0.04)
    ends = [-3.2, -0.4, 3.2]  # in y: all but the tails, without the center of the cluster
    low, high = [-0.8, ends[0], -3.2], [0.8, ends[1], 3.2]
    parts = [extract_mesh(model, 0.04, bounds=(low, high))]
    low[1], high[1] = ends[1:]
    parts.append(extract_mesh(model, 0.04, bounds=(low, high)))
    assert min(len(part.faces) for part in parts) > 300
    assert sum(part.area for part in parts) == pytest.approx(whole.area, rel=0.01)
    seams = [part.vertices[np.abs(part.vertices[:, 1] - ends[1]) < 2e-3] for part in parts]
    distance, _ = cKDTree(seams[0]).query(seams[1])
    assert len(seams[1]) > 20
    assert (distance < 1e-3).mean() > 0.95  # all but the ends of the seam


def test_following_finds_what_examining_every_block_finds():
    model = wall_map(dtype=torch.float32)
    rule = following.Rule(0.0, 1, 0.0, 1.0)
    lattice = meshing.surface_lattice(model, 0.03)
    every = np.arange(int(lattice.shape.prod()))
    starts = following.seed_blocks(model, lattice, rule)
    found, expected = (
        following.follow_surface(model, lattice, blocks, rule) for blocks in (starts, every)
    )
    assert 0 < len(starts) < 0.3 * len(every)
    assert len(expected.faces) > 1000
    assert len(found.faces) == len(expected.faces)


def test_kept_log_odds_give_the_same_mesh_again():
    model = ball_in_free_space()
    lattice = meshing.surface_lattice(model, 0.05, keep=True)
    first, again = (meshing.lattice_mesh(model, lattice) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.faces, extract_mesh(model, 0.05).faces)


def test_only_blocks_near_occupied_clusters_are_evaluated():
    model = GaussianMap(
        [[0.0, 0, 0], [40.0, 40.0, 40.0]], (0.1 * torch.eye(3)).repeat(2, 1, 1), [6.0, 6.0]
    )
    mesh = level_mesh(model, 0.05, 0.7, color=None, log_odds_margin=None)
    assert mesh.body_count == 2
    assert model.num_points < 20 * 25**3  # the whole lattice would have 800³ points


def test_the_mesh_moves_with_the_world():
    shift = torch.tensor([5e5, 4.5e6, 100.0]).double()
    here, there = (level_mesh(ball_in_free_space(o), 0.05) for o in (None, shift))
    np.testing.assert_allclose(there.vertices - shift.numpy(), here.vertices, atol=1e-6)
    np.testing.assert_array_equal(there.faces, here.faces)


def test_bounds_cut_the_mesh():
    whole = level_mesh(ball_in_free_space(), 0.05)
    half = level_mesh(ball_in_free_space(), 0.05, bounds=([0, -1, -1], [1, 1, 1]))
    assert half.bounds[0, 0] == pytest.approx(0.0)
    assert half.bounds[1, 0] == pytest.approx(whole.bounds[1, 0], abs=0.005)
    assert half.area == pytest.approx(whole.area / 2, rel=0.02)


def test_bounds_may_be_arrays():
    corners = ([0, -1, -1], [1, 1, 1])
    expected = level_mesh(ball_in_free_space(), 0.1, bounds=corners)
    found = level_mesh(ball_in_free_space(), 0.1, bounds=tuple(map(np.array, corners)))
    np.testing.assert_array_equal(found.vertices, expected.vertices)


def test_bounds_away_from_every_obstacle_give_a_mesh_without_faces():
    mesh = level_mesh(ball(), 0.05, bounds=([10, 10, 10], [11, 11, 11]))
    assert isinstance(mesh, trimesh.Trimesh)
    assert len(mesh.faces) == 0


def test_a_map_that_knows_only_free_space_gives_a_mesh_without_faces():
    free = GaussianMap(torch.zeros(1, 3), 0.3 * torch.eye(3)[None], [-6.0])
    assert len(level_mesh(free, 0.05).faces) == 0


def test_faces_with_nothing_measured_before_or_behind_them_are_left_out():
    model = wall_seen_from_the_left()
    everything = level_mesh(model, 0.04, log_odds_margin=None)
    measured = level_mesh(model, 0.04)
    assert (everything.triangles_center[:, 0] > 0.1).any()  # the back, where only tails are left
    assert 0 < len(measured.faces) < len(everything.faces)
    assert measured.triangles_center[:, 0].max() < 0
    middle = np.abs(measured.triangles_center[:, 1:]).max(axis=1) < 0.5
    assert (measured.face_normals[middle, 0] < -0.9).all()


def thin_floor(below):
    """A layer much thinner than a cell at z = 0.03, with free space above and this log-odds below."""
    thin = torch.diag(torch.tensor([1.0, 1.0, 0.02]))
    free = torch.diag(torch.tensor([1.0, 1.0, 0.2]))
    centers = [[0.0, 0, 0.03], [0, 0, 0.38], [0, 0, -0.32]]
    return GaussianMap(centers, torch.stack([thin, free, free]), [12.0, -8.0, below])


def test_a_floor_thinner_than_a_cell_has_no_holes():
    mesh = extract_mesh(thin_floor(0.0), 0.1, bounds=FLOOR_BOX)
    assert mesh.area == pytest.approx(1.0, rel=0.05)
    np.testing.assert_allclose(mesh.vertices[:, 2], 0.03, atol=0.01)


def test_a_floor_has_faces_where_the_space_above_is_as_free_as_that_below():
    mesh = extract_mesh(thin_floor(-8.0), 0.025, bounds=FLOOR_BOX)
    up, down = (mesh.area_faces[sign * mesh.face_normals[:, 2] > 0].sum() for sign in (1, -1))
    assert (up, down) == pytest.approx((1.0, 1.0), rel=0.05)


def test_weak_traces_of_free_space_behind_a_floor_give_no_faces():
    mesh = extract_mesh(thin_floor(-2.0), 0.025, bounds=FLOOR_BOX)
    assert mesh.area == pytest.approx(1.0, rel=0.05)
    assert (mesh.face_normals[:, 2] > 0.9).all()


def test_vertices_where_the_log_odds_are_constant_have_no_ridge():
    tiny = GaussianMap(torch.zeros(1, 3), 0.01 * torch.eye(3)[None], [WEIGHT])  # 0 at 0.4 m
    assert len(extract_mesh(tiny, 0.4, log_odds_margin=None).faces) == 0


def test_below_one_half_the_surface_bounds_the_known_free_space():
    free = GaussianMap(torch.zeros(1, 3), SIGMA * torch.eye(3)[None], [-WEIGHT])
    mesh = level_mesh(free, 0.03, threshold=0.2, log_odds_margin=None)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), radius_where(0.8), atol=0.002)
    assert mesh.volume < 0  # its normals point inward, into the free space


@pytest.mark.parametrize("color", ["height", "cluster", "probability"])
def test_every_vertex_has_a_color(color):
    mesh = level_mesh(random_map(2), 0.08, 0.7, color=color, log_odds_margin=None)
    assert mesh.visual.kind == "vertex"
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 1


def test_colors_by_cluster_and_by_probability_are_those_of_the_nearest_cluster():
    model = GaussianMap(
        [[-0.5, 0, 0], [0.5, 0, 0]], (0.2 * torch.eye(3)).repeat(2, 1, 1), [4.0, 8.0]
    )
    for color in ("cluster", "probability"):
        mesh = level_mesh(model, 0.05, 0.7, color=color, log_odds_margin=None)
        left = mesh.vertices[:, 0] < 0
        shades = [np.unique(mesh.visual.vertex_colors[side], axis=0) for side in (left, ~left)]
        assert [len(shade) for shade in shades] == [1, 1]
        assert (shades[0] != shades[1]).any()


def test_colors_by_variance_are_dark_where_the_map_is_sure():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(1600, 3, generator=rng, dtype=torch.float64)
    points[:800, 0] = 1 + 0.02 * torch.randn(800, generator=rng, dtype=torch.float64)
    points[800:, 0] *= 0.8
    labels = (torch.arange(1600) < 800).float()
    model = LardHilbertMap().fit(points, labels).fit_uncertainty(points, labels)
    mesh = level_mesh(model, 0.05, color="variance", log_odds_margin=None)
    variance = model.variance(torch.as_tensor(np.array(mesh.vertices))).numpy()
    brightness = np.asarray(mesh.visual.vertex_colors)[:, :3].sum(axis=1)
    low, high = np.quantile(variance, [0.2, 0.8])
    assert low < high
    assert brightness[variance >= high].min() > brightness[variance <= low].max()


def test_without_color_the_mesh_has_none():
    assert level_mesh(ball_in_free_space(), 0.1, color=None).visual.kind is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"model": ball(dim=2)}, "a mesh needs a 3-D map; got 2-D. For 2-D use query_slice"),
        (
            {"model": GaussianMap(torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0))},
            "it is empty: fit it first",
        ),
        ({"resolution": 0.0}, "resolution must be > 0 m and finite; got 0.0"),
        ({"resolution": math.nan}, "resolution must be > 0 m and finite; got nan"),
        ({"threshold": 0.0}, "threshold must be between 0 and 1, both excluded; got 0.0"),
        ({"color": "pink"}, "color must be one of height, cluster, probability, variance, None"),
        ({"color": "variance"}, "model must have a variance; GaussianMap has none"),
        ({"log_odds_margin": -1.0}, "log_odds_margin must be >= 0, or None"),
        ({"bounds": ([1, 1, 1], [0, 0, 0])}, "lower <= upper"),
        ({"bounds": ([0, 0], [1, 1])}, r"bounds must have 3 coordinates; got 2"),
    ],
)
def test_bad_arguments_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        level_mesh(**{"model": ball(), **changed})


def test_a_wall_lies_on_the_ridge_of_the_log_odds_and_its_level_in_front():
    model = wall_seen_from_the_left()
    line = torch.zeros(4001, 3).double()
    line[:, 0] = torch.linspace(-0.2, 0.2, 4001)
    ridge_at = float(line[model.log_odds(line).argmax(), 0])
    meshes = [extract_mesh(model, 0.04, surface=surface) for surface in ("peak", "crossing")]
    on_ridge, in_front = (
        mesh.vertices[(np.abs(mesh.vertices[:, 1:]) < 0.3).all(axis=1), 0] for mesh in meshes
    )
    assert len(on_ridge) > 100
    np.testing.assert_allclose(on_ridge, ridge_at, atol=0.005)
    assert in_front.max() < ridge_at - 0.05


def facing_away(mesh, truth):
    """Fraction of the area within 0.1 m of the true surface that looks against all of it there."""
    points, faces = trimesh.sample.sample_surface(truth, 100_000, seed=0)
    near = cKDTree(points).query_ball_point(mesh.triangles_center, 0.1)
    normals, total, away = truth.face_normals[faces], 0.0, 0.0
    for rows, normal, area in zip(near, mesh.face_normals, mesh.area_faces, strict=True):
        total += area
        away += area * bool(len(rows) and (normals[rows] @ normal).max() < 0)
    return away / total


def test_the_mesh_of_a_room_lies_on_its_walls():
    train, _ = split_rays(simulate_room(seed=1), ratio=0.8, seed=1)
    samples = sample_rays(train, seed=1)
    model = LardHilbertMap().fit(samples.points, samples.labels, seed=1)
    surfaces = ("peak", "crossing")
    meshes = {surface: extract_mesh(model, 0.05, surface=surface) for surface in surfaces}
    scores = {
        surface: mesh_metrics(mesh, room_mesh(), train.hits) for surface, mesh in meshes.items()
    }
    assert meshes["peak"].area == pytest.approx(158.5, rel=0.05)  # what the sensors can see of it
    assert facing_away(meshes["peak"], room_mesh()) < 0.01
    assert scores["peak"]["f_score_0.05"] > 0.85
    assert scores["peak"]["chamfer"] < 0.5 * scores["crossing"]["chamfer"]


def test_a_vertex_without_a_ridge_goes_the_way_of_its_neighbors():
    values = np.array([[1.0], [np.nan], [3.0], [np.nan]])
    spread = mean_with_neighbors(values, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(spread[:, 0], [2.0, 2.0, 2.0, np.nan])


def strip_of_faces():
    """A flat strip along x, normals up."""
    x = 0.05 * np.arange(20.0)
    lines = [np.stack([x, np.full(20, y), np.zeros(20)], axis=1) for y in (0.0, 0.05)]
    quads = np.arange(19)[:, None]
    faces = np.concatenate([quads + np.array(corners) for corners in ([0, 1, 20], [1, 21, 20])])
    normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (40, 1))
    return Sheet(np.concatenate(lines), faces, normals, np.ones(40, dtype=np.float32))


def test_a_face_whose_corners_met_different_surfaces_is_left_out(monkeypatch):
    strip = strip_of_faces()
    depths = torch.as_tensor(np.where(strip.vertices[:, 0] < 0.5, 0.1, 0.5))
    monkeypatch.setattr(ridge, "ridge_depths", lambda *_: depths)
    moved = sheet_on_ridge(ball(), strip, 0.05)
    assert 0 < len(moved.faces) < len(strip.faces)
    heights = np.abs(moved.vertices[:, 2])[moved.faces]
    assert np.ptp(heights, axis=1).max() <= 0.05
    assert {0.1, 0.5} == set(np.abs(moved.vertices[:, 2]).round(9)[[0, -1]])


def test_a_face_that_turns_over_is_left_out(monkeypatch):
    strip = strip_of_faces()
    strip.normals[10] = [0.8, 0, 0.6]  # moves 0.08 m back, past its neighbor
    monkeypatch.setattr(ridge, "mean_with_neighbors", lambda values, _: values)
    monkeypatch.setattr(ridge, "ridge_depths", lambda *_: torch.full((40,), 0.1).double())
    moved = sheet_on_ridge(ball(), strip, 0.5)
    corners = moved.vertices[moved.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(strip.faces) - 4 < len(moved.faces) < len(strip.faces)
    assert (across[:, 2] > 0).all()


def test_another_surface_is_refused():
    with pytest.raises(ValueError, match="surface must be one of peak, crossing; got 'ridge'"):
        extract_mesh(ball(), surface="ridge")
