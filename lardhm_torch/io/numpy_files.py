"""NumPy files: the ``.npz`` layout of scans, and ``.npy`` for bare points."""

from __future__ import annotations

import math
import os
import zipfile
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from lardhm_torch.files import replaced_file
from lardhm_torch.io.readout import Readout, whole_numbers

_DEFLATE_RATIO = 1032  # no deflate stream expands further


def read_npz(path: Path) -> Readout:
    """Scans from ``points``, ``origins``, ``scan_id`` and optional ``is_return``, ``target_index``.

    ``scan_id`` may be left out where there is one origin.

    Raises:
        ValueError: the archive is broken, or an array is missing or has the wrong shape or type.
    """
    with zipfile.ZipFile(path) as archive:
        points = _points_of(archive)
        origins = _optional(archive, "origins")
        scan_id = _optional(archive, "scan_id")
        is_return = _optional(archive, "is_return")
        target_index = _optional(archive, "target_index")
    if origins is not None:
        origins = _coordinates(origins, "origins")
        if scan_id is None and len(origins) != 1:
            raise ValueError(f"scan_id is needed to choose among {len(origins)} origins; got none")
    return Readout(
        points,
        origins,
        None if scan_id is None else _integers(scan_id, "scan_id", 0),
        None if is_return is None else _integers(is_return, "is_return", 0, 1).astype(bool),
        None if target_index is None else _integers(target_index, "target_index", 1),
        origin_cure="Add an array origins (S, D)",
    )


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


def write_npz(path: Path, arrays: dict[str, NDArray]) -> None:
    """Write arrays to path in one step.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    with replaced_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _points_of(archive: zipfile.ZipFile) -> NDArray[np.float64]:
    points = _optional(archive, "points")
    if points is None:
        found = ", ".join(name.removesuffix(".npy") for name in archive.namelist()[:10])
        raise ValueError(f"an array points (N, D) is needed; got {found or 'none'}")
    return _coordinates(points, "points")


def _optional(archive: zipfile.ZipFile, name: str) -> NDArray | None:
    """One array of the archive, or None if it is not there."""
    if f"{name}.npy" not in archive.namelist():
        return None
    entry = archive.getinfo(f"{name}.npy")
    held = min(entry.compress_size, os.path.getsize(str(archive.filename)) - entry.header_offset)
    if entry.compress_size > held or entry.file_size > _DEFLATE_RATIO * held + 1024:
        raise ValueError(f"{name} promises {entry.file_size} bytes; {held} cannot hold them")
    with archive.open(entry) as member:
        content = member.read()
    try:
        return _read_array(BytesIO(content), len(content))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _read_array(file: BinaryIO, size: int) -> NDArray:
    """The array of a .npy stream of size bytes, allocated only if its header fits the size."""
    version = npy_format.read_magic(file)
    if version == (1, 0):
        shape, fortran_order, dtype = npy_format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran_order, dtype = npy_format.read_array_header_2_0(file)
    else:
        raise ValueError(f"format version must be 1.0 or 2.0; got {version}")
    if dtype.kind not in "biuf":
        raise ValueError(f"numbers are needed; got an array of {dtype}")
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
