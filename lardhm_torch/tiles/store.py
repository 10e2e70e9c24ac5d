"""Tiles on disk and in memory: read when asked for, checked, and forgotten when room is needed."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections import OrderedDict
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.learning.parameters import OF_THE_WHOLE
from lardhm_torch.tiles.entries import Tile
from lardhm_torch.tiles.manifest import Manifest
from lardhm_torch.tiles.places import Index, tile_name, tile_path
from lardhm_torch.tiles.tile_bytes import read_tensors

TileState = dict[str, Tensor]  # the tensors of a tile's map by name
BYTES_A_CLUSTER = 200  # of a 3-D float32 map with its index, no less than measured; float64 twice


class DamagedTileError(ValueError):
    """A tile's file is missing, damaged, or not what the manifest says; ``index`` is the tile's."""

    def __init__(self, index: Index, reason: str) -> None:
        super().__init__(
            f"tile {tile_name(index)} of the map cannot be used; {reason}. Fit it again, or go on "
            "without it: TiledMap.open(folder, skip_damaged=True)"
        )
        self.index = index


class Cache:
    """Maps and tiles by key, up to so many bytes.

    When more is asked for than allowed, tiles go first: they are in the maps that were made of them.
    Of tiles, and then of maps, those unused longest go.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.num_bytes = 0
        self._tiles: OrderedDict[Hashable, tuple[TileState, int]] = OrderedDict()
        self._maps: OrderedDict[Hashable, tuple[LardHilbertMap, int]] = OrderedDict()

    def tile(self, key: Hashable) -> TileState | None:
        """The tile of this key, if it is still there."""
        return _latest(self._tiles, key)

    def map(self, key: Hashable) -> LardHilbertMap | None:
        """The map of this key, if it is still there."""
        return _latest(self._maps, key)

    def make_room(self, num_bytes: int) -> None:
        """Forget until so much more fits."""
        for entries in (self._tiles, self._maps):
            while entries and self.num_bytes + num_bytes > self.limit:
                _, (_, freed) = entries.popitem(last=False)
                self.num_bytes -= freed

    def put_tile(self, key: Hashable, state: TileState) -> None:
        """Keep a tile, if it fits at all."""
        self._put(self._tiles, key, state, state["centers"])

    def put_map(self, key: Hashable, model: LardHilbertMap) -> None:
        """Keep a map, if it fits at all."""
        self._put(self._maps, key, model, model.centers)

    def _put(self, entries: OrderedDict[Any, Any], key: Hashable, value: Any, rows: Tensor) -> None:
        num_bytes = cluster_bytes(rows.shape[1], rows.dtype) * len(rows)
        self.make_room(num_bytes)
        if num_bytes <= self.limit:
            entries[key] = (value, num_bytes)
            self.num_bytes += num_bytes


def _latest(entries: OrderedDict[Any, Any], key: Hashable) -> Any | None:
    if key not in entries:
        return None
    entries.move_to_end(key)
    return entries[key][0]


def cluster_bytes(dim: int, dtype: torch.dtype) -> int:
    """Bytes that a cluster takes in memory, with its part of the search index."""
    return BYTES_A_CLUSTER * max(dim, 3) ** 2 // 9 * (dtype.itemsize // 4)


class TileStore:
    """Reads the tiles of one folder.

    Args:
        folder: of the tiled map.
        manifest: what it should hold.
        skip_damaged: warn of a damaged tile, once, and take it for empty.
        device: where tiles are put.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        manifest: Manifest,
        *,
        skip_damaged: bool = False,
        device: Any = None,
    ) -> None:
        self.folder, self.manifest = folder, manifest
        self.skip_damaged, self.device = skip_damaged, device
        self.dtype = getattr(torch, manifest.dtype)
        empty = LardHilbertMap(**manifest.settings).to(self.dtype)
        self._empty, self._extra = state_of(empty), empty.get_extra_state()
        self._warned: set[Index] = set()

    def load(self, index: Index) -> TileState:
        """The tensors of one tile; those of an empty map if it is damaged and may be skipped.

        Raises:
            DamagedTileError: its file is missing, damaged, or not what the manifest says.
        """
        try:
            state = self._load(index)
        except DamagedTileError as error:
            if not self.skip_damaged:
                raise
            if index not in self._warned:
                self._warned.add(index)
                warnings.warn(f"went on without a tile: {error}", stacklevel=2)
            state = self._empty
        return {name: tensor.to(self.device) for name, tensor in state.items()}

    def _load(self, index: Index) -> TileState:
        path, entry = tile_path(self.folder, index), self.manifest.tiles[index]
        try:
            content = bytearray(path.read_bytes())
            if hashlib.sha256(content).hexdigest() != entry.checksum:
                raise ValueError(
                    f"the checksum of {path} differs from the manifest's: it was damaged, or "
                    "updated after the map was opened"
                )
            state = read_tensors(content)
            if state is not None and self._is_usual(state, entry.num_clusters):
                return state
            return self._read_slowly(path, entry)
        except (OSError, ValueError) as error:
            raise DamagedTileError(index, str(error)) from error

    def _is_usual(self, state: dict[str, Any], num_clusters: int) -> bool:
        """Whether a state dict is that of a map like all others here; takes its settings out."""
        if state.pop("_extra_state", None) != self._extra or set(state) != set(self._empty):
            return False
        for name, empty in self._empty.items():
            rows = empty.shape if name in OF_THE_WHOLE else (num_clusters, *empty.shape[1:])
            if state[name].shape != rows or state[name].dtype != empty.dtype:
                return False
        return True

    def _read_slowly(self, path: Path, entry: Tile) -> TileState:
        model = LardHilbertMap.load(path)
        found = {**model.settings, "dtype": model.centers.dtype, "num_clusters": len(model)}
        wanted = {**self.manifest.settings, "dtype": self.dtype}
        wanted["num_clusters"] = entry.num_clusters
        for name, value in wanted.items():
            if found[name] != value:
                raise ValueError(f"{name} must be {value}; {path} has {found[name]}")
        return state_of(model)


def state_of(model: LardHilbertMap) -> TileState:
    """The tensors of a map by name, not copied."""
    tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    return {name: tensor.detach() for name, tensor in tensors.items()}


@torch.no_grad()
def joined(states: list[TileState], settings: Any, origin: Tensor) -> LardHilbertMap:
    """One map of the clusters of all, in their order, in the frame of ``origin`` (D,) world [m].

    Where that is a map's own frame its tensors keep every bit. Posteriors stay if they were learned
    together, of one map that was split; posteriors with other factors are no posterior of the whole.
    """
    result = LardHilbertMap(**settings)
    if states:
        parts = [_in_frame(state, origin) for state in states]
        tensors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        result = result.to(states[0]["centers"])
        scales = torch.stack([state["posterior_scales"] for state in states])
        if not torch.equal(scales, scales[:1].expand_as(scales)):
            tensors["posterior_variances"].zero_()
        whole = {"origin": origin, "posterior_scales": scales[0]}
        result.load_state_dict({**tensors, **whole, "_extra_state": result.get_extra_state()})
    result.origin = origin.clone()
    return result.requires_grad_(False)


def _in_frame(state: TileState, origin: Tensor) -> TileState:
    """All (M, ...) tensors of a map, positions relative to another origin."""
    tensors = {name: tensor for name, tensor in state.items() if name not in OF_THE_WHOLE}
    if not torch.equal(state["origin"], origin):
        for name in ("centers", "means"):
            shift = state["origin"] - origin
            tensors[name] = (tensors[name].double() + shift).to(tensors[name].dtype)
    return tensors
