"""The manifest of a tiled map: settings of the map, and an entry for each tile.

It is a JSON file with a format version and a checksum, as the ledger of training points is, and can
be read without opening a tile.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.learning.channel_sums import Layout, check_layout
from lardhm_torch.tiles.entries import (
    Tile,
    check_number,
    check_position,
    check_whole,
    position_from_json,
    tile_from_json,
    tile_to_json,
)
from lardhm_torch.tiles.indexing import Folder, Index, tile_index, tile_name

FORMAT_VERSION = 3  # of the folder; 3: tiles are stored as safetensors
MANIFEST_NAME = "manifest.json"
DTYPES = ("float32", "float64")
SETTINGS = ("dim", "num_neighbors", "covariance_scale", "min_lengthscale")
OPTIONAL = {"channels": {}, "class_scale": 1.0}  # fields of maps with channels alone


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Description of a tiled map.

    Args:
        edge: edge length of a tile [m].
        halo: distance around a tile within which points of its neighbors were used to train it [m].
        origin: (D,) world position of the lower corner of tile (0, ..., 0) [m].
        settings: arguments of an empty `LardHilbertMap` like those of the tiles.
        dtype: dtype of the tiles' tensors, "float32" or "float64".
        sampling: the `SamplingConfig` of the training points, as plain values.
        fitting: the `FitConfig` of the tiles, as plain values.
        seed: random seed of sampling, clustering and training.
        tiles: entries of the fitted tiles by index. Tiles without points have none.
        channels: layout of the channels of all tiles (`channel_sums`); a tile may have fewer.
        class_scale: factor on the class log-odds (`LardHilbertMap.calibrate_classes`).

    Raises:
        ValueError: a field is out of range; the message names it.
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
    channels: Layout = field(default_factory=dict)
    class_scale: float = 1.0

    def __post_init__(self) -> None:
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
        _check_settings(self.settings)
        check_position("origin", self.origin, self.dim)
        check_layout(self.channels)
        check_number("class_scale", self.class_scale, 0.0)
        if not self.class_scale > 0:
            raise ValueError(f"class_scale must be > 0; got {self.class_scale}")
        for index, tile in self.tiles.items():
            if not isinstance(index, tuple) or len(index) != self.dim:
                raise ValueError(
                    f"tiles must be named by {self.dim} whole numbers each; got {index!r}"
                )
            if len(tile.bounds[0]) != self.dim:
                raise ValueError(
                    f"bounds of tile {tile_name(index)} must have {self.dim} coordinates; "
                    f"got {len(tile.bounds[0])}"
                )

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return int(self.settings["dim"])


def _check_settings(settings: Mapping[str, Any]) -> None:
    if set(settings) != set(SETTINGS):
        raise ValueError(f"settings must be {list(SETTINGS)}; got {sorted(settings)}")
    for name in SETTINGS[:2]:
        check_whole(f"settings.{name}", settings[name], 1)
    for name in SETTINGS[2:]:
        check_number(f"settings.{name}", settings[name], 0.0)
        if not settings[name] > 0:
            raise ValueError(f"settings.{name} must be > 0; got {settings[name]}")


def write_manifest(folder: Folder, manifest: Manifest) -> None:
    """Write ``manifest.json`` atomically; the folder must exist."""
    tiles = {tile_name(index): tile_to_json(tile) for index, tile in sorted(manifest.tiles.items())}
    plain = {name: dict(getattr(manifest, name)) for name in ("settings", "sampling", "fitting")}
    body = {**vars(manifest), **plain, "origin": list(manifest.origin), "tiles": tiles}
    used = {name: value for name, value in body.items() if OPTIONAL.get(name) != value}
    write_page(Path(folder) / MANIFEST_NAME, used)


def read_manifest(folder: Folder) -> Manifest:
    """Read and validate ``manifest.json``.

    Raises:
        FileNotFoundError: the folder has no manifest.
        ValueError: the manifest is damaged, has another format version, or a field is out of range;
            the message names it.
    """
    path = Path(folder) / MANIFEST_NAME
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} must be the folder of a tiled map; it has no {path.name}"
        )
    try:
        return _from_json(read_page(path))
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} must be the manifest of a tiled map; {error}") from error


def _from_json(body: dict[str, Any]) -> Manifest:
    fields = set(Manifest.__dataclass_fields__)
    body = {**OPTIONAL, **body}
    if set(body) != fields:
        missing, unknown = sorted(fields - set(body)), sorted(set(body) - fields)
        raise ValueError(f"its fields must be those of a manifest; {missing=}, {unknown=}")
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


# --- JSON files with a version and a checksum ---


def write_page(path: Path, body: dict[str, Any], *, durable: bool = True) -> None:
    """Write a table of plain values as JSON, atomically, with format version and checksum.

    ``durable`` is that of `replaced_file`.
    """
    page = {"format_version": FORMAT_VERSION, "checksum": body_checksum(body), "content": body}
    with replaced_file(path, durable=durable) as partial:
        partial.write_text(json.dumps(page), encoding="utf-8")


def read_page(path: Path) -> dict[str, Any]:
    """The table that `write_page` wrote.

    Raises:
        ValueError: the file is not JSON, has another version, or its checksum differs.
    """
    try:
        page = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it must be complete JSON; {error}") from error
    version = page.get("format_version") if isinstance(page, dict) else None
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise ValueError(
            f"format_version must be {FORMAT_VERSION}; got {version!r}. A newer folder needs a "
            "newer lardhm_torch; an older one must be tiled and fitted again from its scans"
        )
    body = page.get("content")
    if not isinstance(body, dict):
        raise ValueError(f"content must be a table; got {type(body).__name__}")
    if page.get("checksum") != body_checksum(body):
        raise ValueError("checksum must be that of the content; the file was damaged or edited")
    return body


def body_checksum(body: Any) -> str:
    """SHA-256 of plain values, independent of white space and order in the file, hexadecimal."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"numbers must be finite; got {name}")
