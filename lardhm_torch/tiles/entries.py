"""What the manifest knows of one fitted tile, and the checks of its fields."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lardhm_torch.queries.raycasting import thickness_counts
from lardhm_torch.tiles.reach import largest_reach

MOST_BINS = 1 << 12  # of thickness, on either side of a meter: up to 2^256 m


@dataclass(frozen=True, kw_only=True)
class Tile:
    """What the manifest knows of a fitted tile without opening its file.

    Args:
        checksum: SHA-256 of the tile's map file, hexadecimal.
        num_points: training points of the tile's core.
        num_clusters: in the map file, 1 or more.
        bounds: lower and upper corner (D,) of the clusters' centers, world frame [m].
        reach: beyond this distance from its center no cluster says anything [m].
        thickness: how many clusters are in each of `surface.thickness_counts`' bins: the lowest
            bin, its count, and those of the bins above it; nothing where no cluster speaks for
            occupied.
    """

    checksum: str
    num_points: int
    num_clusters: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    reach: float
    thickness: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """A ValueError that names the field."""
        text = self.checksum
        if not isinstance(text, str) or len(text) != 64 or set(text) - set("0123456789abcdef"):
            raise ValueError(f"checksum must be 64 hexadecimal digits; got {text!r}")
        check_whole("num_points", self.num_points, 0)
        check_whole("num_clusters", self.num_clusters, 1)
        check_number("reach", self.reach, 0.0)
        _check_thickness(self.thickness)
        if not isinstance(self.bounds, tuple) or len(self.bounds) != 2:
            raise ValueError(f"bounds must be a lower and an upper corner; got {self.bounds!r}")
        lower, upper = self.bounds
        for name, corner in (("lower", lower), ("upper", upper)):
            check_position(f"bounds ({name})", corner, len(lower))
        if any(low > high for low, high in zip(lower, upper, strict=True)):
            raise ValueError(f"bounds must be lower <= upper; got {self.bounds!r}")

    def thickness_counts(self) -> dict[int, int]:
        """As `surface.thickness_counts` of the tile's map."""
        first, *counts = self.thickness or (0,)
        return {first + place: count for place, count in enumerate(counts) if count}


def tile_record(model: Any, path: str | os.PathLike[str], num_points: int) -> Tile:
    """The manifest's entry of a tile whose map was saved to ``path``.

    Raises:
        ValueError: the map is empty.
    """
    if len(model) == 0:
        raise ValueError("a tile must hold clusters; the map is empty: leave the tile out")
    centers = model.centers.detach().double() + model.origin
    corners = (centers.amin(dim=0).tolist(), centers.amax(dim=0).tolist())
    return Tile(
        checksum=file_checksum(path),
        num_points=int(num_points),
        num_clusters=len(model),
        bounds=(tuple(corners[0]), tuple(corners[1])),
        reach=largest_reach(model.weights, model.scale_tril),
        thickness=_thickness(thickness_counts(model)),
    )


def _thickness(counts: Mapping[int, int]) -> tuple[int, ...]:
    """The field of that name."""
    if not counts:
        return ()
    bins = range(min(counts), max(counts) + 1)
    return bins[0], *(counts.get(number, 0) for number in bins)


def file_checksum(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def tile_to_json(tile: Tile) -> dict[str, Any]:
    """A tile's fields as plain values."""
    bounds = [list(corner) for corner in tile.bounds]
    return {**vars(tile), "bounds": bounds, "thickness": " ".join(map(str, tile.thickness))}


def tile_from_json(entry: Any) -> Tile:
    """What `tile_to_json` wrote; a ValueError that names the field where it is something else."""
    if not isinstance(entry, dict) or set(entry) != set(Tile.__dataclass_fields__):
        raise ValueError(f"a tile must have {list(Tile.__dataclass_fields__)}; got {entry!r}")
    bounds, text = entry["bounds"], entry["thickness"]
    if not isinstance(bounds, list):
        raise ValueError(f"bounds must be a lower and an upper corner; got {bounds!r}")
    numbers = text.split() if isinstance(text, str) else [""]
    if not all(number.removeprefix("-").isdecimal() for number in numbers):
        raise ValueError(f"thickness must be whole numbers; got {text!r}")
    corners = tuple(position_from_json(corner) for corner in bounds)
    return Tile(**{**entry, "bounds": corners, "thickness": tuple(map(int, numbers))})


def position_from_json(values: Any) -> tuple[float, ...]:
    """Coordinates in a list."""
    if not isinstance(values, list):
        raise ValueError(f"a position must be a list of numbers; got {values!r}")
    return tuple(values)


def check_whole(name: str, value: Any, least: int | None) -> None:
    """A ValueError where a field is no whole number, or too small."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number; got {value!r}")
    if least is not None and value < least:
        raise ValueError(f"{name} must be {least} or more; got {value}")


def check_number(name: str, value: Any, least: float) -> None:
    """A ValueError where a field is no finite number, or too small."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < least:
        raise ValueError(f"{name} must be a finite number, {least:g} or more; got {value!r}")


def check_position(name: str, values: Any, dim: int) -> None:
    """A ValueError where a field is no place in the world."""
    if not isinstance(values, tuple) or len(values) != dim:
        raise ValueError(f"{name} must be {dim} coordinates; got {values!r}")
    for value in values:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or abs(value) > 1e15:
            raise ValueError(f"{name} must be coordinates in meters; got {value!r}")


def _check_thickness(values: Any) -> None:
    if not isinstance(values, tuple) or len(values) == 1:
        raise ValueError(f"thickness must be a bin and counts; got {values!r}")
    for place, value in enumerate(values):
        check_whole("thickness", value, 0 if place else -MOST_BINS)
    if len(values) > MOST_BINS or (values and values[0] > MOST_BINS):
        raise ValueError(f"thickness must be bins -{MOST_BINS} to {MOST_BINS}; got {values!r}")
