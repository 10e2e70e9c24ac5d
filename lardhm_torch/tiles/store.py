"""Tiles on disk and in memory: read when asked for, checked, and forgotten when room is needed."""

from __future__ import annotations

import os
import warnings
from collections import OrderedDict
from collections.abc import Hashable
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.map_state import OF_THE_WHOLE
from lardhm_torch.tiles.manifest import Index, Manifest, file_checksum, tile_name, tile_path

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
    """Maps by key, the latest used last; the others go when more bytes are asked for than allowed."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.num_bytes = 0
        self._entries: OrderedDict[Hashable, tuple[LardHilbertMap, int]] = OrderedDict()

    def get(self, key: Hashable) -> LardHilbertMap | None:
        """The map of this key, if it is still there."""
        if key not in self._entries:
            return None
        self._entries.move_to_end(key)
        return self._entries[key][0]

    def make_room(self, num_bytes: int) -> None:
        """Forget the longest unused maps until so much more fits."""
        while self._entries and self.num_bytes + num_bytes > self.limit:
            _, (_, freed) = self._entries.popitem(last=False)
            self.num_bytes -= freed

    def put(self, key: Hashable, model: LardHilbertMap) -> None:
        """Keep a map, if it fits at all."""
        num_bytes = cluster_bytes(model.dim, model.centers.dtype) * len(model)
        self.make_room(num_bytes)
        if num_bytes <= self.limit:
            self._entries[key] = (model, num_bytes)
            self.num_bytes += num_bytes


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
        self._warned: set[Index] = set()

    def load(self, index: Index) -> LardHilbertMap:
        """The map of one tile; an empty one if it is damaged and may be skipped.

        Raises:
            DamagedTileError: its file is missing, damaged, or not what the manifest says.
        """
        try:
            return self._load(index)
        except DamagedTileError as error:
            if not self.skip_damaged:
                raise
            if index not in self._warned:
                self._warned.add(index)
                warnings.warn(f"went on without a tile: {error}", stacklevel=2)
            return LardHilbertMap(**self.manifest.settings).to(self.device, self.dtype)

    def _load(self, index: Index) -> LardHilbertMap:
        path, entry = tile_path(self.folder, index), self.manifest.tiles[index]
        try:
            if file_checksum(path) != entry.checksum:
                raise ValueError(
                    f"the checksum of {path} differs from the manifest's: it was damaged, or "
                    "updated after the map was opened"
                )
            model = LardHilbertMap.load(path)
            found = {**model.settings, "dtype": model.centers.dtype, "num_clusters": len(model)}
            wanted = {**self.manifest.settings, "dtype": self.dtype}
            wanted["num_clusters"] = entry.num_clusters
            for name, value in wanted.items():
                if found[name] != value:
                    raise ValueError(f"{name} must be {value}; {path} has {found[name]}")
        except (OSError, ValueError) as error:
            raise DamagedTileError(index, str(error)) from error
        return model.to(self.device).requires_grad_(False)


@torch.no_grad()
def joined(models: list[LardHilbertMap], settings: Any, origin: Tensor) -> LardHilbertMap:
    """One map of the clusters of all, in their order, in the frame of ``origin`` (D,) world [m].

    Where that is a map's own frame its tensors keep every bit. Posteriors stay if they were learned
    together, of one map that was split; posteriors with other factors are no posterior of the whole.
    """
    result = LardHilbertMap(**settings)
    if models:
        states = [_in_frame(model, origin) for model in models]
        tensors = {name: torch.cat([state[name] for state in states]) for name in states[0]}
        result = result.to(models[0].centers)
        scales = torch.stack([model.posterior_scales for model in models])
        if not torch.equal(scales, scales[:1].expand_as(scales)):
            tensors["posterior_variances"].zero_()
        whole = {"origin": origin, "posterior_scales": scales[0]}
        result.load_state_dict({**tensors, **whole, "_extra_state": result.get_extra_state()})
    result.origin = origin.clone()
    return result.requires_grad_(False)


def _in_frame(model: LardHilbertMap, origin: Tensor) -> dict[str, Tensor]:
    """All (M, ...) tensors of a map, positions relative to another origin."""
    tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    own = tensors["origin"]
    for name in OF_THE_WHOLE:
        del tensors[name]
    if not torch.equal(own, origin):
        for name in ("centers", "means"):
            tensors[name] = (tensors[name].double() + (own - origin)).to(tensors[name].dtype)
    return tensors
