"""PCD: ascii, binary and binary_compressed; VIEWPOINT is the sensor pose.

Files do not state whether VIEWPOINT is the viewpoint of points in the world frame (la3dm) or the
transform of points in the sensor frame (CloudCompare). ``frame="world"`` or
``frame="sensor"`` decides; without it a VIEWPOINT without rotation is assumed to be a viewpoint, and one
with a rotation is refused (`frames.placed`). PCL, Open3D and pypcd4 write VIEWPOINT 0 0 0 1 0 0 0 if they
have no pose. A field ``is_return`` marks beams without return; otherwise points of NaN in an organized
cloud are such beams, if its grid is one of angles (`no_returns.with_free_beams`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import CHANNEL_COLUMNS
from lardhm_torch.io.notes import Note
from lardhm_torch.io.readout import COLUMN_NAMES, RAY_COLUMNS, Readout, readout_from_columns
from lardhm_torch.io.records import (
    Columns,
    Field,
    bytes_left,
    column_type,
    header_count,
    header_lines,
    read_ascii,
    read_binary,
    record_size,
)
from lardhm_torch.io.trajectories import poses_from_quaternions

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
_ENTRIES = frozenset(
    {"VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT"}
    | {"WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
)
_LZF_RATIO = 88  # three bytes stand for 264 at most
_CURE = "Write the sensor position into VIEWPOINT"


@dataclass(frozen=True)
class _Header:
    fields: list[Field]
    count: int
    viewpoint: list[float] | None  # tx ty tz qw qx qy qz
    encoding: str
    num_lines: int
    grid: tuple[int, int] | None  # rows and columns of an organized cloud


def read_pcd(path: Path) -> Readout:
    """Fields x, y, z as ray ends and the position in VIEWPOINT as the sensor's.

    Fields ox, oy, oz, one origin a point, go before VIEWPOINT.

    Raises:
        ValueError: the header is not one of PCD, or the file is shorter than it says.

    Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    """
    with open(path, "rb") as file:
        header = _read_header(file)
        readout = readout_from_columns(_read_body(path, file, header))
    if readout.origins is not None or header.viewpoint is None:
        return replace(readout, grid=header.grid, origin_cure=_CURE)
    position = np.array(header.viewpoint[: readout.dim])
    is_placeholder = not any(header.viewpoint[:3]) and _turns_nothing(header.viewpoint)
    said = () if is_placeholder else (Note("sensor position from VIEWPOINT"),)
    return replace(
        readout,
        origins=np.tile(position, (readout.num_scans, 1)),
        world_from_sensor=None if is_placeholder else _pose(header.viewpoint),
        origin_is_placeholder=is_placeholder,
        origin_cure=_CURE,
        notes=(*readout.notes, *said),
        grid=header.grid,
    )


def _turns_nothing(viewpoint: list[float]) -> bool:
    """Whether the quaternion is the identity, or all zeros."""
    return not any(viewpoint[4:])


def _pose(viewpoint: list[float]) -> NDArray[np.float64] | None:
    """(4, 4) world_from_sensor; None where the header gives none, or no rotation."""
    if not any(viewpoint[3:]):
        return None
    position, (w, x, y, z) = viewpoint[:3], viewpoint[3:]
    if w == 1 and not any((x, y, z)):  # usual, and faster for many small scans
        pose = np.eye(4)
        pose[:3, 3] = position
        return pose
    return poses_from_quaternions(np.array([position]), np.array([[x, y, z, w]]))[0]


def _read_header(file: BinaryIO) -> _Header:
    """Everything up to the line DATA."""
    entries: dict[str, list[str]] = {}
    for number, words in enumerate(header_lines(file), start=1):
        if not words or words[0].startswith("#"):
            continue
        name = words[0].upper()
        if name not in _ENTRIES:
            raise ValueError(f"line {number} of the header is not understood: {words[:6]}")
        entries["FIELDS" if name == "COLUMNS" else name] = words[1:]
        if name == "DATA":
            return _Header(
                _fields(entries),
                _count(entries),
                _viewpoint(entries),
                _encoding(words),
                number,
                _grid(entries),
            )
    raise AssertionError("header_lines raises before it ends")


def _fields(entries: dict[str, list[str]]) -> list[Field]:
    """Fields from the lines FIELDS, SIZE, TYPE and COUNT."""
    names = entries.get("FIELDS", [])
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError(
            "FIELDS, SIZE, TYPE and COUNT must have one entry per field; "
            f"got {len(names)}, {len(sizes)}, {len(kinds)} and {len(counts)}"
        )
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        number = header_count(count, f"COUNT of field {name}")
        is_number = kind in _KINDS and size in _SIZES[kind]
        is_channel = name.lower() in CHANNEL_COLUMNS and is_number and number == 1
        if name.lower() not in RAY_COLUMNS and not is_channel:  # padding: any type and size
            width = header_count(size, f"SIZE of field {name}")
            known = "" if name.lower() in CHANNEL_COLUMNS else name.lower()  # is not read
            fields.append(Field(known, f"V{width}", number))
            continue
        if not is_number:
            raise ValueError(f"field {name} has TYPE {kind} and SIZE {size}, which no PCD may have")
        if number != 1:
            raise ValueError(f"COUNT of field {name} must be 1; got {number}")
        fields.append(Field(name.lower(), f"<{_KINDS[kind]}{size}", number))
    return fields


def _count(entries: dict[str, list[str]]) -> int:
    """Number of points; POINTS and WIDTH x HEIGHT must agree where both are there."""
    counts = []
    for names in (["POINTS"], ["WIDTH", "HEIGHT"]):
        if all(len(entries.get(name, [])) == 1 for name in names):
            counts.append(math.prod(header_count(entries[name][0], name) for name in names))
    if not counts or min(counts) != max(counts):
        raise ValueError(
            f"POINTS and WIDTH x HEIGHT must give one number of points; got {counts or 'none'}"
        )
    return counts[0]


def _grid(entries: dict[str, list[str]]) -> tuple[int, int] | None:
    """Rows and columns, where there are several of both; `_count` has checked them."""
    lines = [entries.get(name, []) for name in ("HEIGHT", "WIDTH")]
    if any(len(words) != 1 for words in lines):
        return None
    rows, columns = (int(words[0]) for words in lines)
    return (rows, columns) if rows > 1 and columns > 1 else None


def _viewpoint(entries: dict[str, list[str]]) -> list[float] | None:
    """The seven numbers of VIEWPOINT, or None in files of a version before it."""
    if "VIEWPOINT" not in entries:
        return None
    words = entries["VIEWPOINT"]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != 7 or not all(map(math.isfinite, values)):
        raise ValueError(f"VIEWPOINT must be seven numbers tx ty tz qw qx qy qz; got {words[:8]}")
    return values


def _encoding(words: list[str]) -> str:
    if words[1:] not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise ValueError(f"DATA must be ascii, binary or binary_compressed; got {words[1:3]}")
    return words[1]


def _read_body(path: Path, file: BinaryIO, header: _Header) -> Columns:
    """The named columns; bytes after the last point are ignored, since PCL pads files to whole pages."""
    if header.encoding == "ascii":
        return read_ascii(path, header.num_lines, header.fields, header.count, bytes_left(file))
    if header.encoding == "binary":
        return next(read_binary(file, header.fields, header.count))
    return _read_compressed(file, header)


def _read_compressed(file: BinaryIO, header: _Header) -> Columns:
    """Two sizes (uint32), then all values of the first field, of the second, ..., under LZF."""
    sizes = file.read(8)
    packed, unpacked = int.from_bytes(sizes[:4], "little"), int.from_bytes(sizes[4:], "little")
    promised = header.count * record_size(header.fields)
    if len(sizes) < 8 or packed > bytes_left(file):
        raise ValueError(f"{packed} compressed bytes are declared; got {bytes_left(file)}")
    if unpacked != promised or unpacked > _LZF_RATIO * packed:
        raise ValueError(
            f"{header.count} points need {promised} bytes; "
            f"the file declares {unpacked} from {packed} compressed ones"
        )
    content, columns, offset = decompress_lzf(file.read(packed), unpacked), {}, 0
    for field in header.fields:
        if field.name in COLUMN_NAMES:
            values = np.frombuffer(content, field.format, header.count, offset)
            columns[field.name] = values.astype(column_type(field.name, values.dtype))
        offset += header.count * field.num_bytes
    return columns


def decompress_lzf(packed: bytes, size: int) -> bytearray:
    """Bytes from their LZF form; size is how many there must be.

    A control byte below 32 says how many literal bytes follow, less one. Any other holds the
    length of a copy (top three bits, 7 = one more byte) and how far back it starts.

    Raises:
        ValueError: the stream is broken or gives another number of bytes.
    """
    out, position = bytearray(), 0
    end = len(packed)
    while position < end:
        control = packed[position]
        position += 1
        if control < 32:
            out += packed[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        if length == 7 and position < end:
            length += packed[position]
            position += 1
        if position >= end:
            raise ValueError("the compressed points end in the middle of a copy")
        start = len(out) - ((control & 31) << 8) - packed[position] - 1
        position += 1
        length += 2
        if start < 0 or len(out) + length > size:
            raise ValueError("the compressed points copy from before their start or past their end")
        piece = out[start : start + length]
        if len(piece) < length:  # the copy runs into itself: what there is repeats
            piece = (piece * (length // len(piece) + 1))[:length]
        out += piece
    if position != end or len(out) != size:
        raise ValueError(f"the compressed points must give {size} bytes; got {len(out)}")
    return out
