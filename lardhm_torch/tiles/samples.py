"""What tiles are learned from: labelled points on disk, one file a tile, and the ledger of them.

A record is a point relative to the tile's lower corner (float32, so micrometers in a tile of 20 m)
and one byte, whose bits say whether the point is `OCCUPIED`, and whether it is of the tile's `HALO`:
a copy of a point that lies just across the border. Files only grow. The ledger says how many records
of each file count; what a killed run left behind them is cut off by the next writer. Nothing is
forced to the disk (that would take milliseconds a tile): a file that a power failure cut is noticed by
its size.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.learning.clustering import points_where
from lardhm_torch.tiles.places import Index, samples_path, tile_index, tile_name

FORMAT_VERSION = 1
LEDGER_NAME, LOCK_NAME = "samples.json", "samples.lock"
OCCUPIED, HALO = 1, 2  # bits of a record's last byte
Records = NDArray[Any]


class Counts(NamedTuple):
    """Records of one file: occupied and free points of the tile's core, and copies in its halo."""

    hits: int = 0
    free: int = 0
    halo: int = 0

    @property
    def core(self) -> int:
        """Points of the tile itself."""
        return self.hits + self.free

    def plus(self, other: Counts) -> Counts:
        """Both together."""
        return Counts(*(ours + theirs for ours, theirs in zip(self, other, strict=True)))


@dataclass(frozen=True, kw_only=True)
class Ledger:
    """Which records count, and how far the scans are routed.

    Args:
        tiles: records of each tile's file.
        chunks: pieces of the scans that are in the files; 0 once all are.
        rays: in those pieces.
        complete: whether all scans are in.
    """

    tiles: Mapping[Index, Counts] = field(default_factory=dict)
    chunks: int = 0
    rays: int = 0
    complete: bool = False

    @property
    def cores(self) -> list[Index]:
        """The tiles that points of their own fell into, in order."""
        return sorted(index for index, counts in self.tiles.items() if counts.core)


def record_type(dim: int) -> np.dtype[Any]:
    """One point of a sample file."""
    return np.dtype([("position", "<f4", (dim,)), ("kind", "u1")])


def write_ledger(folder: str | os.PathLike[str], ledger: Ledger) -> None:
    """Make the records of a ledger count, in one step."""
    tiles = {tile_name(index): list(counts) for index, counts in sorted(ledger.tiles.items())}
    page = {"format_version": FORMAT_VERSION, **vars(ledger), "tiles": tiles}
    with replaced_file(Path(folder) / LEDGER_NAME) as partial:
        partial.write_text(json.dumps(page), encoding="utf-8")


def read_ledger(folder: str | os.PathLike[str]) -> Ledger:
    """The ledger of a folder.

    Raises:
        FileNotFoundError: the folder holds none: its training points were never routed, or are gone.
        ValueError: it is damaged or of another format.
    """
    path = Path(folder) / LEDGER_NAME
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} must hold the training points of its tiles; it has no {path.name}. "
            "`lardhm tile` makes it"
        )
    try:
        page = json.loads(path.read_text(encoding="utf-8"))
        if page.pop("format_version") != FORMAT_VERSION:
            raise ValueError(f"format_version must be {FORMAT_VERSION}")
        tiles = {tile_index(name): Counts(*map(int, row)) for name, row in page["tiles"].items()}
        return Ledger(**{**page, "tiles": tiles})
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} must be the ledger of a tiled map, whole; {error}") from error


def append_records(folder: str | os.PathLike[str], index: Index, records: Records) -> None:
    """Write records behind those of a tile; they count once the ledger says so."""
    with open(samples_path(folder, index), "ab") as file:
        file.write(records.tobytes())


@contextmanager
def appending(folder: str | os.PathLike[str], dim: int) -> Iterator[Ledger]:
    """A block that appends records; before it, and if it fails, the files are cut to what counts.

    Raises:
        ValueError: another process is appending, or a file is shorter than the ledger says.
    """
    with open(Path(folder) / LOCK_NAME, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ValueError(
                f"{folder} must have one writer at a time; another process adds points to it"
            ) from error
        try:
            yield _roll_back(folder, dim)
        except BaseException:
            _roll_back(folder, dim)
            raise


def _roll_back(folder: str | os.PathLike[str], dim: int) -> Ledger:
    """Cut off records that do not count, and whole files of them; what is left is the ledger's."""
    ledger = read_ledger(folder)
    parent = Path(folder) / "samples"
    parent.mkdir(exist_ok=True)
    size = record_type(dim).itemsize
    wanted = {tile_name(index): size * sum(counts) for index, counts in ledger.tiles.items()}
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
            "The file was cut: tile the scans anew"
        )
    return ledger


def count_records(records: Records) -> Counts:
    """How many there are of each kind."""
    free, hits, *halo = np.bincount(records["kind"], minlength=4).tolist()
    return Counts(hits, free, sum(halo))


def read_records(
    folder: str | os.PathLike[str], index: Index, counts: Counts, dim: int, limit: int
) -> Records:
    """The records of a tile that count, or ``limit`` of them at even steps if there are more.

    Raises:
        ValueError: the file is missing or shorter than the ledger says.
    """
    path, kind = samples_path(folder, index), record_type(dim)
    total = sum(counts)
    held = path.stat().st_size if path.is_file() else 0
    if held < total * kind.itemsize:
        raise ValueError(f"{path} must hold {total} points; it has {held} bytes: tile anew")
    if total <= limit:
        return np.fromfile(path, kind, total)
    rows = np.arange(limit, dtype=np.int64) * total // limit
    return np.memmap(path, kind, "r", shape=(total,))[rows]


class TilePoints(NamedTuple):
    """Training points of one tile, the frame of its corner: (N, D) [m], and their (N,) uint8 bits."""

    points: Tensor
    kind: Tensor

    @property
    def labels(self) -> Tensor:
        """(N,) 1 occupied, 0 free, of the points' dtype."""
        return (self.kind & OCCUPIED).to(self.points)

    @property
    def in_core(self) -> Tensor:
        """(N,) bool, False for copies in the halo."""
        return self.kind < HALO

    def core_points(self, label: int) -> Tensor:
        """(C, D) points of the core with this label."""
        return points_where(self.points, self.kind == label)


def unpack(
    records: Records, device: torch.device, dtype: torch.dtype, shift: Any = 0.0
) -> TilePoints:
    """Records as tensors, the points moved by (D,) [m]."""
    size = records.dtype["position"].itemsize
    blocks = np.dtype(
        {"names": ["position"], "formats": [f"V{size}"], "itemsize": records.itemsize}
    )
    # Copied as blocks of bytes: twice as fast as number by number. Aligned sums are faster, too.
    positions = records.view(blocks)["position"].copy().view("<f4").reshape(len(records), -1)
    points = torch.from_numpy(positions)
    points += torch.as_tensor(shift, dtype=torch.float32)
    kind = torch.from_numpy(records["kind"].copy())
    return TilePoints(points.to(device, dtype), kind.to(device))
