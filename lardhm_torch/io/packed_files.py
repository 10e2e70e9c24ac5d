"""Packed maps as bytes: a table of integers, differences from an earlier table, checksums.

docs/map_format.md describes every byte. A packet holds the rows of a table that differ from those of
the packet before, so a file of consecutive packets is a map file, too; a single packet that holds all
rows is the usual one.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MAGIC = b"LARDPACK"
CHANNELS_MAGIC = b"LARDCHAN"  # of the block of channels before the packets, see `packed_blocks`
VERSION = 1
SUFFIX = ".lhm"
PRECISIONS = range(1, 17)
HEADER = struct.Struct("<8s4BIIIIIIIIdd")  # followed by the origin, D float64, and the rows
CHECKSUM = 12, 16  # bytes of the checksum of all other bytes
MOST_DIM = 64
MOST_INFLATED = 1100  # bytes from one of zlib, at most
PLANES = 4  # bytes of an integer
LEVEL = 6  # of zlib: 9 takes four times as long and saves 0.4 %


@dataclass(frozen=True, eq=False)
class Packed:
    """A map as integers.

    Attributes:
        table: (M, C) int32, one row per cluster; columns see `num_columns`.
        origin: (D,) float64, world = map + origin [m].
        precision: fractional bits of the columns.
        num_neighbors, covariance_scale, min_lengthscale: see `features.Kernel`.
    """

    table: np.ndarray
    origin: np.ndarray
    precision: int
    num_neighbors: int
    covariance_scale: float
    min_lengthscale: float

    @property
    def frame(self) -> tuple[object, ...]:
        """Everything except the table; differences are taken between tables of equal frames."""
        kernel = (self.num_neighbors, self.covariance_scale, self.min_lengthscale)
        return self.origin.tolist(), self.precision, *kernel


def num_columns(dim: int) -> int:
    """Columns of the table: kind, weight, D diagonal and D (D - 1) / 2 other factors, D centers."""
    return 2 + dim + dim * (dim + 1) // 2


def encode(packed: Packed, number: int = 0, base: Packed | None = None) -> bytes:
    """The packet of a map.

    Args:
        packed: the map.
        number: of the packet in its stream, from 0.
        base: the map of the packet before; None: write all rows.
    """
    table = packed.table
    before = table[:0] if base is None else base.table
    both = min(len(table), len(before))
    same = (table[:both] == before[:both]).all(axis=1)
    rows = np.concatenate([np.flatnonzero(~same), np.arange(both, len(table))]).astype(np.int32)
    values = table[rows]
    values[rows < both] -= before[rows[rows < both]]
    gaps = np.diff(rows, prepend=np.int32(-1))
    body = zlib.compress(to_planes(np.column_stack([gaps, values])), LEVEL)
    lead = (MAGIC, VERSION, len(packed.origin), packed.precision, int(base is None))
    sizes = (len(body), number, packed.num_neighbors, len(table), len(rows))
    checks = (_checksum(before), _checksum(table))
    scales = (packed.covariance_scale, packed.min_lengthscale)
    header = HEADER.pack(*lead, 0, *sizes, *checks, *scales)
    packet = header + packed.origin.astype("<f8").tobytes() + body
    start, end = CHECKSUM
    return packet[:start] + struct.pack("<I", _packet_checksum(packet)) + packet[end:]


def decode(packet: bytes, base: tuple[int, Packed] | None = None) -> tuple[int, Packed]:
    """Number and map of a packet.

    Args:
        packet: the bytes of one packet.
        base: number and map of the packet before; None: the packet must hold all rows.

    Raises:
        ValueError: the packet is damaged, of a newer version, or not the one that follows ``base``.
    """
    if len(packet) < HEADER.size or packet[: len(MAGIC)] != MAGIC:
        raise ValueError(f"packet must begin with {MAGIC.decode()} and a header; it does not")
    _, version, dim, precision, is_whole, checksum, *rest = HEADER.unpack(packet[: HEADER.size])
    length, number, neighbors, count, num_rows, check_before, check, scale, floor = rest
    if version != VERSION:
        raise ValueError(f"version of the packet must be {VERSION}; got {version}")
    if len(packet) != HEADER.size + 8 * dim + length or _packet_checksum(packet) != checksum:
        raise ValueError("the checksum or the length of the packet differs: it is damaged")
    _check_header(dim, precision, is_whole, (count, num_rows), packet)
    body = HEADER.size + 8 * dim
    origin = np.frombuffer(packet[HEADER.size : body], "<f8").astype(np.float64)
    if not np.isfinite([*origin, scale, floor]).all() or min(scale, floor) <= 0 or neighbors < 1:
        raise ValueError("origin and settings of the packet must be finite, settings > 0")
    columns, behind = from_planes(packet[body:], num_rows, 1 + num_columns(dim))
    if behind:
        raise ValueError(f"packet must hold {num_rows} rows, {length} bytes; it holds more")
    before = np.zeros((0, num_columns(dim)), np.int32)
    if not is_whole:
        before = _base_table(number, base, (origin.tolist(), precision, neighbors, scale, floor))
        if _checksum(before) != check_before:
            raise ValueError("packet must follow the map it was made from; it is of another stream")
    if count > len(before) + num_rows:
        raise ValueError(f"packet must hold all new rows of {count} clusters; it is too short")
    table = _patched(before, columns, count)
    if _checksum(table) != check:
        raise ValueError("the checksum of the map differs after this packet: it is damaged")
    return number, Packed(table, origin, precision, neighbors, scale, floor)


def _base_table(
    number: int, base: tuple[int, Packed] | None, frame: tuple[object, ...]
) -> np.ndarray:
    """The table that a packet of differences refers to."""
    if base is None:
        raise ValueError(
            f"the first packet must hold a whole map; got differences, number {number}"
        )
    expected = base[0] + 1
    if number != expected:
        reason = "was applied already" if number < expected else "came too early: some are missing"
        raise ValueError(
            f"packet must be number {expected} of the stream; number {number} {reason}"
        )
    if base[1].frame != frame:
        raise ValueError("packet must have the origin and settings of its stream; they differ")
    return base[1].table


def _check_header(
    dim: int, precision: int, is_whole: int, sizes: tuple[int, int], packet: bytes
) -> None:
    count, num_rows = sizes
    if not 1 <= dim <= MOST_DIM or precision not in PRECISIONS or is_whole not in (0, 1):
        raise ValueError(f"header must hold dim 1 to {MOST_DIM}, precision 1 to 16, flag 0 or 1")
    inflated = PLANES * num_rows * (1 + num_columns(dim))
    if num_rows > count or inflated > MOST_INFLATED * len(packet):
        raise ValueError(f"packet must hold {num_rows} rows of {count} clusters; it is too short")


def _patched(before: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    """The table before with the rows of a packet applied: first column, gaps; others, values."""
    rows = columns[:, 0].astype(np.int64).cumsum() - 1
    both = min(len(before), count)
    is_old = rows < both
    in_order = (columns[:, 0] > 0).all() and (len(rows) == 0 or rows[-1] < count)
    if not in_order or not np.array_equal(rows[~is_old], np.arange(both, count)):
        raise ValueError("rows of the packet must be in order, with all new clusters; they are not")
    table = np.zeros((count, before.shape[1]), np.int32)
    table[:both] = before[:both]
    table[rows] += columns[:, 1:]
    return table


def _packet_checksum(packet: bytes) -> int:
    start, end = CHECKSUM
    return zlib.crc32(packet[end:], zlib.crc32(packet[:start]))


def _checksum(table: np.ndarray) -> int:
    return zlib.crc32(table.astype("<i4").tobytes())


def to_planes(columns: np.ndarray) -> bytes:
    """(R, C) int32 -> C medians, and for each column its lowest bytes, its second bytes, and so on.

    Columns are relative to their medians and the sign is moved to the lowest bit, so that the upper
    bytes of most numbers are 0.
    """
    middle = np.sort(columns, axis=0)[len(columns) // 2] if len(columns) else columns.sum(axis=0)
    centered = columns - middle.astype(np.int32)
    folded = (centered << 1) ^ (centered >> 31)
    parts = np.ascontiguousarray(folded.T.astype("<i4"))[..., None].view(np.uint8)
    return middle.astype("<i4").tobytes() + parts.transpose(0, 2, 1).tobytes()


def from_planes(body: bytes, num_rows: int, width: int) -> tuple[np.ndarray, bytes]:
    """The reverse of `to_planes`, from compressed bytes; and the bytes that follow."""
    size = PLANES * (1 + num_rows) * width
    inflate = zlib.decompressobj()
    try:
        content = inflate.decompress(body, size + 1)
    except zlib.error as error:
        raise ValueError(f"rows of the packet must be compressed by zlib; {error}") from error
    if len(content) != size or not inflate.eof:
        raise ValueError(f"packet must hold {num_rows} rows, {size} bytes; it does not")
    middle = np.frombuffer(content, "<i4", width).astype(np.int32)
    planes = np.frombuffer(content, np.uint8, offset=PLANES * width)
    parts = planes.reshape(width, PLANES, num_rows)
    folded = np.ascontiguousarray(parts.transpose(2, 0, 1)).view("<u4")[..., 0].astype(np.uint32)
    table = middle + ((folded >> 1).astype(np.int32) ^ -(folded & 1).astype(np.int32))
    return table, inflate.unused_data


def packet_path(folder: Path, number: int) -> Path:
    """File of a packet in a folder of packets."""
    return folder / f"{number:08d}{SUFFIX}"


def packet_files(folder: str | os.PathLike[str]) -> list[Path]:
    """The files of a folder of packets, in order."""
    return sorted(p for p in Path(folder).iterdir() if re.fullmatch(r"\d{8}\.lhm", p.name))


def is_packed(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as a packed map does, or a folder holds packets."""
    path = Path(path)
    if path.is_dir():
        return bool(packet_files(path))
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(len(MAGIC)) in (MAGIC, CHANNELS_MAGIC)


def block_size(content: bytes) -> int:
    """Bytes of the block of channels that a file begins with; 0 if there is none.

    Raises:
        ValueError: the block is cut short.
    """
    if content[: len(CHANNELS_MAGIC)] != CHANNELS_MAGIC:
        return 0
    if len(content) < 24:
        raise ValueError("the block of channels is cut short")
    return 24 + sum(struct.unpack("<II", content[16:24]))


def read_packets(path: str | os.PathLike[str]) -> Iterator[bytes]:
    """The packets of a file, or of a folder with one file per packet, in order.

    Raises:
        ValueError: the last packet of a file is cut short, or something else follows it.
    """
    path = Path(path)
    if path.is_dir():
        yield from (file.read_bytes() for file in packet_files(path))
        return
    content = path.read_bytes()
    start = block_size(content)
    while start < len(content):
        size = _packet_size(content[start : start + HEADER.size])
        if start + size > len(content):
            raise CutShortError(start)
        yield content[start : start + size]
        start += size


class CutShortError(ValueError):
    """The last packet of a file, which begins at a byte, is not complete."""

    def __init__(self, start: int) -> None:
        super().__init__(f"the last packet, from byte {start} on, is cut short")
        self.start = start


def drop_unfinished(path: Path) -> None:
    """Remove the last packet of a file if it is cut short, as a killed writer leaves it."""
    try:
        for _ in read_packets(path):
            pass
    except CutShortError as error:
        os.truncate(path, error.start)


def _packet_size(header: bytes) -> int:
    """Bytes of the packet with this header; more than there can be if the header is cut short."""
    if header[: len(MAGIC)] != MAGIC[: len(header)]:
        raise ValueError(f"every packet must begin with {MAGIC.decode()}; one does not")
    if len(header) < HEADER.size:
        return HEADER.size
    _, _, dim, _, _, _, length, *_ = HEADER.unpack(header)
    return HEADER.size + 8 * dim + length


def load_packed(path: str | os.PathLike[str]) -> tuple[int, Packed]:
    """Number of the last packet, and the map, of a packed file or a folder of packets.

    Raises:
        ValueError: there is no packet, or one is damaged or missing; see `decode`.
    """
    found: tuple[int, Packed] | None = None
    try:
        for packet in read_packets(path):
            found = decode(packet, found)
        if found is None:
            raise ValueError("there is no packet")
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)} must be a complete packed map; {error}") from error
    return found
