"""The manifest of a tiled map: where its tiles are, what is in them, and how to tell damage.

A folder holds ``manifest.json``, ``samples/<name>.*`` (training points routed to the tiles) and
``tiles/<name>.pt`` (one ordinary map file a tile); `places` says what the names mean.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.tiles.entries import (
    Tile,
    check_number,
    check_position,
    check_whole,
    position_from_json,
    tile_from_json,
    tile_to_json,
)
from lardhm_torch.tiles.places import Index, tile_index, tile_name

FORMAT_VERSION = 2  # 1 knew nothing of how thick clusters are
MANIFEST_NAME = "manifest.json"
DTYPES = ("float32", "float64")
SETTINGS = ("dim", "num_neighbors", "covariance_scale", "min_lengthscale")


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
        check_number("edge", self.edge, 0.0)
        if not self.edge > 0:
            raise ValueError(f"edge must be > 0 m; got {self.edge}")
        check_number("halo", self.halo, 0.0)
        check_whole("seed", self.seed, None)
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype must be one of {DTYPES}; got {self.dtype!r}")
        for name in ("settings", "sampling", "fitting", "tiles"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"{name} must be a table; got {getattr(self, name)!r}")
        if set(self.settings) != set(SETTINGS):
            raise ValueError(f"settings must be {list(SETTINGS)}; got {sorted(self.settings)}")
        for name in SETTINGS[:2]:
            check_whole(f"settings.{name}", self.settings[name], 1)
        for name in SETTINGS[2:]:
            check_number(f"settings.{name}", self.settings[name], 0.0)
            if not self.settings[name] > 0:
                raise ValueError(f"settings.{name} must be > 0; got {self.settings[name]}")
        check_position("origin", self.origin, self.dim)
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
                "A newer map needs a newer lardhm_torch; an older folder must be made anew"
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
    tiles = {tile_name(index): tile_to_json(tile) for index, tile in sorted(manifest.tiles.items())}
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
            tiles[index] = tile_from_json(entry)
        except (TypeError, ValueError) as error:
            raise ValueError(f"tile {name!r}: {error}") from error
    return Manifest(**{**body, "origin": position_from_json(body["origin"]), "tiles": tiles})


def _body_checksum(body: Any) -> str:
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _no_constant(name: str) -> Any:
    raise ValueError(f"numbers must be finite; got {name}")
