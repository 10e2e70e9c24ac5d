"""An ordinary map written as a folder of tiles."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.learning.parameters import OF_THE_WHOLE
from lardhm_torch.tiles.entries import tile_record
from lardhm_torch.tiles.manifest import MANIFEST_NAME, Manifest, write_manifest
from lardhm_torch.tiles.places import tile_indices, tile_path


def split_map(model: LardHilbertMap, folder: str | os.PathLike[str], edge: float) -> None:
    """See `TiledMap.split`."""
    folder = Path(folder)
    if len(model) == 0:
        raise ValueError("the map must hold clusters to be split; it is empty: fit it first")
    if (folder / MANIFEST_NAME).exists():
        raise FileExistsError(f"{folder} must be a new folder; it holds a tiled map already")
    manifest = Manifest(
        edge=float(edge),
        origin=tuple(model.origin.tolist()),
        settings=model.settings,
        dtype=str(model.centers.dtype).removeprefix("torch."),
    )
    tile_path(folder, (0,)).parent.mkdir(parents=True, exist_ok=True)
    owners = tile_indices(model.centers.detach(), [0.0] * model.dim, edge)
    places, owner, counts = torch.unique(owners, dim=0, return_inverse=True, return_counts=True)
    tiles = {}
    for place, rows in zip(
        places.tolist(), owner.argsort(stable=True).split(counts.tolist()), strict=True
    ):
        tile, path = rows_of(model, rows), tile_path(folder, tuple(place))
        tile.save(path)
        tiles[tuple(place)] = tile_record(tile, path, int(tile.counts.sum()))
    write_manifest(folder, replace(manifest, tiles=tiles))


def rows_of(model: LardHilbertMap, rows: Tensor) -> LardHilbertMap:
    """A map of some clusters of another, in its frame."""
    result = LardHilbertMap(**model.settings).to(model.centers)
    tensors = {
        name: tensor[rows] if isinstance(tensor, Tensor) and name not in OF_THE_WHOLE else tensor
        for name, tensor in model.state_dict().items()
    }
    result.load_state_dict(tensors)
    return result
