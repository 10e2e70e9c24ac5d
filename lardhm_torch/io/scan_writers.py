"""Scans to files with named columns: binary PLY and PCD, which `ply` and `pcd` read back.

Each ray is a point: its end ``x y z``, its sensor position ``ox oy oz``, ``scan_id``, ``is_return`` and
``target_index``, and its channels: colors, ``intensity``, ``ring`` and ``label`` (-1 where missing).
Colors are bytes if all of them are whole multiples of 1/255, as most sensors give them; otherwise, and
where one is missing, float32. Other channels have no name that programs agree on.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.channels import CLASS, COLOR, INTENSITY
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.numpy_files import write_npz
from lardhm_torch.scans import Scans

Columns = Mapping[str, NDArray]
_AXES = ("x", "y", "z")
_COLORS = ("red", "green", "blue")
_VALUES = (INTENSITY, "ring")
_PLY_TYPES = {"f8": "double", "f4": "float", "i4": "int", "u1": "uchar"}


def ray_columns(arrays: Columns, channels: Columns) -> dict[str, NDArray]:
    """Columns by name of rays and their channels.

    Args:
        arrays: ``points`` (R, D), ``origins`` (S, D), ``scan_id``, ``is_return`` and ``target_index``.
        channels: values by name.

    Raises:
        ValueError: there are more than three coordinates, or a channel that has no column.
    """
    points, origins = arrays["points"], arrays["origins"][arrays["scan_id"]]
    if points.shape[1] not in (2, 3):
        raise ValueError(f"scans must be 2-D or 3-D; got {points.shape[1]} coordinates. Use .npz")
    axes = _AXES[: points.shape[1]]
    columns = dict(zip(axes, points.T.astype("f8"), strict=True))
    columns |= dict(zip(["o" + axis for axis in axes], origins.T.astype("f8"), strict=True))
    columns |= {name: arrays[name].astype("i4") for name in ("scan_id", "target_index")}
    columns["is_return"] = arrays["is_return"].astype("u1")
    for name, values in channels.items():
        if name == COLOR:
            columns |= dict(zip(_COLORS, _color_numbers(values).T, strict=True))
        elif name == CLASS and values.ndim == 1:
            columns["label"] = values.astype("i4")
        elif name in _VALUES and values.ndim == 1:
            columns[name] = values.astype("f4")
        else:
            known = ", ".join((COLOR, *_VALUES, CLASS))
            raise ValueError(
                f"channel {name!r} of shape {values.shape} has no column in this format, only "
                f"{known} with one value or three have. Use .npz"
            )
    return columns


def _color_numbers(values: NDArray) -> NDArray:
    """(R, 3) colors -> bytes if they are such, else float32."""
    numbers = values.astype("f8") * 255
    is_bytes = bool((np.abs(numbers - np.round(numbers)) < 1e-3).all())  # False for NaN
    return np.round(numbers).astype("u1") if is_bytes else values.astype("f4")


def write_ply(path: Path, columns: Columns) -> None:
    """Write rays as the vertices of a binary PLY file, atomically."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {_count(columns)}"]
    lines += [f"property {_PLY_TYPES[_kind(v)]} {name}" for name, v in columns.items()]
    _write(path, [*lines, "end_header"], columns)


def write_pcd(path: Path, columns: Columns) -> None:
    """Write rays as a binary PCD file, atomically; byte colors as the packed field ``rgb``."""
    columns = dict(columns)
    if "red" in columns and _kind(columns["red"]) == "u1":
        red, green, blue = (columns.pop(name).astype("u4") for name in _COLORS)
        columns["rgb"] = (red << 16) | (green << 8) | blue
    kinds = [_kind(values) for values in columns.values()]
    count = _count(columns)
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
    lines += ["FIELDS " + " ".join(columns), "SIZE " + " ".join(k[1] for k in kinds)]
    lines += ["TYPE " + " ".join(k[0].upper() for k in kinds), "COUNT" + " 1" * len(kinds)]
    lines += [f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}"]
    _write(path, [*lines, "DATA binary"], columns)


def _kind(values: NDArray) -> str:
    """Type of a column without its byte order, such as "f4"."""
    return values.dtype.str[1:]


def _count(columns: Columns) -> int:
    return len(columns["x"])


def _write(path: Path, header: list[str], columns: Columns) -> None:
    layout = np.dtype([(name, "<" + _kind(values)) for name, values in columns.items()])
    rows = np.empty(_count(columns), layout)
    for name, values in columns.items():
        rows[name] = values
    with replaced_file(path) as partial, open(partial, "wb") as file:
        file.write("\n".join([*header, ""]).encode())
        rows.tofile(file)


WRITERS: dict[str, Callable[[Path, Columns], None]] = {".ply": write_ply, ".pcd": write_pcd}


def save_scans(scans: Scans, path: str | os.PathLike[str]) -> None:
    """Write scans with their channels as ``.npz``, or as the points of ``.ply`` or ``.pcd``, atomically.

    `load_scans` reads all three formats. Scans without rays and time stamps are lost in .ply and
    .pcd, which have no place for them.

    Args:
        scans: range scans, world frame.
        path: file that ends in .npz, .ply or .pcd; an existing file is replaced.

    Raises:
        ValueError: path has another extension, or .ply and .pcd have no column for a channel
            (`scan_writers`).
        FileNotFoundError: the folder of path does not exist.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix != ".npz" and suffix not in WRITERS:
        known = ", ".join((".npz", *WRITERS))
        raise ValueError(f"path must end in one of {known}, to save scans; got {target}")
    columns = {
        "points": scans.ends,
        "scan_id": scans.scan_id,
        "origins": scans.origins,
        "is_return": scans.is_return,
        "target_index": scans.target_index,
    }
    arrays = {name: value.detach().cpu().numpy() for name, value in columns.items()}
    channels = {name: value.cpu().numpy() for name, value in scans.channels.items()}
    if suffix == ".npz":
        if scans.times is not None:
            arrays["scan_times"] = scans.times.cpu().numpy()
        write_npz(target, arrays, channels)
    else:
        WRITERS[suffix](target, ray_columns(arrays, channels))
