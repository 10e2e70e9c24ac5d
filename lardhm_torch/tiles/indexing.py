"""Indices of tiles, and the paths of their files.

A tile is a cube of the world. The tile with index i spans ``origin + edge * i`` to
``origin + edge * (i + 1)``, and its files are named after the index, such as ``3_-1_0``.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch.io.map_files import SAFETENSORS

LARGEST_INDEX = 1 << 40  # along an axis; beyond it, float64 positions are coarser than centimeters

Index = tuple[int, ...]
Folder = str | os.PathLike[str]


def tile_name(index: Index) -> str:
    """The name of a tile's files, without extension: (3, -1, 0) -> ``3_-1_0``.

    >>> tile_name((3, -1, 0))
    '3_-1_0'
    """
    return "_".join(str(int(i)) for i in index)


def tile_index(name: str) -> Index:
    """The index of a tile from its name.

    Raises:
        ValueError: it is not the name of a tile.
    """
    parts = name.split("_")
    if not all(part.removeprefix("-").isdecimal() and len(part) < 16 for part in parts):
        raise ValueError("the name of a tile must be whole numbers joined by _")
    index = tuple(int(part) for part in parts)
    if tile_name(index) != name or any(abs(i) > LARGEST_INDEX for i in index):
        raise ValueError("the name of a tile must be its index, without leading zeros")
    return index


def tile_path(folder: Folder, index: Index) -> Path:
    """The map file of a tile."""
    return Path(folder) / "tiles" / f"{tile_name(index)}{SAFETENSORS}"


def samples_path(folder: Folder, index: Index) -> Path:
    """The training points of a tile."""
    return Path(folder) / "samples" / tile_name(index)


def values_path(folder: Folder, index: Index) -> Path:
    """The channels of the hits of a tile."""
    return Path(folder) / "values" / tile_name(index)


def clusters_path(folder: Folder, index: Index) -> Path:
    """The clusters of a tile's own points, while the folder is fitted."""
    return Path(folder) / "clusters" / tile_name(index)


def tile_indices(points: Tensor, origin: Tensor | Sequence[float], edge: float) -> Tensor:
    """(..., D) world positions [m] -> (..., D) int64 index of the tile that contains each."""
    points = torch.as_tensor(points)
    corner = torch.as_tensor(origin, dtype=torch.float64, device=points.device)
    return ((points.double() - corner) / edge).floor().long()


def touching_tiles(index: Index) -> Iterator[Index]:
    """A tile and the tiles that share a face, an edge or a corner with it, in order."""
    for step in itertools.product((-1, 0, 1), repeat=len(index)):
        yield tuple(i + s for i, s in zip(index, step, strict=True))


def grid_origin(near: Tensor, edge: float) -> tuple[float, ...]:
    """Corner of the tile (0, ..., 0) of a new folder.

    Tile borders lie at odd multiples of edge / 2, so that the ground near height 0 is inside one
    layer of tiles, and the tiles of any two folders with the same edge and world frame coincide.

    Args:
        near: (D,) world position that the tile contains [m].
        edge: edge length of a tile [m].

    Returns:
        D world coordinates [m].
    """
    return tuple(edge * (round(float(x) / edge) - 0.5) for x in near)
