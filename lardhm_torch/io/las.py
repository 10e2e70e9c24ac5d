"""LAS and LAZ through laspy (extra "io"): scaled coordinates and return numbers."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.las_channels import BYTE, channels_of, joined_channels, white_of
from lardhm_torch.io.moving_sensor import TRACK_FILES
from lardhm_torch.io.notes import Note
from lardhm_torch.io.poses import find_beside
from lardhm_torch.io.readout import Readout

_ROWS = 1 << 14  # scaled at a time
_BYTES_AT_A_TIME = 1 << 25
_VLR_BYTES = 54
_WITHHELD = "points flagged as withheld are left out"
# LAZ item type -> compressed layers (point, color, color and infrared, wave packet); extra bytes
# (14) have one each, items of older formats none.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}


def read_las(path: Path) -> Readout:
    """Coordinates X scale + offset, float64, and the return number of each point.

    Channels: intensity, color of 16 bits, or of 8 where no value is above 255, and classification, of
    which 0 (never classified) is missing. Those that are 0 at all points are left out.

    Points flagged as withheld are left out. A return number of 0, which the format forbids, is what
    writers leave when they know none: such points count as first returns.

    Raises:
        ImportError: laspy or its LAZ part is not installed.
        ValueError: the header is not one of LAS, or the file is shorter than it says.
    """
    found = list(_las_pieces(path, None))
    pieces = [piece for piece, _ in found]
    if len(pieces) == 1:
        return pieces[0]
    parts = [(dict(piece.channels), len(piece.ends), white) for piece, white in found]
    returns = [piece.target_index for piece in pieces if piece.target_index is not None]
    times = [piece.times for piece in pieces if piece.times is not None]
    withheld = sum(note.count or 0 for piece in pieces for note in piece.notes)
    return replace(
        pieces[0],
        ends=np.concatenate([piece.ends for piece in pieces]),
        target_index=np.concatenate(returns),
        times=np.concatenate(times) if times else None,
        channels=joined_channels(parts),
        notes=(Note(_WITHHELD, withheld),) if withheld else (),
    )


def las_pieces(path: Path, max_points: int | None = None) -> Iterator[Readout]:
    """The same a piece of at most ``max_points`` (default: of 32 MB) at a time; errors as there.

    Colors count as 8-bit numbers until the first piece with a value above 255.
    """
    for piece, _ in _las_pieces(path, max_points):
        yield piece


def _las_pieces(path: Path, max_points: int | None) -> Iterator[tuple[Readout, float]]:
    """Pieces, and what was taken for the number of white in each."""
    with open(path, "rb") as file:
        header = _Header(file, path.stat().st_size)
        if header.is_compressed:
            _check_compressed(file, header)
    with_times = find_beside(path, TRACK_FILES) is not None
    got, white = 0, BYTE
    laspy = _import_laspy(path)
    step = max_points or max(1, _BYTES_AT_A_TIME // header.point_bytes)
    # One thread: the parallel reader allocates what the chunk table claims.
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
        reader.header.point_count = header.count
        for points in reader.chunk_iterator(step):
            got += len(points)
            white = white_of(points, white)
            yield _readout_of(points, with_times, white), white
    if got == 0 or got != header.count:
        raise ValueError(f"{header.count} points are declared, one is needed at least; got {got}")


def _readout_of(points: Any, with_times: bool, white: float) -> Readout:
    """The points that are not withheld; what lies within half a step of zero is at zero."""
    target = np.asarray(points.return_number).astype(np.int64)
    has_times = with_times and "gps_time" in points.point_format.dimension_names
    readout = Readout(
        _coordinates(points),
        target_index=target if target.all() else np.maximum(target, 1),
        origin_cure="Put its trajectory.txt (GPS time, x, y, z a line) or a pose file beside it",
        times=np.array(points.gps_time, dtype=np.float64) if has_times else None,
        channels=channels_of(points, white),
    )
    withheld = np.asarray(points.withheld)
    if not withheld.any():
        return readout
    is_kept = withheld == 0
    return readout.select(is_kept).noting(Note(_WITHHELD, int((~is_kept).sum())))


def _coordinates(points: Any) -> NDArray[np.float64]:
    """(n, 3) scaled coordinates, in blocks that fit in the cache."""
    ends = np.empty((len(points), 3))
    columns = [points[name] for name in "XYZ"]
    for start in range(0, len(points), _ROWS):
        block = ends[start : start + _ROWS]
        is_zero = True
        for axis, (scale, offset) in enumerate(zip(points.scales, points.offsets, strict=True)):
            values = columns[axis][start : start + _ROWS] * scale + offset
            if np.any(is_zero):
                is_zero &= np.abs(values) < scale / 2
            block[:, axis] = values
        if np.any(is_zero):
            block[is_zero] = 0
    return ends


def _import_laspy(path: Path) -> Any:
    try:
        import laspy
        import lazrs  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"{path} needs laspy. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    return laspy


class _Header:
    """The public header block, checked against the file size before anything is allocated."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        block = file.read(375).ljust(375, b"\0")
        if block[:4] != b"LASF" or size < 227:
            raise ValueError(f"a LAS file begins with LASF and 223 more bytes; got {block[:4]!r}")
        self.size = size
        self.header_size, self.points_at, self.num_vlrs = struct.unpack_from("<HII", block, 94)
        point_format, self.point_bytes, self.count = struct.unpack_from("<BHI", block, 104)
        if block[25] >= 4:
            (count,) = struct.unpack_from("<Q", block, 247)
            self.count = count or self.count  # some writers fill only the old field
        self.is_compressed = bool(point_format & 0xC0)
        if not self.header_size + self.num_vlrs * _VLR_BYTES <= self.points_at <= size:
            raise ValueError(
                f"{self.num_vlrs} variable records are declared before byte {self.points_at}; "
                f"the file has {size} bytes"
            )
        left = size - self.points_at
        if self.point_bytes < 20 or (
            not self.is_compressed and self.count * self.point_bytes > left
        ):
            raise ValueError(
                f"{self.count} points of {self.point_bytes} bytes are declared; got {left} bytes"
            )


def _check_compressed(file: BinaryIO, header: _Header) -> None:
    """Walk the chunks of a LAZ file by their headers alone.

    The decompressor allocates what the file claims, and ends the program if that fails: a damaged
    file must not reach it. A chunk in layers is one point as it is, the number of points,
    the bytes of each layer (all uint32), the layers.
    """
    items = _compressed_items(file, header)
    if sum(size for _, size in items) != header.point_bytes:
        raise ValueError(f"the compressed items {items} must add up to {header.point_bytes} bytes")
    table_at = _chunk_table_at(file, header)
    if table_at is None or any(kind not in _LAYERS and kind != 14 for kind, _ in items):
        return  # older formats: a plain stream, whose end the decompressor sees by itself
    num_layers = sum(size if kind == 14 else _LAYERS[kind] for kind, size in items)
    position, count = header.points_at + 8, 0
    while position < table_at:
        file.seek(position + header.point_bytes)
        sizes = _unpack(file, f"<{1 + num_layers}I")
        count += sizes[0]
        position = file.tell() + sum(sizes[1:])
    if position != table_at or count != header.count:
        raise ValueError(
            f"{header.count} points are declared up to byte {table_at}; "
            f"the chunks hold {count} up to byte {position}"
        )


def _compressed_items(file: BinaryIO, header: _Header) -> list[tuple[int, int]]:
    """(type, bytes) of each part of a point, from the LASzip record."""
    position = header.header_size
    for _ in range(header.num_vlrs):
        file.seek(position)
        _, user, record, length, _ = _unpack(file, "<H16sHH32s")
        if user.rstrip(b"\0") == b"laszip encoded" and record == 22204:
            file.seek(position + _VLR_BYTES + 32)
            (num_items,) = _unpack(file, "<H")
            if 34 + 6 * num_items != length:
                raise ValueError(f"{num_items} compressed items do not fit in {length} bytes")
            values = _unpack(file, f"<{3 * num_items}H")
            return list(zip(values[::3], values[1::3], strict=True))
        position += _VLR_BYTES + length
    raise ValueError("the points are compressed, but there is no LASzip record to say how")


def _chunk_table_at(file: BinaryIO, header: _Header) -> int | None:
    """Position of the chunk table; None where there are no points and no table."""
    if header.points_at + 8 > header.size:
        return None
    file.seek(header.points_at)
    (table_at,) = _unpack(file, "<q")
    if table_at == -1:  # written as a stream: the position is at the very end
        file.seek(header.size - 8)
        (table_at,) = _unpack(file, "<q")
    if not header.points_at + 8 <= table_at <= header.size - 8:
        raise ValueError(f"the chunk table is declared at byte {table_at} of {header.size}")
    file.seek(table_at + 4)
    (num_chunks,) = _unpack(file, "<I")
    if num_chunks > table_at - header.points_at:
        raise ValueError(f"{num_chunks} chunks are declared in a file of {header.size} bytes")
    return table_at


def _unpack(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    """Little-endian values at the file's position."""
    content = file.read(struct.calcsize(layout))
    if len(content) < struct.calcsize(layout):
        raise ValueError(f"{struct.calcsize(layout)} bytes are needed; the file ends before")
    return struct.unpack(layout, content)
