"""The manifest of a tiled map: where its tiles are, what is in them, and how to tell damage.

A folder holds ``manifest.json``, ``samples/<name>.*`` (training points routed to the tiles) and
``tiles/<name>.pt`` (one ordinary map file a tile). A tile is a cube of the world: that of index i
spans ``origin + edge * i`` to ``origin + edge * (i + 1)``, and its name is its index, as ``3_-1_0``.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.files import replaced_file
from lardhm_torch.tiles.reach import largest_reach

FORMAT_VERSION = 1
MANIFEST_NAME = "manifest.json"
DTYPES = ("float32", "float64")
SETTINGS = ("dim", "num_neighbors", "covariance_scale", "min_lengthscale")
_LARGEST_INDEX = 1 << 40  # of a tile along an axis; beyond it a float64 knows no centimeters

Index = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Tile:
    """What the manifest knows of a fitted tile without opening its file.

    Args:
        checksum: SHA-256 of the tile's map file, hexadecimal.
        num_points: training points of the tile's core.
        num_clusters: in the map file, 1 or more.
        bounds: lower and upper corner (D,) of the clusters' centers, world frame [m].
        reach: beyond this distance from its center no cluster says anything [m].
    """

    checksum: str
    num_points: int
    num_clusters: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    reach: float

    def __post_init__(self) -> None:
        """A ValueError that names the field."""
        text = self.checksum
        if not isinstance(text, str) or len(text) != 64 or set(text) - set("0123456789abcdef"):
            raise ValueError(f"checksum must be 64 hexadecimal digits; got {text!r}")
        _check_whole("num_points", self.num_points, 0)
        _check_whole("num_clusters", self.num_clusters, 1)
        _check_number("reach", self.reach, 0.0)
        if not isinstance(self.bounds, tuple) or len(self.bounds) != 2:
            raise ValueError(f"bounds must be a lower and an upper corner; got {self.bounds!r}")
        lower, upper = self.bounds
        for name, corner in (("lower", lower), ("upper", upper)):
            _check_position(f"bounds ({name})", corner, len(lower))
        if any(low > high for low, high in zip(lower, upper, strict=True)):
            raise ValueError(f"bounds must be lower <= upper; got {self.bounds!r}")


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """A tiled map on one page.

    Args:
        edge: of a tile [m].
        halo: how far around a tile its neighbors took part in its training [m].
        origin: (D,) world position of the corner where tile (0, 0, 0) begins [m].
        settings: the arguments that make an empty map like those of the tiles.
        dtype: of the tiles' tensors, "float32" or "float64".
        sampling: how the routed points were sampled, plain values.
        fitting: how tiles are fitted, plain values.
        seed: of sampling, clustering and training.
        tiles: the fitted tiles by index; one that no data fell into has no entry.
    """

    edge: float
    halo: float = 0.0
    origin: tuple[float, ...]
    settings: Mapping[str, Any]
    dtype: str = "float32"
    sampling: Mapping[str, Any] = field(default_factory=dict)
    fitting: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    tiles: Mapping[Index, Tile] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """A ValueError that names the field."""
        _check_number("edge", self.edge, 0.0)
        if not self.edge > 0:
            raise ValueError(f"edge must be > 0 m; got {self.edge}")
        _check_number("halo", self.halo, 0.0)
        _check_whole("seed", self.seed, None)
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {DTYPES}; got {self.dtype!r}")
        for name in ("settings", "sampling", "fitting", "tiles"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"{name} must be a table; got {getattr(self, name)!r}")
        if set(self.settings) != set(SETTINGS):
            raise ValueError(f"settings must be {list(SETTINGS)}; got {sorted(self.settings)}")
        for name in SETTINGS[:2]:
            _check_whole(f"settings.{name}", self.settings[name], 1)
        for name in SETTINGS[2:]:
            _check_number(f"settings.{name}", self.settings[name], 0.0)
            if not self.settings[name] > 0:
                raise ValueError(f"settings.{name} must be > 0; got {self.settings[name]}")
        _check_position("origin", self.origin, self.dim)
        for index, tile in self.tiles.items():
            if not isinstance(index, tuple) or len(index) != self.dim:
                raise ValueError(f"tiles must have {self.dim} whole numbers a name; got {index!r}")
            if len(tile.bounds[0]) != self.dim:
                raise ValueError(
                    f"bounds of tile {tile_name(index)} must have {self.dim} coordinates; "
                    f"got {len(tile.bounds[0])}"
                )

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return int(self.settings["dim"])


def tile_name(index: Index) -> str:
    """The file name of a tile without its extension: (3, -1, 0) -> ``3_-1_0``.

    >>> tile_name((3, -1, 0))
    '3_-1_0'
    """
    return "_".join(str(int(i)) for i in index)


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
    )


def file_checksum(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def write_manifest(folder: str | os.PathLike[str], manifest: Manifest) -> None:
    """Write ``manifest.json``, atomically; the folder must exist."""
    body = _to_json(manifest)
    page = {"format_version": FORMAT_VERSION, "checksum": _body_checksum(body), "map": body}
    with replaced_file(Path(folder) / MANIFEST_NAME) as partial:
        partial.write_text(json.dumps(page, indent=1), encoding="utf-8")


def read_manifest(folder: str | os.PathLike[str]) -> Manifest:
    """Read and check ``manifest.json``; nothing in it is trusted.

    Raises:
        FileNotFoundError: the folder holds no manifest.
        ValueError: the manifest is damaged, of another format, or a field is out of its range;
            the error names it.
    """
    path = Path(folder) / MANIFEST_NAME
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} must be the folder of a tiled map; it has no {path.name}"
        )
    try:
        page = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} must be JSON, whole; {error}") from error
    try:
        version = page.get("format_version") if isinstance(page, dict) else None
        if version != FORMAT_VERSION or isinstance(version, bool):
            raise ValueError(
                f"format_version must be {FORMAT_VERSION}; got {version!r}. "
                "A newer map needs a newer lardhm_torch"
            )
        body = page.get("map")
        if not isinstance(body, dict):
            raise ValueError(f"map must be a table; got {type(body).__name__}")
        if page.get("checksum") != _body_checksum(body):
            raise ValueError("checksum must be that of the content; the file was damaged or edited")
        return _from_json(body)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} must be the manifest of a tiled map; {error}") from error


def _to_json(manifest: Manifest) -> dict[str, Any]:
    tiles = {
        tile_name(index): {**vars(tile), "bounds": [list(corner) for corner in tile.bounds]}
        for index, tile in sorted(manifest.tiles.items())
    }
    plain = {name: dict(getattr(manifest, name)) for name in ("settings", "sampling", "fitting")}
    return {**vars(manifest), **plain, "origin": list(manifest.origin), "tiles": tiles}


def _from_json(body: dict[str, Any]) -> Manifest:
    fields = set(Manifest.__dataclass_fields__)
    if set(body) != fields:
        missing, unknown = sorted(fields - set(body)), sorted(set(body) - fields)
        raise ValueError(f"map must have all fields and no others; {missing=}, {unknown=}")
    if not isinstance(body["tiles"], dict):
        raise ValueError(f"tiles must be a table; got {type(body['tiles']).__name__}")
    tiles = {}
    for name, entry in body["tiles"].items():
        try:
            index = tile_index(name)
            tiles[index] = _tile_of(entry)
        except (TypeError, ValueError) as error:
            raise ValueError(f"tile {name!r}: {error}") from error
    return Manifest(**{**body, "origin": _position(body["origin"]), "tiles": tiles})


def _tile_of(entry: Any) -> Tile:
    if not isinstance(entry, dict) or set(entry) != set(Tile.__dataclass_fields__):
        raise ValueError(f"a tile must have {list(Tile.__dataclass_fields__)}; got {entry!r}")
    bounds = entry["bounds"]
    if not isinstance(bounds, list):
        raise ValueError(f"bounds must be a lower and an upper corner; got {bounds!r}")
    return Tile(**{**entry, "bounds": tuple(_position(corner) for corner in bounds)})


def tile_index(name: str) -> Index:
    """The index of a tile of that name; a ValueError where it is none."""
    parts = name.split("_")
    if not all(part.removeprefix("-").isdecimal() and len(part) < 16 for part in parts):
        raise ValueError("a tile's name must be whole numbers joined by _")
    index = tuple(int(part) for part in parts)
    if tile_name(index) != name or any(abs(i) > _LARGEST_INDEX for i in index):
        raise ValueError("a tile's name must be its index, each number written in one way")
    return index


def _position(values: Any) -> tuple[float, ...]:
    if not isinstance(values, list):
        raise ValueError(f"a position must be a list of numbers; got {values!r}")
    return tuple(values)


def _body_checksum(body: Any) -> str:
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _no_constant(name: str) -> Any:
    raise ValueError(f"numbers must be finite; got {name}")


def _check_whole(name: str, value: Any, least: int | None) -> None:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number; got {value!r}")
    if least is not None and value < least:
        raise ValueError(f"{name} must be {least} or more; got {value}")


def _check_number(name: str, value: Any, least: float) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < least:
        raise ValueError(f"{name} must be a finite number, {least:g} or more; got {value!r}")


def _check_position(name: str, values: Any, dim: int) -> None:
    if not isinstance(values, tuple) or len(values) != dim:
        raise ValueError(f"{name} must be {dim} coordinates; got {values!r}")
    for value in values:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or abs(value) > 1e15:
            raise ValueError(f"{name} must be coordinates in meters; got {value!r}")
