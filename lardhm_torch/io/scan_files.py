"""Files to Scans and back: one file, several, or a folder; the reader follows from the extension.

| extension | coordinates | sensor position |
|---|---|---|
| ``.npz`` | ``points`` (N, D), world | ``origins`` (S, D), ``scan_id`` (N,) |
| ``.ply`` | properties x y z | properties ox oy oz, poses, or ``origin=`` |
| ``.pcd`` | fields x y z | VIEWPOINT, poses, or ``origin=`` |
| ``.xyz .txt .csv`` | columns x y z | columns ox oy oz, poses, or ``origin=`` |
| ``.las .laz`` | scaled X Y Z | poses, or ``origin=`` |
| ``.bin`` (KITTI) | x y z intensity, sensor frame | poses |
| ``.e57`` | cartesian or spherical, scanner frame | pose of each scan |
| ``.bag .db3 .mcap``, folder of a ROS 2 bag | PointCloud2, its frame | tf, or a topic of poses |
| folder of depth images (7-Scenes, TUM) | 16-bit depth, camera frame | pose files |

Poses are a file poses.txt, groundtruth.txt or trajectory.txt beside the scans or one folder up,
each line in KITTI's or TUM's format (`poses.pose_beside`). Whether the points of a PLY, PCD, text
or LAS file lie in the world or still in the sensor's frame, no file says: the world is assumed,
``frame="sensor"`` says the other. The rest is in the readers' docstrings.

Coordinates are float64 from the file on, so UTM loses nothing. Columns named scan_id, is_return
and target_index (or return_number) are read where a format has named columns. Points that are NaN
are kept: sampling drops and counts them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.io.bag_scans import is_bag_folder, read_bag
from lardhm_torch.io.e57 import read_e57
from lardhm_torch.io.frames import placed
from lardhm_torch.io.kitti import read_kitti
from lardhm_torch.io.las import las_pieces, read_las
from lardhm_torch.io.numpy_files import npz_pieces, read_npy, read_npz, read_npz_points, write_npz
from lardhm_torch.io.paths import POSE_FILES, expand_paths
from lardhm_torch.io.pcd import read_pcd
from lardhm_torch.io.ply import ply_pieces, read_ply
from lardhm_torch.io.poses import find_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.rgbd import Camera, is_rgbd_folder, read_rgbd
from lardhm_torch.io.text import read_text
from lardhm_torch.scans import Scans, concatenate_scans

PathLike = str | os.PathLike[str]
PIECE_RAYS = 1 << 18  # rays of a piece; their samples take about 100 MB

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
    ".e57": read_e57,
    ".bag": read_bag,
    ".db3": read_bag,
    ".mcap": read_bag,
}
_PIECE_READERS: dict[str, Callable[[Path, int], Iterator[Readout]]] = {
    ".npz": npz_pieces,
    ".ply": ply_pieces,
    ".las": las_pieces,
    ".laz": las_pieces,
}
_POINT_READERS = {**_READERS, ".npz": read_npz_points, ".npy": read_npy}
_FOLDER_KINDS = {"a ROS 2 bag": is_bag_folder, "a folder of depth images": is_rgbd_folder}


def load_scans(
    path: PathLike | Sequence[PathLike],
    origin: Sequence[float] | None = None,
    *,
    frame: str | None = None,
    topic: str | Sequence[str] = (),
    camera: Camera | None = None,
) -> Scans:
    """The scans of one file, of several, or of all scan files of a folder, in order.

    Each file is one scan, unless it tells its scans apart itself. A folder is read in natural
    order (scan_10 after scan_9), without its subfolders; the folder of a ROS 2 bag or of depth
    images is read as one.

    Args:
        path: a file, a folder, or several of them.
        origin: (D,) sensor position in the world [m] for files that carry none. It also takes the
            place of a VIEWPOINT or pose at zero, which writers put when they know none.
        frame: what the points of PLY, PCD, text and LAS files are in. "sensor": the pose of each
            file (a pose file's, or VIEWPOINT) moves them into the world; "world": a pose file only
            says where the sensor stood; None: as "world", but pose files are not looked for.
        topic: of a bag's clouds, of its poses, or both; needed if there are several.
        camera: of a folder of depth images.

    Returns:
        All scans, world frame.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: a file cannot be read, has no sensor position, or is of another dimension.
        ImportError: a file needs an optional library.
    """
    if frame not in (None, "sensor", "world"):
        raise ValueError(f'frame must be "sensor", "world" or None; got {frame!r}')
    topics = (topic,) if isinstance(topic, str) else tuple(topic)
    readers: dict[str, Callable[[Path], Readout]] = {
        **_READERS,
        **dict.fromkeys((".bag", ".db3", ".mcap"), partial(read_bag, topics=topics)),
        "a ROS 2 bag": partial(read_bag, topics=topics),
        "a folder of depth images": partial(read_rgbd, camera=camera or Camera()),
    }
    files = expand_paths(path, _READERS, _kind_of_folder)
    readouts = [_read(file, readers, frame) for file in files]
    if origin is not None and not any(readout.needs_origin for readout in readouts):
        raise _origin_error(origin, files)
    dims = {readout.dim: file for file, readout in zip(files, readouts, strict=True)}
    if len(dims) > 1:
        found = ", ".join(f"{dim} in {file}" for dim, file in sorted(dims.items()))
        raise ValueError(f"path must hold scans of one dimension; got {found}")
    return concatenate_scans(
        [_scans_from(readout, file, origin) for file, readout in zip(files, readouts, strict=True)]
    )


def iter_scans(
    path: PathLike | Sequence[PathLike],
    origin: Sequence[float] | None = None,
    *,
    frame: str | None = None,
    topic: str | Sequence[str] = (),
    camera: Camera | None = None,
) -> Iterator[Scans]:
    """Read the scans of `load_scans` one at a time.

    Each file is read when it is needed, so that a folder of any length needs the memory of one file.

    Args:
        path: a file, a folder, or several of them.
        origin: see `load_scans`.
        frame: see `load_scans`.
        topic: see `load_scans`.
        camera: see `load_scans`.

    Yields:
        One scan each, as `Scans` with a single origin.

    Raises:
        FileNotFoundError, ValueError, ImportError: see `load_scans`; raised when the file is read.
    """
    for file in expand_paths(path, _READERS, _kind_of_folder):
        scans = load_scans(file, origin, frame=frame, topic=topic, camera=camera)
        for number in range(scans.num_scans):
            scan = scans.select(scans.scan_id == number)
            origins, of_all = scans.origins[number : number + 1], torch.zeros_like(scan.scan_id)
            yield Scans(origins, scan.ends, of_all, scan.is_return, scan.target_index)


def iter_pieces(
    path: PathLike | Sequence[PathLike],
    origin: Sequence[float] | None = None,
    *,
    frame: str | None = None,
    topic: str | Sequence[str] = (),
    camera: Camera | None = None,
    max_rays: int = PIECE_RAYS,
) -> Iterator[Scans]:
    """All rays of `load_scans` in order, a piece of at most ``max_rays`` at a time.

    LAS, LAZ, binary PLY and ``.npz`` files are read piece by piece and may be larger than memory;
    of other files one at a time is held.

    Args and errors: as `load_scans`; an error comes when the piece's turn comes.
    """
    for file in expand_paths(path, _READERS, _kind_of_folder):
        reader = None if file.is_dir() else _PIECE_READERS.get(file.suffix.lower())
        if reader is None:
            scans = load_scans(file, origin, frame=frame, topic=topic, camera=camera)
            for start in range(0, len(scans), max_rays):
                yield scans.select(torch.arange(start, min(len(scans), start + max_rays)))
            continue
        pieces = reader(file, max_rays)
        while (readout := _next_piece(pieces, file, frame)) is not None:
            if origin is not None and not readout.needs_origin:
                raise _origin_error(origin, [file])
            yield _scans_from(readout, file, origin)


def save_scans(scans: Scans, path: PathLike) -> None:
    """Write scans as ``.npz``, atomically.

    Args:
        scans: range scans, world frame.
        path: file that ends in .npz; an existing file is replaced.

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
    """Read the points of one file: ``.npy``, ``.npz`` with ``points``, or a scan file.

    Args:
        path: the file.

    Returns:
        (N, D) float64 positions [m].

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


def _kind_of_folder(folder: Path) -> str | None:
    """What a folder that is read as one is; None for a folder of scan files."""
    return next((kind for kind, is_kind in _FOLDER_KINDS.items() if is_kind(folder)), None)


def _read(
    file: Path, readers: Mapping[str, Callable[[Path], Readout]], frame: str | None = None
) -> Readout:
    """One file or folder through its reader; whatever is wrong names it."""
    kind = (_kind_of_folder(file) if file.is_dir() else None) or file.suffix.lower()
    with _naming(file):
        readout = readers[kind](file)
        return readout if frame is None else placed(readout, file, frame)


def _next_piece(pieces: Iterator[Readout], file: Path, frame: str | None) -> Readout | None:
    """The next piece of a file, or None after the last; whatever is wrong names the file."""
    with _naming(file):
        readout = next(pieces, None)
        return readout if readout is None or frame is None else placed(readout, file, frame)


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """A block that reads a file: errors name it."""
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # NaN and inf are the sampler's to count
            yield
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
        poses = find_beside(file, POSE_FILES)
        hint = "" if poses is None else f' For {poses.name}: frame="sensor" or frame="world".'
        raise ValueError(
            f"{file} must say where the sensor stood, and it does not. {readout.origin_cure} or "
            f"give it: load_scans(path, origin=(x, y, z)), --origin on the command line.{hint}"
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


def _origin_error(origin: Sequence[float], files: list[Path]) -> ValueError:
    return ValueError(
        "origin must be left out when the files carry their own sensor positions; "
        f"got origin={tuple(origin)} for {_names(files)}"
    )


def _names(files: list[Path]) -> str:
    """One file by name, several by the first and their number."""
    return str(files[0]) if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
