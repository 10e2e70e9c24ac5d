"""NumPy files: the ``.npz`` layout of scans, and ``.npy`` for bare points."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from lardhm_torch.channels import CLASS, COLOR, INTENSITY
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.readout import Readout, whole_numbers

_DEFLATE_RATIO = 1032  # no deflate stream expands further
_RAY_ARRAYS = ("points", "scan_id", "is_return", "target_index")  # one entry a ray
_CHANNELS = (CLASS, COLOR, INTENSITY)  # arrays of their own names; others begin with the prefix
_PREFIX = "channel_"


def read_npz(path: Path) -> Readout:
    """Scans from ``points``, ``origins``, ``scan_id`` and optional ``is_return``, ``target_index``.

    ``scan_times`` (S,) holds a time stamp [s] for each origin.
    ``scan_id`` may be left out where there is one origin. Arrays ``color``, ``intensity``, ``class``
    and ``channel_NAME`` of one row per point are channels (see `lardhm_torch.channels`).

    Raises:
        ValueError: the archive is broken, or an array is missing or has the wrong shape or type.
    """
    with zipfile.ZipFile(path) as archive:
        columns = {"points": _points_of(archive)}
        for name in (*_RAY_ARRAYS[1:], *_channel_arrays(archive)):
            values = _optional(archive, name)
            if values is not None:
                columns[name] = values
        scans = _scans_of(archive, "scan_id" in columns)
    return _npz_piece(columns, *scans)


def npz_pieces(path: Path, max_points: int) -> Iterator[Readout]:
    """The same at most ``max_points`` rays at a time; errors as there."""
    with zipfile.ZipFile(path) as archive, ExitStack() as stack:
        present = set(archive.namelist())
        names = [name for name in _RAY_ARRAYS if f"{name}.npy" in present]
        names += _channel_arrays(archive)
        columns = {name: stack.enter_context(_Column(archive, name)) for name in names}
        if "points" not in columns or any(not column.in_rows for column in columns.values()):
            yield read_npz(path)  # reports missing arrays, or transposes
            return
        scans = _scans_of(archive, "scan_id" in columns)
        lengths = {name: column.length for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"arrays must have one entry a point; got {lengths}")
        for _ in range(0, max(1, lengths["points"]), max_points):
            yield _npz_piece({name: c.read(max_points) for name, c in columns.items()}, *scans)


def _npz_piece(
    columns: dict[str, NDArray], origins: NDArray | None, scan_times: NDArray | None
) -> Readout:
    """Rows of the arrays as rays."""
    scan_id, is_return = columns.get("scan_id"), columns.get("is_return")
    target_index = columns.get("target_index")
    return Readout(
        _coordinates(columns["points"], "points"),
        origins,
        None if scan_id is None else _integers(scan_id, "scan_id", 0),
        None if is_return is None else _integers(is_return, "is_return", 0, 1).astype(bool),
        None if target_index is None else _integers(target_index, "target_index", 1),
        origin_cure="Add an array origins (S, D)",
        channels=_channels_of(columns),
        scan_times=scan_times,
    )


def _channel_arrays(archive: zipfile.ZipFile) -> list[str]:
    """Names of the arrays that are channels."""
    names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    return [name for name in names if name in _CHANNELS or name.startswith(_PREFIX)]


def _channels_of(columns: dict[str, NDArray]) -> dict[str, NDArray]:
    """The channels among arrays, with bytes of colors divided by 255."""
    count, found = len(columns["points"]), dict[str, NDArray]()
    for name, values in columns.items():
        if name not in _CHANNELS and not name.startswith(_PREFIX):
            continue
        if values.ndim not in (1, 2) or len(values) != count:
            raise ValueError(f"{name} must have {count} rows, one per point; got {values.shape}")
        if name == CLASS and values.dtype.kind in "iub":
            found[name] = np.array(values, dtype=np.int64)
            continue
        scale = np.float32(255 if name == COLOR and values.dtype == np.uint8 else 1)
        found[name.removeprefix(_PREFIX)] = np.array(values, dtype=np.float32) / scale
    return found


class _Column:
    """One array of an archive, read some rows at a time."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        entry = _checked_entry(archive, name)
        self.member = archive.open(entry)
        try:
            self.shape, fortran_order, self.dtype = _read_header(self.member)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        left = entry.file_size - self.member.tell()
        promised = math.prod(self.shape) * self.dtype.itemsize
        if min(self.shape, default=0) < 0 or promised != left:
            raise ValueError(
                f"{name}: shape {self.shape} of {self.dtype} needs {promised} bytes; got {left}"
            )
        self.length = self.shape[0] if self.shape else 0
        self.in_rows = len(self.shape) > 0 and not (fortran_order and len(self.shape) > 1)

    def read(self, rows: int) -> NDArray:
        """The next rows, at most so many."""
        row_bytes = math.prod(self.shape[1:]) * self.dtype.itemsize
        content = self.member.read(rows * row_bytes)
        return np.frombuffer(content, self.dtype).reshape(-1, *self.shape[1:])

    def __enter__(self) -> _Column:
        return self

    def __exit__(self, *_: object) -> None:
        self.member.close()


def read_npz_points(path: Path) -> Readout:
    """Only the array ``points`` (N, D)."""
    with zipfile.ZipFile(path) as archive:
        return Readout(_points_of(archive))


def read_npy(path: Path) -> Readout:
    """Points of a ``.npy`` file that holds one (N, D) array.

    Raises:
        ValueError: the file is broken or holds something else.
    """
    with open(path, "rb") as file:
        array = _read_array(file, path.stat().st_size)
    return Readout(_coordinates(array, "the array"))


def write_npz(
    path: Path, arrays: Mapping[str, NDArray], channels: Mapping[str, NDArray] | None = None
) -> None:
    """Write arrays, and channels by the names that the readers look for, to path in one step.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    named = {array_name(name): values for name, values in (channels or {}).items()}
    with replaced_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, **arrays, **named)


def array_name(channel: str) -> str:
    """Name of the array of a channel."""
    return channel if channel in _CHANNELS else _PREFIX + channel


def _points_of(archive: zipfile.ZipFile) -> NDArray[np.float64]:
    points = _optional(archive, "points")
    if points is None:
        found = ", ".join(name.removesuffix(".npy") for name in archive.namelist()[:10])
        raise ValueError(f"an array points (N, D) is needed; got {found or 'none'}")
    return _coordinates(points, "points")


def _scans_of(
    archive: zipfile.ZipFile, has_scan_id: bool
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """(S, D) sensor positions and (S,) time stamps; None where there are none."""
    origins, times = _optional(archive, "origins"), _optional(archive, "scan_times")
    if origins is None:
        return None, None
    if not has_scan_id and len(origins) != 1:
        raise ValueError(f"scan_id is needed to choose among {len(origins)} origins; got none")
    origins = _coordinates(origins, "origins")
    if not np.isfinite(origins).all():
        raise ValueError(f"origins must be finite; got {origins.tolist()[:3]}")
    if times is not None and times.shape != (len(origins),):
        raise ValueError(f"scan_times must be ({len(origins)},), one per origin; got {times.shape}")
    return origins, None if times is None else times.astype(np.float64)


def _checked_entry(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo:
    """The entry of an array, whose size the file can hold."""
    entry = archive.getinfo(f"{name}.npy")
    held = min(entry.compress_size, os.path.getsize(str(archive.filename)) - entry.header_offset)
    if entry.compress_size > held or entry.file_size > _DEFLATE_RATIO * held + 1024:
        raise ValueError(f"{name} declares {entry.file_size} bytes; {held} cannot hold them")
    return entry


def _optional(archive: zipfile.ZipFile, name: str) -> NDArray | None:
    """One array of the archive, or None if it is not there."""
    if f"{name}.npy" not in archive.namelist():
        return None
    with archive.open(_checked_entry(archive, name)) as member:
        content = member.read()
    try:
        return _read_array(BytesIO(content), len(content))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _read_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns follow each other, and type of a .npy stream."""
    version = npy_format.read_magic(file)
    if version == (1, 0):
        shape, fortran_order, dtype = npy_format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran_order, dtype = npy_format.read_array_header_2_0(file)
    else:
        raise ValueError(f"format version must be 1.0 or 2.0; got {version}")
    if dtype.kind not in "biuf":
        raise ValueError(f"numbers are needed; got an array of {dtype}")
    return shape, fortran_order, dtype


def _read_array(file: BinaryIO, size: int) -> NDArray:
    """The array of a .npy stream of size bytes, allocated only if its header fits the size."""
    shape, fortran_order, dtype = _read_header(file)
    promised, left = math.prod(shape) * dtype.itemsize, size - file.tell()
    if min(shape, default=0) < 0 or promised != left:
        raise ValueError(f"shape {shape} of {dtype} needs {promised} bytes; got {left}")
    values = np.frombuffer(file.read(promised), dtype=dtype)
    return values.reshape(shape, order="F" if fortran_order else "C")


def _coordinates(values: NDArray, name: str) -> NDArray[np.float64]:
    """Values as (N, D) float64."""
    if values.ndim != 2 or values.shape[1] == 0 or values.dtype.kind == "b":
        raise ValueError(f"{name} must be (N, D) numbers; got {values.shape} of {values.dtype}")
    return np.array(values, dtype=np.float64, order="C")


def _integers(values: NDArray, name: str, lowest: int, highest: int = 2**31) -> NDArray[np.int64]:
    """Values as (N,) int64 from lowest to highest."""
    if values.ndim != 1:
        raise ValueError(f"{name} must be (N,), one entry per point; got {values.shape}")
    return whole_numbers(values, name, lowest, highest)
