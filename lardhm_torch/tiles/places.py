"""Where tiles are, and how they and their files are called.

A tile is a cube of the world: that of index i spans ``origin + edge * i`` to
``origin + edge * (i + 1)``, and its name is its index, as ``3_-1_0``.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

LARGEST_INDEX = 1 << 40  # of a tile along an axis; beyond it a float64 knows no centimeters

Index = tuple[int, ...]


def tile_name(index: Index) -> str:
    """The file name of a tile without its extension: (3, -1, 0) -> ``3_-1_0``.

    >>> tile_name((3, -1, 0))
    '3_-1_0'
    """
    return "_".join(str(int(i)) for i in index)


def tile_index(name: str) -> Index:
    """The index of a tile of that name; a ValueError where it is none."""
    parts = name.split("_")
    if not all(part.removeprefix("-").isdecimal() and len(part) < 16 for part in parts):
        raise ValueError("a tile's name must be whole numbers joined by _")
    index = tuple(int(part) for part in parts)
    if tile_name(index) != name or any(abs(i) > LARGEST_INDEX for i in index):
        raise ValueError("a tile's name must be its index, each number written in one way")
    return index


def tile_path(folder: str | os.PathLike[str], index: Index) -> Path:
    """The map file of a tile."""
    return Path(folder) / "tiles" / f"{tile_name(index)}.pt"


def samples_path(folder: str | os.PathLike[str], index: Index) -> Path:
    """The routed training points of a tile, without extension."""
    return Path(folder) / "samples" / tile_name(index)


def tile_indices(points: Tensor, origin: Any, edge: float) -> Tensor:
    """(..., D) world positions [m] -> (..., D) int64 index of the tile that each lies in."""
    points = torch.as_tensor(points)
    origin = torch.as_tensor(origin, dtype=torch.float64, device=points.device)
    return ((points.double() - origin) / edge).floor().long()


def touching_tiles(index: Index) -> Iterator[Index]:
    """A tile and those that touch it, in order."""
    for step in itertools.product((-1, 0, 1), repeat=len(index)):
        yield tuple(i + s for i, s in zip(index, step, strict=True))
