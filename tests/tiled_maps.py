"""Random maps, and the same in tiles, for the tests of tiled maps."""

from dataclasses import replace

import torch

from lardhm_torch import LardHilbertMap, TiledMap
from lardhm_torch.features import raw_factors
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.learning.parameters import assign_state
from lardhm_torch.tiles import layout
from lardhm_torch.tiles.entries import tile_record
from lardhm_torch.tiles.indexing import tile_path
from lardhm_torch.tiles.manifest import write_manifest
from lardhm_torch.tiles.splitting import join_states, state_of

F64 = torch.float64
EDGE = 7.0  # [m] of 3-D tiles: 27 of a random map
FLAT_EDGE = 5.0  # [m] of 2-D ones: 16


def random_map(seed=0, dim=3, dtype=F64, clusters=400, extent=20.0):
    """A map of an uneven world: most clusters small and in one half, some of empty space large."""
    rng = torch.Generator().manual_seed(seed)
    centers = extent * torch.rand(clusters, dim, generator=rng, dtype=F64)
    centers[::2, 0] /= 4
    factors = 0.1 * torch.randn(clusters, dim, dim, generator=rng, dtype=F64).tril(-1)
    sizes = 0.05 + 0.3 * torch.rand(clusters, dim, generator=rng, dtype=F64)
    sizes[::20] *= 2
    factors += torch.diag_embed(sizes)
    weights = 4 * torch.randn(clusters, generator=rng, dtype=F64)
    counts = torch.randint(1, 50, (clusters,), generator=rng)
    scatters = counts[:, None, None] * factors @ factors.mT
    model = LardHilbertMap(dim, num_neighbors=6).to(dtype)
    rows = new_rows(Clusters(counts, centers, scatters), weights > 0, 0.01)
    raw = raw_factors(factors)
    assign_state(model, replace(rows, weights=weights, raw_scale_tril=raw))
    model.origin = torch.full((dim,), 100.0, dtype=F64)
    return model


def tiled(model, folder, monkeypatch, block_clusters=64, edge=None):
    """The map in tiles, answered in blocks of few clusters, so that there are many."""
    monkeypatch.setattr(layout, "BLOCK_CLUSTERS", block_clusters)
    return TiledMap.split(model, folder / "tiles", edge or (EDGE if model.dim == 3 else FLAT_EDGE))


def reframed(tiles):
    """The same folder with every tile in a frame of its own, as fitted tiles are; opened anew."""
    entries = {}
    for index, tile in tiles.manifest.tiles.items():
        path = tile_path(tiles.folder, index)
        model = LardHilbertMap.load(path)
        join_states(
            [state_of(model)], model.settings, model.origin + 3.0 + EDGE * torch.tensor(index)
        ).save(path)
        entries[index] = tile_record(LardHilbertMap.load(path), path, tile.num_points)
    write_manifest(tiles.folder, replace(tiles.manifest, tiles=entries))
    return TiledMap.open(tiles.folder)


def moved_away(tiles, steps):
    """The same folder with the map's origin so many tiles away along each axis; opened anew.

    Where the world is stays as it is, and every tile keeps its own frame.
    """
    manifest = tiles.manifest
    origin = tuple(value - steps * manifest.edge for value in manifest.origin)
    moved = {tuple(i + steps for i in index): tile for index, tile in manifest.tiles.items()}
    for index, there in zip(sorted(manifest.tiles), sorted(moved), strict=True):
        tile_path(tiles.folder, index).rename(tile_path(tiles.folder, there))
    write_manifest(tiles.folder, replace(manifest, origin=origin, tiles=moved))
    return TiledMap.open(tiles.folder)


def exact_map(tiles):
    """The float64 map of all tiles in one piece, with the very numbers that they hold."""
    states = [
        state_of(LardHilbertMap.load(tile_path(tiles.folder, i)).double())
        for i in tiles.manifest.tiles
    ]
    return join_states(states, tiles.settings, tiles.origin)


def border_points(tiles, count, seed=0, within=0.5):
    """World positions near clusters and elsewhere, one coordinate within so much of a border [m]."""
    rng = torch.Generator().manual_seed(seed)
    edge, origin = tiles.manifest.edge, torch.tensor(tiles.manifest.origin, dtype=F64)
    lower, upper = (
        torch.tensor([t.bounds[i] for t in tiles.manifest.tiles.values()], dtype=F64)
        for i in (0, 1)
    )
    lower, upper = lower.amin(dim=0) - 1, upper.amax(dim=0) + 1
    points = lower + (upper - lower) * torch.rand(count, tiles.dim, generator=rng, dtype=F64)
    centers = tiles.merge().centers.double() + tiles.merge().origin
    near = torch.randint(len(centers), (count // 2,), generator=rng)
    jitter = 0.3 * torch.randn(count // 2, tiles.dim, generator=rng, dtype=F64)
    points[: count // 2] = centers[near] + jitter
    rows, axis = torch.arange(count), torch.randint(tiles.dim, (count,), generator=rng)
    border = origin[axis] + edge * ((points[rows, axis] - origin[axis]) / edge).round()
    offset = 2 * torch.rand(count, generator=rng, dtype=F64) - 1
    points[rows, axis] = border + within * offset
    return points
