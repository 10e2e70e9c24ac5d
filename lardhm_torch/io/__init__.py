"""Files to Scans and back: one file, several, or a folder; the reader follows from the extension.

| extension | coordinates | sensor position |
|---|---|---|
| ``.npz`` | ``points`` (N, D), world | ``origins`` (S, D), ``scan_id`` (N,) |
| ``.ply`` | properties x y z, world | properties ox oy oz, or ``origin=`` |
| ``.pcd`` | fields x y z, world | VIEWPOINT |
| ``.xyz .txt .csv`` | columns x y z, world | columns ox oy oz, or ``origin=`` |
| ``.bin`` (KITTI) | x y z intensity, sensor frame | ``poses.txt`` beside it or one folder up |
| ``.las .laz`` | scaled X Y Z, world | ``origin=`` |

Coordinates are float64 from the file on, so UTM loses nothing. Columns named scan_id, is_return
and target_index (or return_number) are read where a format has named columns. Points that are NaN
are kept: sampling drops and counts them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.io.kitti import read_kitti
from lardhm_torch.io.las import read_las
from lardhm_torch.io.numpy_files import read_npy, read_npz, read_npz_points, write_npz
from lardhm_torch.io.paths import expand_paths
from lardhm_torch.io.pcd import read_pcd
from lardhm_torch.io.ply import read_ply
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.text import read_text
from lardhm_torch.scans import Scans, concatenate_scans

PathLike = str | os.PathLike[str]

_READERS: dict[str, Callable[[Path], Readout]] = {
    ".npz": read_npz,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".xyz": read_text,
    ".txt": read_text,
    ".csv": read_text,
    ".bin": read_kitti,
    ".las": read_las,
    ".laz": read_las,
}
_POINT_READERS = {**_READERS, ".npz": read_npz_points, ".npy": read_npy}


def load_scans(path: PathLike | Sequence[PathLike], origin: Sequence[float] | None = None) -> Scans:
    """The scans of one file, of several, or of all scan files of a folder, in order.

    Each file is one scan, unless it tells its scans apart itself. A folder is read in natural
    order (scan_10 after scan_9), without its subfolders.

    Args:
        path: a file, a folder, or several of them.
        origin: (D,) sensor position in the world [m] for files that carry none. It also takes the
            place of a VIEWPOINT at zero, which PCD writers put when they know no pose.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: a file cannot be read, has no sensor position, or is of another dimension.
        ImportError: a file needs an optional library.
    """
    files = expand_paths(path, _READERS)
    readouts = [_read(file, _READERS) for file in files]
    if origin is not None and not any(readout.needs_origin for readout in readouts):
        raise ValueError(
            "origin must be left out when the files carry their own sensor positions; "
            f"got origin={tuple(origin)} for {_names(files)}"
        )
    dims = {readout.dim: file for file, readout in zip(files, readouts, strict=True)}
    if len(dims) > 1:
        found = ", ".join(f"{dim} in {file}" for dim, file in sorted(dims.items()))
        raise ValueError(f"path must hold scans of one dimension; got {found}")
    return concatenate_scans(
        [_scans_from(readout, file, origin) for file, readout in zip(files, readouts, strict=True)]
    )


def save_scans(scans: Scans, path: PathLike) -> None:
    """Write scans as ``.npz``; the file at path is the old one or the new one, never half of it.

    Raises:
        ValueError: path does not end in .npz.
        FileNotFoundError: the folder of path does not exist.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        raise ValueError(f"path must end in .npz, the format scans are saved in; got {target}")
    columns = {
        "points": scans.ends,
        "scan_id": scans.scan_id,
        "origins": scans.origins,
        "is_return": scans.is_return,
        "target_index": scans.target_index,
    }
    write_npz(target, {name: value.detach().cpu().numpy() for name, value in columns.items()})


def load_points(path: PathLike) -> Tensor:
    """(N, D) float64 points of one file [m]: ``.npy``, ``.npz`` with ``points``, or a scan file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be read, or holds no (N, D) array of numbers.
        ImportError: the file needs an optional library.
    """
    file = Path(path)
    if file.is_dir():
        raise ValueError(f"path must be one file of points; {file} is a folder")
    (file,) = expand_paths(file, _POINT_READERS)
    return torch.from_numpy(_read(file, _POINT_READERS).ends)


def _read(file: Path, readers: dict[str, Callable[[Path], Readout]]) -> Readout:
    """One file through the reader of its extension; whatever is wrong names the file."""
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # NaN and inf are the sampler's to count
            return readers[file.suffix.lower()](file)
    except ImportError:
        raise
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError(f"{file} cannot be read: {error}") from error
    except Exception as error:
        # Broken bytes surface from zipfile, zlib, NumPy and laspy under a dozen unrelated types.
        reason = str(error) or type(error).__name__
        raise ValueError(f"{file} cannot be read: {reason}") from error


def _scans_from(readout: Readout, file: Path, origin: Sequence[float] | None) -> Scans:
    """The readout as Scans, with origin put in where the file knows no sensor position."""
    origins = readout.origins
    if origin is not None and readout.needs_origin:
        if len(origin) != readout.dim:
            raise ValueError(
                f"origin must be ({readout.dim},), as the points of {file}; got {tuple(origin)}"
            )
        origins = torch.tensor([tuple(origin)] * readout.num_scans, dtype=torch.float64).numpy()
    if origins is None:
        raise ValueError(
            f"{file} must say where the sensor stood, and it does not. {readout.origin_cure} or "
            "give it: load_scans(path, origin=(x, y, z)), --origin on the command line."
        )
    columns = {
        "origins": origins,
        "ends": readout.ends,
        "scan_id": readout.scan_id,
        "is_return": readout.is_return,
        "target_index": readout.target_index,
    }
    try:
        scans = Scans(**{k: torch.from_numpy(v) for k, v in columns.items() if v is not None})
    except ValueError as error:
        raise ValueError(f"{file} does not hold scans: {error}") from error
    if not torch.isfinite(scans.origins).all():
        raise ValueError(f"{file}: origins must be finite; got {scans.origins.tolist()[:3]}")
    return scans


def _names(files: list[Path]) -> str:
    """One file by name, several by the first and their number."""
    return str(files[0]) if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
