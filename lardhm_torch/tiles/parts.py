"""Maps of several tiles that together answer somewhere: read, joined, kept while there is room."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.tiles.layout import block_box, layout_of, needed_tiles, speaking_blocks
from lardhm_torch.tiles.places import tile_indices
from lardhm_torch.tiles.store import (
    Cache,
    DamagedTileError,
    TileState,
    TileStore,
    cluster_bytes,
    joined,
)

SAME_FRAME = 512.0  # [m] from the origin; there float32 rounds to 30 micrometers


class Parts:
    """What answers in blocks and boxes of a tiled map; `layout` says which tiles that takes.

    Args:
        store: reads the tiles.
        limit: bytes of clusters that are held at a time; what is unused longest goes first.
    """

    def __init__(self, store: TileStore, limit: int) -> None:
        self.store, self.cache = store, Cache(limit)
        self.layout = layout_of(store.manifest)
        self.origin = torch.tensor(store.manifest.origin, dtype=torch.float64, device=store.device)
        self._blocks = speaking_blocks(self.layout)
        self._block_indices = self._blocks.indices()
        self._block_rows: dict[int, Tensor] = {}  # tiles by block
        self._missing: dict[Any, dict[int, DamagedTileError]] = {}  # damaged tiles by joined map

    def number(self, points: Tensor) -> Tensor:
        """(N, D) world positions -> (N,) int32 number of the block of each, -1 where none speaks."""
        index = tile_indices(points, self.layout.origin, self.layout.block_edge)
        return self._blocks.find(index)

    def block(self, number: int, points: Tensor) -> LardHilbertMap:
        """The map that answers in a block; damage matters only to the box of (N, D) world points."""
        if number not in self._block_rows:
            box = block_box(self.layout, self._block_indices[number])
            self._block_rows[number] = needed_tiles(self.layout, *box)
        return self._map_of(self._block_rows[number], points)

    def box(self, lower: Tensor, upper: Tensor) -> LardHilbertMap:
        """The map that answers in a box (D,) to (D,): that of a block, if the box lies in one."""
        corners = torch.stack([lower, upper])
        first, last = tile_indices(corners, self.layout.origin, self.layout.block_edge)
        number = int(self._blocks.find(first[None])[0])
        if torch.equal(first, last) and number >= 0:
            return self.block(number, corners)
        return self._map_of(needed_tiles(self.layout, lower, upper), corners)

    def cut(self, bounds: tuple[Tensor, Tensor] | None) -> LardHilbertMap:
        """A new map that answers in a box (D,) to (D,), or, None, everywhere."""
        if bounds is None:
            return self._joined(list(self._tiles()), self.origin)
        rows = needed_tiles(self.layout, *bounds)
        return self._joined([self._tile(row) for row in rows.tolist()], self._frame(rows))

    def whole(self) -> LardHilbertMap:
        """The map of all tiles, kept."""
        model = self.cache.map("whole")
        if model is None:
            rows = torch.arange(len(self.layout.indices))
            self._make_room(rows, "all clusters, which are asked for")
            model = self.cut(None)
            self.cache.put_map("whole", model)
        return model

    def pieces(self) -> Iterator[LardHilbertMap]:
        """The tiles' own maps, one after the other."""
        return (self._joined([tile], tile["origin"]) for tile in self._tiles())

    # --- how ---

    def _map_of(self, rows: Tensor, points: Tensor) -> LardHilbertMap:
        """One map of tiles (S,), kept; an error if one that the points' box needs is damaged."""
        key = ("joined", *rows.tolist())
        model = self.cache.map(key)
        if model is None:
            self._make_room(rows, "the tiles that answer here")
            tiles, missing = [], {}
            for row in rows.tolist():
                try:
                    tiles.append(self._tile(row))
                except DamagedTileError as error:
                    missing[row] = error
            model = self._joined(tiles, self._frame(rows))
            self.cache.put_map(key, model)
            self._missing[key] = missing
        if self._missing[key]:
            corners = points.detach().double().cpu()
            for row in needed_tiles(self.layout, corners.amin(0), corners.amax(0)).tolist():
                if row in self._missing[key]:
                    raise self._missing[key][row]
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
        """Origin (D,) world [m] of a map of tiles (S,).

        Near the map's origin it is that one, as of the whole in one piece: in another frame, float32
        would round points and centers otherwise, and who is the k-th nearest is sometimes a matter
        of the last digit. Farther away that frame would lose what float32 can tell apart in one
        amid the clusters.
        """
        if len(rows) == 0:
            return self.origin
        lower, upper = self.layout.lower[rows].amin(dim=0), self.layout.upper[rows].amax(dim=0)
        origin = self.origin.cpu()
        if torch.maximum(upper - origin, origin - lower).max() <= SAME_FRAME:
            return self.origin
        return ((lower + upper) / 2).round().to(self.origin)

    def _joined(self, tiles: list[TileState], origin: Tensor) -> LardHilbertMap:
        model = joined(tiles, self.store.manifest.settings, origin)
        return model.to(self.store.device, self.store.dtype)

    def _make_room(self, rows: Tensor, what: str) -> None:
        """Forget what is unused longest, so that these tiles and what they make fit the limit."""
        clusters = int(self.layout.counts[rows].sum())
        bytes_each = cluster_bytes(len(self.origin), self.store.dtype)
        needed = 2 * clusters * bytes_each
        if needed > self.cache.limit:
            raise ValueError(
                f"memory_limit must be {needed} bytes or more to hold {what}; "
                f"got {self.cache.limit}"
            )
        there = [self.cache.tile(self.layout.indices[row]) for row in rows.tolist()]
        clusters = 2 * clusters - sum(len(tile["weights"]) for tile in there if tile is not None)
        self.cache.make_room(clusters * bytes_each)
