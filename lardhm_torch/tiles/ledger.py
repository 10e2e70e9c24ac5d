"""The ledger of a tiled folder: the number of valid training points of each tile.

Files of training points only grow. Records after the valid ones were left by a killed run; the next
writer truncates them. The files are not synchronized to disk (that would take milliseconds for each
tile): a file that was truncated by a power failure is recognized by its size.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lardhm_torch.learning.channel_sums import Layout, check_layout
from lardhm_torch.tiles.indexing import Folder, Index, tile_index, tile_name
from lardhm_torch.tiles.manifest import read_page, write_page
from lardhm_torch.tiles.records import Records, record_type

LEDGER_NAME, LOCK_NAME = "samples.json", "samples.lock"


class Counts(NamedTuple):
    """Numbers of records of a tile: its hits, its free points, and copies from its neighbors."""

    hits: int = 0
    free: int = 0
    halo: int = 0

    @property
    def core(self) -> int:
        """Number of points inside the tile."""
        return self.hits + self.free

    def plus(self, other: Counts) -> Counts:
        """The sums."""
        return Counts(*(ours + theirs for ours, theirs in zip(self, other, strict=True)))


@dataclass(frozen=True, kw_only=True)
class Ledger:
    """Which records count, and which part of the scans they come from.

    Args:
        tiles: number of records of each tile.
        chunks: number of pieces of the scans whose points are in the files.
        rays: number of rays in those pieces.
        complete: whether these are all scans.
        values: bytes of the channels of each tile that has any (`values`).
        channels: layout of all channels (`channel_sums`).
    """

    tiles: Mapping[Index, Counts] = field(default_factory=dict)
    chunks: int = 0
    rays: int = 0
    complete: bool = False
    values: Mapping[Index, int] = field(default_factory=dict)
    channels: Layout = field(default_factory=dict)

    @property
    def cores(self) -> list[Index]:
        """Tiles that contain points, not only copies from neighbors; in order."""
        return sorted(index for index, counts in self.tiles.items() if counts.core)


def count_records(records: Records) -> Counts:
    """Numbers of records by kind."""
    free, hits, *halo = np.bincount(records["kind"], minlength=4).tolist()
    return Counts(hits, free, sum(halo))


def write_ledger(folder: Folder, ledger: Ledger) -> None:
    """Write the ledger atomically; from then on its records count."""
    tiles = {tile_name(index): list(counts) for index, counts in sorted(ledger.tiles.items())}
    values = {tile_name(index): size for index, size in sorted(ledger.values.items())}
    body = {**vars(ledger), "tiles": tiles, "values": values}
    if not values:
        del body["values"], body["channels"]
    write_page(Path(folder) / LEDGER_NAME, body)


def read_ledger(folder: Folder) -> Ledger:
    """The ledger of a folder.

    Raises:
        FileNotFoundError: there is none: the folder has no training points.
        ValueError: it is damaged or has another format version.
    """
    path = Path(folder) / LEDGER_NAME
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} must hold the training points of its tiles; it has no {path.name}. "
            "`lardhm tile` writes it"
        )
    try:
        body = read_page(path)
        tiles = {tile_index(name): Counts(*map(int, row)) for name, row in body["tiles"].items()}
        values = {tile_index(name): int(n) for name, n in body.get("values", {}).items()}
        channels = check_layout(body.get("channels", {}))
        return Ledger(**{**body, "tiles": tiles, "values": values, "channels": channels})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} must be the complete ledger of a tiled map; {error}") from error


@contextmanager
def appending(folder: Folder, dim: int) -> Iterator[Ledger]:
    """A context in which records are appended; yields the ledger.

    At its start, and if it fails, records that do not count are removed from the files.

    Raises:
        ValueError: another process is appending, or a file is shorter than the ledger says.
    """
    with open(Path(folder) / LOCK_NAME, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ValueError(
                f"{folder} must have one writer at a time; another process is adding points to it"
            ) from error
        try:
            yield _roll_back(folder, dim)
        except BaseException:
            _roll_back(folder, dim)
            raise


def _roll_back(folder: Folder, dim: int) -> Ledger:
    """Remove all records that the ledger does not count."""
    ledger, size = read_ledger(folder), record_type(dim).itemsize
    records = {tile_name(index): size * sum(counts) for index, counts in ledger.tiles.items()}
    _truncate_files(Path(folder) / "samples", records)
    if ledger.values or (Path(folder) / "values").is_dir():
        values = {tile_name(index): size for index, size in ledger.values.items()}
        _truncate_files(Path(folder) / "values", values)
    return ledger


def _truncate_files(parent: Path, wanted: Mapping[str, int]) -> None:
    """Truncate files to the wanted numbers of bytes, by name, and remove all others."""
    parent.mkdir(exist_ok=True)
    with os.scandir(parent) as entries:
        found = {entry.name: entry.stat().st_size for entry in entries}
    for name, length in found.items():
        if name not in wanted:
            (parent / name).unlink()
        elif length > wanted[name]:
            os.truncate(parent / name, wanted[name])
    short = [name for name, length in wanted.items() if found.get(name, 0) < length]
    if short:
        raise ValueError(
            f"{parent / short[0]} must hold {wanted[short[0]]} bytes; got {found.get(short[0], 0)}. "
            "The file was truncated: tile the scans again"
        )
