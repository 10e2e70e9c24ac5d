"""Maps of the few tiles that are needed in a block or box: read, joined, and cached."""

from __future__ import annotations

from collections.abc import Hashable, Iterator

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.tiles.blocks import block_box, blocks_of
from lardhm_torch.tiles.indexing import tile_indices
from lardhm_torch.tiles.layout import FLOAT32_RANGE, layout_of, needed_tiles
from lardhm_torch.tiles.splitting import TileState, join_states
from lardhm_torch.tiles.store import Cache, DamagedTileError, TileStore

PIECE_CLUSTERS = 1 << 14  # of a group of tiles in `LocalMaps.pieces`


class LocalMaps:
    """Maps that are valid in blocks and boxes of a tiled map (see `layout`).

    Args:
        store: reads the tiles.
        limit: bytes of clusters in memory at a time; the least recently used are dropped.
    """

    def __init__(self, store: TileStore, limit: int) -> None:
        self.store, self.cache = store, Cache(limit, store.bytes_per_cluster)
        self.layout = layout_of(store.manifest)
        self.origin = torch.tensor(store.manifest.origin, dtype=torch.float64, device=store.device)
        self._blocks = blocks_of(self.layout)
        self._block_indices = self._blocks.indices()
        self._block_rows: dict[int, Tensor] = {}  # rows of the needed tiles by number of the block
        self._damaged: dict[Hashable, dict[int, DamagedTileError]] = {}  # by key of the map

    def block_numbers(self, points: Tensor) -> Tensor:
        """(N, D) world positions -> (N,) int32 number of the block of each, -1 where none is."""
        index = tile_indices(points, self.layout.origin, self.layout.block_edge)
        return self._blocks.find(index)

    def of_block(self, number: int, points: Tensor) -> LardHilbertMap:
        """The map that is valid in a block.

        Args:
            number: from `block_numbers`.
            points: (N, D) world positions [m]; a damaged tile is an error only if their bounding
                box needs it.
        """
        if number not in self._block_rows:
            box = block_box(self.layout, self._block_indices[number])
            self._block_rows[number] = needed_tiles(self.layout, *box)
        return self._joined_map(self._block_rows[number], points)

    def of_box(self, lower: Tensor, upper: Tensor) -> LardHilbertMap:
        """The map that is valid in a box (D,) to (D,) [m]: that of a block if it contains the box."""
        corners = torch.stack([lower, upper])
        first, last = tile_indices(corners, self.layout.origin, self.layout.block_edge)
        number = int(self._blocks.find(first[None])[0])
        if torch.equal(first, last) and number >= 0:
            return self.of_block(number, corners)
        return self._joined_map(needed_tiles(self.layout, lower, upper), corners)

    def merged(self, bounds: tuple[Tensor, Tensor] | None) -> LardHilbertMap:
        """A new map, not cached, that is valid in a box (D,) to (D,), or everywhere."""
        if bounds is None:
            return self._join(list(self._tiles()), self.origin)
        rows = needed_tiles(self.layout, *bounds)
        return self._join([self._tile(row) for row in rows.tolist()], self._frame(rows))

    def whole(self) -> LardHilbertMap:
        """The map of all tiles, cached."""
        model = self.cache.map("whole")
        if model is None:
            rows = torch.arange(len(self.layout.indices))
            self._make_room(rows, "all clusters of the map")
            model = self.merged(None)
            self.cache.put_map("whole", model)
        return model

    def pieces(self, bounds: tuple[Tensor, Tensor] | None = None) -> Iterator[LardHilbertMap]:
        """Maps of groups of tiles, one at a time; with a box (D,) to (D,), of those that it needs.

        A group has at most `PIECE_CLUSTERS` clusters, or a quarter of what the limit allows. The groups
        do not depend on the box, so that those of the next box are cached.
        """
        needed = set(range(len(self.layout.indices)))
        if bounds is not None:
            needed = set(needed_tiles(self.layout, *bounds).tolist())
        most = min(PIECE_CLUSTERS, self.cache.limit // (4 * self.store.bytes_per_cluster))
        group: list[int] = []
        clusters = 0
        for row, count in enumerate([*self.layout.counts.tolist(), most]):
            if group and clusters + count > most:
                if not needed.isdisjoint(group):
                    yield self._piece(group)
                group, clusters = [], 0
            group.append(row)
            clusters += count

    def _piece(self, rows: list[int]) -> LardHilbertMap:
        """The map of some tiles, cached."""
        key = ("piece", *rows)
        model = self.cache.map(key)
        if model is None:
            model = self._join([self._tile(row) for row in rows], self._frame(torch.tensor(rows)))
            self.cache.put_map(key, model)
        return model

    def _joined_map(self, rows: Tensor, points: Tensor) -> LardHilbertMap:
        """The map of tiles (S,), cached; an error if the box of the points needs a damaged one."""
        key = ("joined", *rows.tolist())
        model = self.cache.map(key)
        if model is None:
            self._make_room(rows, "the tiles that are needed here")
            tiles, damaged = [], {}
            for row in rows.tolist():
                try:
                    tiles.append(self._tile(row))
                except DamagedTileError as error:
                    damaged[row] = error
            model = self._join(tiles, self._frame(rows))
            self.cache.put_map(key, model)
            self._damaged[key] = damaged
        if self._damaged[key]:
            corners = points.detach().double().cpu()
            for row in needed_tiles(self.layout, corners.amin(0), corners.amax(0)).tolist():
                if row in self._damaged[key]:
                    raise self._damaged[key][row]
        return model

    def _tiles(self) -> Iterator[TileState]:
        return (self._tile(row) for row in range(len(self.layout.indices)))

    def _tile(self, row: int) -> TileState:
        index = self.layout.indices[row]
        state = self.cache.tile(index)
        if state is None:
            state = self.store.load(index)
            self.cache.put_tile(index, state)
        return state

    def _frame(self, rows: Tensor) -> Tensor:
        """Origin (D,) of a map of tiles (S,), world frame [m].

        Within `FLOAT32_RANGE` of the origin of the tiled map it is that origin, as in the merged
        map: with another one, float32 would round points and centers differently, which sometimes
        changes the k-th nearest center. Farther away it is near the tiles, where float32 positions
        are accurate.
        """
        if len(rows) == 0:
            return self.origin
        lower, upper = self.layout.lower[rows].amin(dim=0), self.layout.upper[rows].amax(dim=0)
        origin = self.origin.cpu()
        if torch.maximum(upper - origin, origin - lower).max() <= FLOAT32_RANGE:
            return self.origin
        return ((lower + upper) / 2).round().to(self.origin)

    def _join(self, tiles: list[TileState], origin: Tensor) -> LardHilbertMap:
        manifest = self.store.manifest
        channels = manifest.channels, manifest.class_scale
        model = join_states(tiles, manifest.settings, origin, *channels)
        return model.to(self.store.device, self.store.dtype)

    def _make_room(self, rows: Tensor, purpose: str) -> None:
        """Drop cached entries so that these tiles and the map of them fit the limit."""
        clusters = int(self.layout.counts[rows].sum())
        bytes_each = self.store.bytes_per_cluster
        needed = 2 * clusters * bytes_each
        if needed > self.cache.limit:
            raise ValueError(
                f"memory_limit must be {needed} bytes or more to hold {purpose}; "
                f"got {self.cache.limit}"
            )
        cached = [self.cache.tile(self.layout.indices[row]) for row in rows.tolist()]
        clusters = 2 * clusters - sum(len(tile["weights"]) for tile in cached if tile is not None)
        self.cache.make_room(clusters * bytes_each)
