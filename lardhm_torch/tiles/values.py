"""Channels of the hits of tiles on disk: blocks of positions and values, appended to a file per tile.

A block is the number of its bytes, int64, and tensors in the format of safetensors: ``points`` (H, D)
float32, relative to the lower corner of the tile [m], and each channel by name. Blocks may have different
channels, as scans may. A tile's file has the blocks that the ledger counts, in bytes.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from safetensors import torch as safetensors_torch
from torch import Tensor

from lardhm_torch.channels import Channels, check_channels, select_channels
from lardhm_torch.io.map_files import decode_safetensors
from lardhm_torch.learning.channel_sums import Hits
from lardhm_torch.tiles.indexing import Folder, Index, tile_indices, values_path
from lardhm_torch.tiles.records import Grid

_HEAD_BYTES = 8
_PREFIX = "channel_"  # a channel may be called points


def route_values(hits: Hits, grid: Grid) -> Iterator[tuple[Index, bytes]]:
    """A block for each tile that contains hits.

    Args:
        hits: world positions [m] and channels.
        grid: the tiles.
    """
    index = tile_indices(hits.points, grid.origin, grid.edge)
    corner = torch.tensor(grid.origin, dtype=torch.float64, device=index.device)
    inside = (hits.points.double() - corner - index * grid.edge).float()
    tiles, owner, counts = index.unique(dim=0, return_inverse=True, return_counts=True)
    groups = owner.argsort(stable=True).split(counts.tolist())
    for tile, rows in zip(tiles.tolist(), groups, strict=True):
        yield tuple(tile), _encode(inside[rows], select_channels(hits.channels, rows))


def _encode(points: Tensor, channels: Channels) -> bytes:
    tensors = {"points": points, **{_PREFIX + name: values for name, values in channels.items()}}
    compact = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    content = safetensors_torch.save(compact)
    return len(content).to_bytes(_HEAD_BYTES, "little") + content


def append_values(folder: Folder, index: Index, blocks: bytes) -> None:
    """Append blocks to the file of a tile; they count once the ledger is written."""
    path = values_path(folder, index)
    path.parent.mkdir(exist_ok=True)
    with open(path, "ab") as file:
        file.write(blocks)


def read_values(folder: Folder, index: Index, num_bytes: int) -> Iterator[Hits]:
    """The hits of the first blocks of a tile, ``num_bytes`` in total, a block at a time.

    Raises:
        ValueError: the file is missing, shorter than that, or damaged.
    """
    path = values_path(folder, index)
    try:
        with open(path, "rb") as file:
            while file.tell() < num_bytes:
                size = int.from_bytes(file.read(_HEAD_BYTES), "little")
                if size > num_bytes - file.tell():
                    raise ValueError(f"a block of {size} bytes does not fit into {num_bytes}")
                tensors, _ = decode_safetensors(file.read(size))
                points = tensors.pop("points")
                named = {name.removeprefix(_PREFIX): values for name, values in tensors.items()}
                yield Hits(points, check_channels(named, len(points)))
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(
            f"{path} must hold {num_bytes} bytes of channels; {error}. Tile the scans again"
        ) from error
