import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from small_maps import wall_map
from tiled_maps import (
    EDGE,
    F64,
    border_points,
    exact_map,
    moved_away,
    random_map,
    reframed,
    tiled,
)

from lardhm_torch import LardHilbertMap, TiledMap, extract_mesh, raycast, sample_rays
from lardhm_torch.io.scan_files import load_scans
from lardhm_torch.queries.collision import expected_range, segment_hazard
from lardhm_torch.queries.frontiers import frontiers
from lardhm_torch.queries.grids import map_bounds, occupancy_gradient, query_grid
from lardhm_torch.queries.raycasting import surface_step, thickness_counts
from lardhm_torch.scans import split_rays
from lardhm_torch.tiles import layout, local_maps
from lardhm_torch.tiles.indexing import tile_indices
from lardhm_torch.tiles.layout import layout_of, needed_tiles
from lardhm_torch.tiles.splitting import join_states, state_of

TOLERANCES = {torch.float32: 1e-4, F64: 1e-6}
both = pytest.mark.parametrize("dtype", [torch.float32, F64])


def assert_answers_alike(tiles, single, points, gradient_scale=1.0):
    """Probabilities, log-odds and gradients of the probability."""
    tolerance = TOLERANCES[single.centers.dtype]
    for ask in ("forward", "log_odds"):
        ours = tiles(points) if ask == "forward" else tiles.log_odds(points)
        theirs = getattr(single, ask)(points)
        assert ours.dtype == theirs.dtype
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)
    steep = [p.clone().requires_grad_() for p in (points, points)]
    ours = torch.autograd.grad(tiles(steep[0]).sum(), steep[0])[0]
    theirs = torch.autograd.grad(single(steep[1]).sum(), steep[1])[0]
    assert theirs.abs().max() > 0.1
    torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance * gradient_scale)


@both
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("block_clusters", [1, 64])
def test_answers_at_borders_are_those_of_the_merged_map(
    dtype, dim, block_clusters, tmp_path, monkeypatch
):
    tiles = tiled(random_map(1, dim, dtype), tmp_path, monkeypatch, block_clusters)
    assert len(tiles.manifest.tiles) > 10
    assert tiles._local.layout.block_tiles < 4
    assert_answers_alike(tiles, tiles.merge(), border_points(tiles, 5_000))


@both
def test_tiles_of_different_frames_answer_as_one(dtype, tmp_path, monkeypatch):
    model = random_map(2, dtype=dtype)
    tiles = reframed(tiled(model, tmp_path, monkeypatch))
    assert_answers_alike(tiles, tiles.merge(), border_points(tiles, 5_000))
    near = border_points(tiles, 100)
    assert (tiles(near) - model(near)).abs().median() < 1e-5
    part = tiles.merge((near[0], near[0]))
    torch.testing.assert_close(part(near[0]), tiles.merge()(near[0]))


@both
def test_far_from_the_origin_local_keep_their_digits(dtype, tmp_path, monkeypatch):
    """A map at 175 km, where float32 in the map's frame would know no centimeters."""
    model = random_map(2, dtype=dtype)
    tiles = reframed(tiled(model, tmp_path, monkeypatch))
    points = border_points(tiles, 1000)
    far = moved_away(tiles, 25_000)
    assert (far(points) - model.double()(points)).abs().median() < 1e-6


@torch.no_grad()
def test_in_float32_two_places_2_km_apart_are_both_answered_as_near_one_origin(
    tmp_path, monkeypatch
):
    """They have so few clusters that one block could hold both, but no one frame would do."""
    here, there = random_map(2), random_map(3)
    there.origin[0] += 286 * EDGE
    model = join_states([state_of(m) for m in (here, there)], here.settings, here.origin).float()
    tiles = reframed(tiled(model, tmp_path, monkeypatch, block_clusters=layout.BLOCK_CLUSTERS))
    points = border_points(tiles, 8000)[:4000]  # those near clusters
    truth, is_far = exact_map(tiles)(points), points[:, 0] > 1000
    ours, theirs = ((m(points) - truth).abs() for m in (tiles, tiles.merge()))
    torch.testing.assert_close(ours[~is_far], theirs[~is_far], rtol=0, atol=1e-6)
    assert ours.max() < 1e-4
    assert ours[is_far].mean() < theirs[is_far].mean() / 10


def real_map(folder):
    """A map of few rays, and enough clusters for several blocks."""
    scans, _ = split_rays(load_scans(folder), 0.03, seed=0)
    samples = sample_rays(scans, seed=0)
    return LardHilbertMap().fit(samples.points, samples.labels)


@pytest.mark.parametrize("name", ["kitti00_mulls", "balm_realworld"])
@torch.no_grad()
def test_2_km_from_the_origin_float32_tiles_of_real_maps_are_nearer_to_float64_than_one_map(
    name, data, tmp_path
):
    tiles = moved_away(TiledMap.split(real_map(data / name), tmp_path / "tiles", 15.0), 134)
    points = border_points(tiles, 100_000)
    truth = exact_map(tiles)(points)
    ours, theirs = ((m(points) - truth).abs() for m in (tiles, tiles.merge()))
    assert ours.median() < 2e-8
    assert ours.max() < 1e-4
    assert theirs.median() > 5e-7
    assert theirs.max() > 1e-3


@pytest.mark.parametrize("name", ["kitti00_mulls", "balm_realworld"])
def test_answers_of_real_maps_at_borders_are_those_of_the_merged_map(
    name, data, tmp_path, monkeypatch
):
    model = real_map(data / name)
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", 300)
    for dtype in (torch.float32, F64):
        tiles = TiledMap.split(model.to(dtype), tmp_path / str(dtype), 15.0)
        assert tiles._local.layout.block_tiles < 4
        assert_answers_alike(tiles, tiles.merge(), border_points(tiles, 100_000))


def test_a_map_split_and_merged_is_the_same_map(tmp_path, monkeypatch):
    model = random_map(dtype=torch.float32)
    tiles = tiled(model, tmp_path, monkeypatch)
    merged = tiles.merge()
    order = [torch.argsort(m.centers[:, 0]) for m in (model, merged)]
    for name, tensor in model.state_dict().items():
        if isinstance(tensor, torch.Tensor) and name != "origin":
            ours, theirs = tensor, merged.state_dict()[name]
            if len(ours) == len(model):
                ours, theirs = ours[order[0]], theirs[order[1]]
            assert torch.equal(ours, theirs), name
    assert torch.equal(merged.origin, model.origin)
    assert len(tiles) == len(model)
    assert map_bounds(tiles)[0].tolist() == pytest.approx(map_bounds(model)[0].tolist())


def test_a_part_answers_inside_its_bounds_like_the_whole(tmp_path, monkeypatch):
    tiles = tiled(random_map(2), tmp_path, monkeypatch)
    lower, upper = torch.tensor([103.0, 104, 105]).double(), torch.tensor([106.0, 108, 107])
    part, whole = tiles.merge((lower, upper)), tiles.merge()
    assert len(part) < len(whole)
    points = lower + (upper - lower) * torch.rand(2000, 3).double()
    torch.testing.assert_close(part.log_odds(points), whole.log_odds(points), rtol=0, atol=1e-8)
    torch.testing.assert_close(
        occupancy_gradient(part, points), occupancy_gradient(whole, points), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_every_neighbor_that_contributes_is_in_a_needed_tile(seed, tmp_path, monkeypatch):
    tiles = tiled(random_map(seed), tmp_path, monkeypatch)
    plan, model = layout_of(tiles.manifest), tiles.merge()
    points = border_points(tiles, 100, seed)
    indices, values = model._nearest_features(model._to_map_frame(points))
    contributes = (values * model.weights[indices]).abs() > 1e-9
    owners = tile_indices(model.centers, [0.0] * 3, EDGE)
    for point, near, contributing in zip(points, indices, contributes, strict=True):
        needed = {plan.indices[row] for row in needed_tiles(plan, point, point).tolist()}
        assert {tuple(owners[row].tolist()) for row in near[contributing]} <= needed


def test_one_cluster_with_a_large_support_does_not_require_the_whole_map(tmp_path, monkeypatch):
    model = random_map(3, clusters=4000)
    with torch.no_grad():
        model.raw_scale_tril[0].diagonal().fill_(3.0)  # 20 m, in a map of 20 m
    tiles = tiled(model, tmp_path, monkeypatch, edge=6.0)
    point = torch.full((3,), 110.0, dtype=F64)
    assert tiles._local.layout.radius.max() > 100
    assert len(needed_tiles(tiles._local.layout, point, point)) < len(tiles.manifest.tiles) / 2
    torch.testing.assert_close(tiles.log_odds(point), tiles.merge().log_odds(point))


def test_points_may_have_any_leading_shape_and_order(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    points = border_points(tiles, 600)
    expected = tiles.log_odds(points)
    order = torch.randperm(600, generator=torch.Generator().manual_seed(1))
    assert torch.equal(tiles.log_odds(points[order]), expected[order])
    assert torch.equal(tiles.log_odds(points.reshape(5, 6, 20, 3)), expected.reshape(5, 6, 20))
    assert torch.equal(tiles.log_odds(points[7]), expected[7])
    # torch.sigmoid rounds the last few numbers of a tensor, those that fill no vector register,
    # otherwise than the rest: the last bit of a probability depends on its place.
    one_bit = {"rtol": 2 * torch.finfo(F64).eps, "atol": 0}
    torch.testing.assert_close(tiles(points[order]), torch.sigmoid(expected[order]), **one_bit)
    assert tiles(points[:0]).shape == (0,)
    grouped = points[tile_indices(points, tiles.origin, EDGE)[:, 0].argsort()]
    torch.testing.assert_close(tiles(grouped), tiles.merge()(grouped))


def test_points_outside_all_tiles_are_answered_by_the_nearest_ones(tmp_path, monkeypatch):
    model = random_map(clusters=300)
    with torch.no_grad():
        model.weights.abs_()
    tiles = tiled(model, tmp_path, monkeypatch)
    corner = map_bounds(model)[0]
    near = (model.centers + model.origin)[model.centers[:, 0].argmin()].detach().clone()
    near[0] = tiles.manifest.origin[0] - 0.05  # the tiles begin at the origin
    index = tuple(tile_indices(near, tiles.origin, EDGE).tolist())
    assert index not in tiles.manifest.tiles
    assert tiles.log_odds(near) > 0.1
    torch.testing.assert_close(tiles.log_odds(near), tiles.merge().log_odds(near))
    torch.testing.assert_close(tiles.log_odds(corner), tiles.merge().log_odds(corner))


def test_far_from_everything_the_probability_is_a_half_and_nothing_is_read(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    for path in (tmp_path / "tiles" / "tiles").iterdir():
        path.unlink()
    far = torch.tensor([[1e4, 0, 0], [-1e12, 1, 1], [1e300, 0, 0]], dtype=F64).requires_grad_()
    assert tiles(far).tolist() == [0.5] * 3
    assert torch.autograd.grad(tiles(far).sum(), far)[0].abs().max() == 0
    axes = [torch.tensor([1e4, 2e4]).double()] * 3
    assert (tiles.query_lattice(axes) == 0.5).all()


def test_points_that_are_not_finite_have_no_probability(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    points = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0], [105, 105, 105]])
    assert tiles(points).isnan().tolist() == [True, True, False]


def test_a_lattice_is_answered_like_its_points(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    lower, upper = [99.0, 103, 103], [112.0, 106, 109]
    found = query_grid(tiles, lower, upper, 0.25)
    torch.testing.assert_close(found, query_grid(tiles.merge(), lower, upper, 0.25))
    assert ((found - 0.5).abs() > 0.1).any()


def same_surface(single, ours, tolerance):
    """Whether two meshes have the same vertices with the same colors, in any order, and faces."""
    assert len(single.vertices) == len(ours.vertices)
    distance, row = cKDTree(ours.vertices).query(single.vertices)
    assert distance.max() <= tolerance
    assert (single.visual.vertex_colors == ours.visual.vertex_colors[row]).all()
    faces = [np.sort(f, axis=1) for f in (row[single.faces], ours.faces)]
    assert {*map(tuple, faces[0].tolist())} == {*map(tuple, faces[1].tolist())}


@both
def test_a_mesh_has_no_seam(dtype, tmp_path, monkeypatch):
    """A blob around the corner where eight tiles meet, of clusters in all of them."""
    model = random_map(clusters=8).to(dtype)
    model.num_neighbors = 8  # all of them, so that none fades out in the middle
    shifts = 0.1 * torch.rand(8, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
        model.centers.copy_(EDGE + 0.2 * signs + shifts)
        model.raw_scale_tril.copy_(torch.diag_embed(torch.full((8, 3), np.log(0.2))))
        model.weights.fill_(3.0)
    tiles = tiled(model, tmp_path, monkeypatch, block_clusters=1)
    assert len(tiles.manifest.tiles) == 8
    single, ours = (
        extract_mesh(m, 0.04, 0.7, surface="crossing", log_odds_margin=None)
        for m in (tiles.merge(), tiles)
    )
    assert single.is_watertight
    assert ours.is_watertight
    assert len(ours.split()) == 1
    same_surface(single, ours, 1e-6 + 1e-4 * (dtype == torch.float32))


@pytest.mark.parametrize("color", ["height", "cluster", "probability"])
def test_a_mesh_across_many_blocks_is_that_of_the_merged_map(color, tmp_path, monkeypatch):
    model = wall_map()
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", 1)
    tiles = TiledMap.split(model, tmp_path / "tiles", 0.7)
    single, ours = (extract_mesh(m, 0.06, color=color) for m in (tiles.merge(), tiles))
    assert len(single.faces) > 500
    same_surface(single, ours, 1e-6)


def test_rays_end_where_they_do_in_the_merged_map(tmp_path, monkeypatch):
    tiles = tiled(random_map(clusters=600), tmp_path, monkeypatch)
    single = tiles.merge()
    rng = torch.Generator().manual_seed(0)
    origins = 100 + 20 * torch.rand(60, 3, generator=rng, dtype=F64)
    directions = torch.randn(60, 3, generator=rng, dtype=F64)
    for surface in ("peak", "crossing"):
        options = {"max_range": 8.0, "surface": surface}
        expected = raycast(single, origins, directions, **options)
        assert 5 < expected.isfinite().sum() < 60
        torch.testing.assert_close(raycast(tiles, origins, directions, **options), expected)
    assert raycast(tiles, origins + 1e5, directions, 5.0).isinf().all()
    unknown_stops = {"max_range": 5.0, "threshold": 0.1, "surface": "crossing"}
    assert raycast(tiles, origins + 1e5, directions, **unknown_stops).max() == 0


def test_the_step_of_rays_is_that_of_the_merged_map_and_no_tile_is_read(tmp_path, monkeypatch):
    tiles = tiled(random_map(clusters=600), tmp_path, monkeypatch)
    single = tiles.merge()
    for path in (tmp_path / "tiles" / "tiles").iterdir():
        path.unlink()
    assert tiles.thickness_counts() == thickness_counts(single)
    assert surface_step(TiledMap.open(tiles.folder)) == surface_step(single)


def test_segments_and_frontiers_are_those_of_the_merged_map(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    single = tiles.merge()
    rng = torch.Generator().manual_seed(0)
    starts, ends = 100 + 20 * torch.rand(2, 20, 3, generator=rng, dtype=F64)
    starts.requires_grad_()
    met = [segment_hazard(m, starts, ends) for m in (tiles, single)]
    assert met[1].max() > 0
    torch.testing.assert_close(*met)
    torch.testing.assert_close(*(torch.autograd.grad(m.sum(), starts)[0] for m in met))
    far = [expected_range(m, starts.detach(), ends - 110, 4.0) for m in (tiles, single)]
    torch.testing.assert_close(*far)
    found = [frontiers(m, [102] * 3, [107] * 3, 0.25) for m in (tiles, single)]
    assert torch.equal(found[0].points, found[1].points)


def test_variances_are_those_of_the_merged_map(tmp_path, monkeypatch):
    model = random_map()
    points = border_points(tiled(model, tmp_path, monkeypatch), 300)
    model.fit_uncertainty(points, (model(points) > 0.5).float())
    tiles = tiled(model, tmp_path / "sure", monkeypatch)
    for ask in ("variance", "bayesian_probability"):
        torch.testing.assert_close(getattr(tiles, ask)(points), getattr(model, ask)(points))
    far = torch.full((3,), 1e4)
    torch.testing.assert_close(tiles.variance(far), model.variance(far))
    assert torch.equal(tiles.merge().posterior_scales, model.posterior_scales)


def test_posteriors_learned_apart_are_none_of_the_whole(tmp_path, monkeypatch):
    model = random_map()
    points = border_points(tiled(model, tmp_path, monkeypatch), 300)
    answers = (model(points) > 0.5).float(), (points[:, 0] > 105).float()
    first, second = (random_map().fit_uncertainty(points, labels) for labels in answers)
    assert not torch.equal(first.posterior_scales, second.posterior_scales)
    with pytest.raises(RuntimeError, match="variance needs the posterior"):
        join_states([state_of(first), state_of(second)], model.settings, model.origin).variance(
            points
        )


def test_bad_arguments_are_named(tmp_path, monkeypatch):
    tiles = tiled(random_map(), tmp_path, monkeypatch)
    with pytest.raises(ValueError, match=r"points must be \(..., 3\).*got \(4, 2\)"):
        tiles(torch.zeros(4, 2))
    with pytest.raises(ValueError, match="bounds must be two corners of 3 coordinates"):
        tiles.merge(([0, 0], [1, 1]))
    with pytest.raises(ValueError, match="axes must be 3 lists"):
        tiles.query_lattice([torch.zeros(1)] * 2)
    with pytest.raises(FileExistsError, match="it holds a tiled map already"):
        TiledMap.split(random_map(), tmp_path / "tiles", EDGE)
    with pytest.raises(ValueError, match="it is empty: fit it first"):
        TiledMap.split(LardHilbertMap(), tmp_path / "new", EDGE)
    with pytest.raises(ValueError, match="edge must be > 0 m; got 0"):
        TiledMap.split(random_map(), tmp_path / "new", 0.0)
    with pytest.raises(AttributeError, match="no attribute 'fit'"):
        tiles.fit()


def test_a_part_of_a_tiled_map_is_meshed_from_the_tiles_that_it_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(local_maps, "PIECE_CLUSTERS", 1)  # a tile each
    tiles = tiled(random_map(1), tmp_path, monkeypatch)
    lower, upper = map_bounds(tiles)
    bounds = lower, lower + 0.3 * (upper - lower)
    assert 0 < len(list(tiles.pieces(bounds))) < len(list(tiles.pieces()))
    part, single = (extract_mesh(m, 0.2, bounds=bounds, color=None) for m in (tiles, tiles.merge()))
    assert len(part.faces) == len(single.faces) > 0
    ours, theirs = (mesh.vertices[np.lexsort(mesh.vertices.T)] for mesh in (part, single))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_parts_of_a_map_have_the_faces_of_the_whole(tmp_path, monkeypatch):
    """Also at their borders, and with vertices that move to the same places."""
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", 1)
    tiles = TiledMap.split(wall_map(), tmp_path / "tiles", 0.7)
    lower, upper = (bound.numpy() for bound in map_bounds(tiles))
    low, high = np.floor(lower / 0.05) - 1, np.ceil(upper / 0.05) + 1
    whole = extract_mesh(tiles, 0.05, color=None)
    middle = 8 * round(np.median(whole.vertices[:, 1]) / 0.4)  # a border of blocks
    parts = []
    for ends in ((low[1], middle), (middle, high[1])):
        corners = np.stack([low, high])
        corners[:, 1] = ends
        parts.append(extract_mesh(tiles, 0.05, bounds=(*(0.05 * corners),), color=None))
    joined = trimesh.util.concatenate(parts)
    joined.merge_vertices(merge_norm=True, digits_vertex=4)
    assert len(whole.faces) > 1000
    assert min(len(part.faces) for part in parts) > 200
    assert len(joined.faces) == pytest.approx(len(whole.faces), rel=0.001)
    assert len(joined.vertices) == pytest.approx(len(whole.vertices), rel=0.001)
    distance = cKDTree(joined.triangles_center).query(whole.triangles_center)[0]
    assert np.mean(distance > 1e-4) < 0.001
