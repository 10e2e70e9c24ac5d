"""One map to tiles, and the tensors of tiles to one map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.learning.channel_sums import Layout, moved_sums
from lardhm_torch.learning.map_state import HISTORY, PER_MAP
from lardhm_torch.tiles.entries import tile_record
from lardhm_torch.tiles.indexing import Folder, tile_indices, tile_path
from lardhm_torch.tiles.manifest import MANIFEST_NAME, Manifest, write_manifest

TileState = dict[str, Tensor]  # the tensors of a tile's map by name


def split_map(model: LardHilbertMap, folder: Folder, edge: float) -> None:
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
        channels=model.channel_layout,
        class_scale=model.class_scale,
    )
    tile_path(folder, (0,)).parent.mkdir(parents=True, exist_ok=True)
    owners = tile_indices(model.centers.detach(), [0.0] * model.dim, edge)
    indices, owner, counts = torch.unique(owners, dim=0, return_inverse=True, return_counts=True)
    tiles = {}
    for index, rows in zip(
        indices.tolist(), owner.argsort(stable=True).split(counts.tolist()), strict=True
    ):
        tile, path = _select_clusters(model, rows), tile_path(folder, tuple(index))
        tile.save(path, evidence=False)
        tiles[tuple(index)] = tile_record(tile, path, int(tile.counts.sum()))
    write_manifest(folder, replace(manifest, tiles=tiles))


def _select_clusters(model: LardHilbertMap, rows: Tensor) -> LardHilbertMap:
    """A map of some of the clusters of another, in the same frame."""
    result = LardHilbertMap(**model.settings).to(model.centers)
    tensors = {
        name: tensor[rows] if isinstance(tensor, Tensor) and name not in PER_MAP else tensor
        for name, tensor in model.state_dict().items()
    }
    result.load_state_dict(tensors)
    return result


def state_of(model: LardHilbertMap) -> TileState:
    """The tensors of a map that answer queries, by name, not copied."""
    tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    return {name: tensor.detach() for name, tensor in tensors.items() if name not in HISTORY}


@torch.no_grad()
def join_states(
    states: list[TileState],
    settings: Mapping[str, Any],
    origin: Tensor,
    channels: Layout | None = None,
    class_scale: float = 1.0,
) -> LardHilbertMap:
    """One map of the clusters of several.

    Tensors of a map that has this origin already keep every bit. Posteriors are kept if all maps
    have the same factors, as the tiles of one map do; otherwise they were not learned together, and
    are dropped.

    Args:
        states: tensors of each map.
        settings: arguments of `LardHilbertMap`.
        origin: (D,) float64 origin of the result, world frame [m].
        channels: layout of the channels of all states; None: they have none.
        class_scale: factor on the class log-odds of the result.
    """
    result = LardHilbertMap(**settings)
    if states:
        parts = [_in_frame(state, origin) for state in states]
        tensors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        if "class_weights" in tensors and not bool(tensors["class_weights"].any()):
            del tensors["class_weights"]  # no tile has trained ones
        result = result.to(states[0]["centers"])
        scales = torch.stack([state["posterior_scales"] for state in states])
        if not torch.equal(scales, scales[:1].expand_as(scales)):
            tensors["posterior_variances"].zero_()
        extra = result.get_extra_state()
        if channels:
            extra |= {"channels": dict(channels), "class_scale": class_scale}
        whole = {"origin": origin, "posterior_scales": scales[0], "_extra_state": extra}
        result.load_state_dict({**tensors, **whole})
    result.origin = origin.clone()
    return result.requires_grad_(False)


def _in_frame(state: TileState, origin: Tensor) -> TileState:
    """The tensors with a row for each cluster, with positions relative to another origin."""
    tensors = {name: tensor for name, tensor in state.items() if name not in PER_MAP}
    if not torch.equal(state["origin"], origin):
        for name in ("centers", "means"):
            shift = state["origin"] - origin
            tensors[name] = (tensors[name].double() + shift).to(tensors[name].dtype)
        if "channel_sums" in tensors:
            eye = torch.eye(len(shift), dtype=shift.dtype, device=shift.device)
            tensors["channel_sums"] = moved_sums(tensors["channel_sums"], eye, shift)
    return tensors
