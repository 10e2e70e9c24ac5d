import pytest
import torch
from tiled_maps import F64, border_points, random_map, tiled

from lardhm_torch import TiledMap
from lardhm_torch.tiles.store import cluster_bytes


def test_what_is_held_stays_below_the_memory_limit(tmp_path, monkeypatch):
    model = random_map(clusters=1000)
    tiled(model, tmp_path, monkeypatch)
    limit = 2200 * cluster_bytes(3, F64)
    tiles = TiledMap.open(tmp_path / "tiles", memory_limit=limit)
    points = border_points(tiled(model, tmp_path / "again", monkeypatch), 60)
    expected = model(points)
    for some in points.split(20):
        tiles(some)
        cache = tiles._local.cache
        held = sum(len(state["weights"]) for state, _ in cache._tiles.values())
        held += sum(len(part) for part, _ in cache._maps.values())
        assert held * cluster_bytes(3, F64) == cache.num_bytes
        assert held <= 2200
    torch.testing.assert_close(tiles(points), expected)


def test_a_cluster_takes_no_more_memory_than_is_counted(ops):
    model = random_map(clusters=5000, dtype=torch.float32)
    model(torch.zeros(1, 3))
    tensors = [*model.parameters(), *model.buffers(), model._index]
    assert sum(t.nbytes for t in tensors) <= len(model) * cluster_bytes(3, torch.float32)


def test_a_limit_too_small_for_a_block_is_an_error(tmp_path, monkeypatch):
    tiled(random_map(), tmp_path, monkeypatch)
    tiles = TiledMap.open(tmp_path / "tiles", memory_limit=1000)
    with pytest.raises(
        ValueError, match=r"memory_limit must be \d+ bytes or more to hold the tiles"
    ):
        tiles(torch.full((1, 3), 105.0))
    with pytest.raises(ValueError, match="to hold all clusters of the map; got 1000"):
        _ = tiles.centers
    with pytest.raises(ValueError, match="memory_limit must be > 0 bytes; got 0"):
        TiledMap.open(tmp_path / "tiles", memory_limit=0)
