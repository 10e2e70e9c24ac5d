"""Reading and verifying tiles, and a cache of tiles and maps with a memory limit."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections import OrderedDict
from collections.abc import Hashable
from pathlib import Path
from typing import Any, TypeVar

import torch

from lardhm_torch.channels import CLASS
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io.map_files import check_settings, decode_safetensors
from lardhm_torch.learning.channel_sums import (
    Layout,
    conformed,
    conformed_classes,
    joint_layout,
    no_sums,
    num_rows,
)
from lardhm_torch.learning.map_state import PER_MAP
from lardhm_torch.learning.state_checks import check_values
from lardhm_torch.learning.state_dicts import channel_shapes, spread_sums
from lardhm_torch.tiles.entries import Tile
from lardhm_torch.tiles.indexing import Folder, Index, tile_name, tile_path
from lardhm_torch.tiles.manifest import Manifest
from lardhm_torch.tiles.splitting import TileState, state_of

CLUSTER_BYTES = 1000  # upper bound for a 3-D float32 map with its index; twice as much in float64
Value = TypeVar("Value")
Entries = OrderedDict[Hashable, tuple[Value, int]]  # values and their sizes in bytes


class DamagedTileError(ValueError):
    """The file of a tile is missing, damaged, or differs from the manifest.

    Args:
        index: index of the tile, also an attribute.
        reason: what is wrong with the file.
    """

    def __init__(self, index: Index, reason: str) -> None:
        super().__init__(
            f"tile {tile_name(index)} of the map cannot be used; {reason}. Fit it again, or "
            "continue without it: TiledMap.open(folder, skip_damaged=True)"
        )
        self.index = index


class TileStore:
    """Reads the tiles of a folder.

    Args:
        folder: folder of the tiled map.
        manifest: its manifest.
        skip_damaged: treat a damaged tile as empty, with one warning, instead of raising an error.
        device: device of the tensors; None: the CPU.
    """

    def __init__(
        self,
        folder: Folder,
        manifest: Manifest,
        *,
        skip_damaged: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        self.folder, self.manifest = folder, manifest
        self.skip_damaged, self.device = skip_damaged, device
        self.dtype: torch.dtype = getattr(torch, manifest.dtype)
        self._empty = state_of(LardHilbertMap(**manifest.settings).to(self.dtype))
        self._warned: set[Index] = set()
        columns = num_rows(manifest.channels, manifest.dim) * (1 + manifest.dim)
        columns += len(manifest.channels.get(CLASS, ()))  # class weights
        self.bytes_per_cluster = cluster_bytes(manifest.dim, self.dtype) + 8 * columns

    def load(self, index: Index) -> TileState:
        """The tensors of a tile; those of an empty map if it is damaged and skipped.

        Raises:
            DamagedTileError: its file is missing, damaged, or differs from the manifest.
        """
        try:
            state = self._load(index)
        except DamagedTileError as error:
            if not self.skip_damaged:
                raise
            if index not in self._warned:
                self._warned.add(index)
                warnings.warn(f"a damaged tile was skipped: {error}", stacklevel=2)
            state = conformed_state(self._empty, {}, self.manifest.channels)
        return {name: tensor.to(self.device) for name, tensor in state.items()}

    def _load(self, index: Index) -> TileState:
        path, entry = tile_path(self.folder, index), self.manifest.tiles[index]
        try:
            content = path.read_bytes()
            if hashlib.sha256(content).hexdigest() != entry.checksum:
                raise ValueError(
                    f"the checksum of {path} differs from the manifest's: it was damaged, or "
                    "updated after the map was opened"
                )
            state, metadata = decode_safetensors(content)
            extra = json.loads(metadata.get("_extra_state", "null"))
            self._check(state, extra, entry, path)
            state = self._with_channels(state, extra)
        except (OSError, ValueError) as error:
            raise DamagedTileError(index, str(error)) from error
        return state

    def _with_channels(self, state: TileState, extra: dict[str, Any]) -> TileState:
        """The tensors with the channels of the manifest; a ValueError for channels that it has not."""
        count = len(state["weights"])
        given: dict[str, Any] = {**state, "_extra_state": extra}
        spread_sums(given, "", count)
        layout, shapes = channel_shapes(given, "", self.manifest.dim)
        for name, shape in shapes.items():
            if given[name].shape != (count, *shape):
                raise ValueError(
                    f"{name} must be {(count, *shape)}; got {tuple(given[name].shape)}"
                )
        check_values({name: given[name] for name in shapes})
        known = self.manifest.channels
        if set(joint_layout(known, layout)) != set(known) or not _has_classes(known, layout):
            raise ValueError(f"channels must be those of the manifest, {known}; got {layout}")
        return conformed_state({**state, **{name: given[name] for name in shapes}}, layout, known)

    def _check(self, state: TileState, extra: Any, entry: Tile, path: Path) -> None:
        """A ValueError unless settings, dtypes and shapes are those of the manifest."""
        missing = [name for name in self._empty if name not in state]
        if missing:
            raise ValueError(f"{path} must hold the tensors of a map; missing: {missing}")
        settings = check_settings(extra)
        found = {"dtype": state["centers"].dtype, "num_clusters": len(state["centers"])}
        wanted = {"dtype": self.dtype, "num_clusters": entry.num_clusters}
        found, wanted = {**settings, **found}, {**self.manifest.settings, **wanted}
        for name, value in wanted.items():
            if found.get(name) != value:
                raise ValueError(f"{name} must be {value}; {path} has {found.get(name)}")
        for name, empty in self._empty.items():
            rows = empty.shape if name in PER_MAP else (entry.num_clusters, *empty.shape[1:])
            if state[name].shape != rows or state[name].dtype != empty.dtype:
                raise ValueError(
                    f"{name} must be {tuple(rows)} of dtype {empty.dtype}; "
                    f"{path} has {tuple(state[name].shape)} of dtype {state[name].dtype}"
                )
        check_values({name: state[name] for name in self._empty})


def _has_classes(known: Layout, layout: Layout) -> bool:
    """Whether all classes of the second layout are in the first."""
    return set(layout.get(CLASS, ())) <= set(known.get(CLASS, ()))


def conformed_state(state: TileState, before: Layout, after: Layout) -> TileState:
    """The tensors of a map with the channels of a layout that has all of theirs; others are 0."""
    if not after:
        return state
    sums = state.get("channel_sums", no_sums(state["centers"], before))
    state = {**state, "channel_sums": conformed(sums, before, after)}
    if CLASS in after:
        none = state["centers"].new_zeros(len(sums), len(before.get(CLASS, ())))
        weights = state.get("class_weights", none)
        state["class_weights"] = conformed_classes(weights, before, after)
    return state


class Cache:
    """Maps and tiles by key, up to a number of bytes.

    When room is needed, tiles are dropped before maps, because their clusters are also in the maps
    that were made of them; among tiles and among maps, the least recently used are dropped first.
    """

    def __init__(self, limit: int, bytes_per_cluster: int) -> None:
        self.limit, self.bytes_per_cluster = limit, bytes_per_cluster
        self.num_bytes = 0
        self._tiles: Entries[TileState] = OrderedDict()
        self._maps: Entries[LardHilbertMap] = OrderedDict()

    def tile(self, key: Hashable) -> TileState | None:
        """The tile of this key, if it is in the cache."""
        return _latest(self._tiles, key)

    def map(self, key: Hashable) -> LardHilbertMap | None:
        """The map of this key, if it is in the cache."""
        return _latest(self._maps, key)

    def make_room(self, num_bytes: int) -> None:
        """Drop entries until ``num_bytes`` more fit, or the cache is empty."""
        while self._tiles and self.num_bytes + num_bytes > self.limit:
            self.num_bytes -= self._tiles.popitem(last=False)[1][1]
        while self._maps and self.num_bytes + num_bytes > self.limit:
            self.num_bytes -= self._maps.popitem(last=False)[1][1]

    def put_tile(self, key: Hashable, state: TileState) -> None:
        """Keep a tile, unless it is larger than the limit."""
        self._put(self._tiles, key, state, len(state["centers"]))

    def put_map(self, key: Hashable, model: LardHilbertMap) -> None:
        """Keep a map, unless it is larger than the limit."""
        self._put(self._maps, key, model, len(model))

    def _put(self, entries: Entries[Value], key: Hashable, value: Value, clusters: int) -> None:
        num_bytes = self.bytes_per_cluster * clusters
        self.make_room(num_bytes)
        if num_bytes <= self.limit:
            entries[key] = (value, num_bytes)
            self.num_bytes += num_bytes


def _latest(entries: Entries[Value], key: Hashable) -> Value | None:
    if key not in entries:
        return None
    entries.move_to_end(key)
    return entries[key][0]


def cluster_bytes(dim: int, dtype: torch.dtype) -> int:
    """Memory of a cluster in bytes, with its part of the search index."""
    return CLUSTER_BYTES * max(dim, 3) ** 2 // 9 * (dtype.itemsize // 4)
