"""Read and write scan files: one file, several, or a folder. The extension selects the reader.

| extension | coordinates | sensor position |
|---|---|---|
| ``.npz`` | ``points`` (N, D), world | ``origins`` (S, D), ``scan_id`` (N,) |
| ``.ply`` | properties x y z | properties ox oy oz, poses, or ``origin=`` |
| ``.pcd`` | fields x y z | VIEWPOINT, poses, or ``origin=`` |
| ``.xyz .txt .csv`` | columns x y z | columns ox oy oz, poses, or ``origin=`` |
| ``.pts``, text with a count line | columns x y z | poses, or ``origin=`` |
| ``.ptx`` | scanner frame | scanner position of each scan |
| ``.las .laz`` | scaled X Y Z | poses, a trajectory by GPS time, or ``origin=`` |
| ``.bin`` (KITTI) | x y z intensity, sensor frame | poses |
| ``.e57`` | cartesian or spherical, scanner frame | pose of each scan |
| ``.bag .db3 .mcap``, folder of a ROS 2 bag | clouds and laser scans | tf, or a topic of poses |
| folder of depth images (7-Scenes, TUM) | 16-bit depth, camera frame | pose files |

Poses are read from a file poses.txt, groundtruth.txt or trajectory.txt in the folder of the scans or
one folder up, with lines in the format of KITTI, KITTI-360 or TUM (`poses.pose_beside`). PLY, PCD,
text and LAS files do not state whether their points are in the world frame or in the sensor frame.
The world frame is assumed; ``frame="sensor"`` selects the other. The readers' docstrings give details.

Coordinates are read as float64, so UTM coordinates are exact. Columns named scan_id, is_return
and target_index (or return_number) are read if a format has named columns. Points that are NaN
are kept: sampling drops and counts them. Points at exactly zero mark beams without return; they are
left out and counted. A `notes.ScanReport` lists all assumptions; docs/formats.md has a table.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch.io.bag_files import is_bag_folder
from lardhm_torch.io.bag_scans import read_bag
from lardhm_torch.io.e57 import read_e57
from lardhm_torch.io.frames import placed
from lardhm_torch.io.kitti import read_kitti
from lardhm_torch.io.las import las_pieces, read_las
from lardhm_torch.io.moving_sensor import seen_from_track
from lardhm_torch.io.notes import ScanReport, check_notes, no_ray_left
from lardhm_torch.io.numpy_files import npz_pieces, read_npy, read_npz, read_npz_points
from lardhm_torch.io.origins import note_not_finite, scans_from, unused_origin, with_origins
from lardhm_torch.io.paths import expand_paths, naming_errors
from lardhm_torch.io.pcd import read_pcd
from lardhm_torch.io.ply import ply_pieces, read_ply
from lardhm_torch.io.ptx import read_ptx
from lardhm_torch.io.readout import Readout, without_zeros
from lardhm_torch.io.rgbd import Camera, is_rgbd_folder, read_rgbd
from lardhm_torch.io.scan_writers import save_scans as save_scans
from lardhm_torch.io.text import read_text
from lardhm_torch.scans import Scans, concatenate_scans

PathLike = str | os.PathLike[str]
PIECE_RAYS = 1 << 18  # rays of a piece; their samples take about 100 MB
PACKET_RAYS = 1 << 15  # rays of a moving sensor that are given together as one scan

_READERS: dict[str, Callable[[Path], Readout]] = {
    ".npz": read_npz,
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".xyz": read_text,
    ".txt": read_text,
    ".csv": read_text,
    ".pts": read_text,
    ".ptx": read_ptx,
    ".bin": read_kitti,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".bag": read_bag,
    ".db3": read_bag,
    ".mcap": read_bag,
}
_MAY_HOLD_ZEROS = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".pts", ".las", ".laz")
_PIECE_READERS: dict[str, Callable[[Path, int], Iterator[Readout]]] = {
    ".npz": npz_pieces,
    ".ply": ply_pieces,
    ".las": las_pieces,
    ".laz": las_pieces,
}
_POINT_READERS = {**_READERS, ".npz": read_npz_points, ".npy": read_npy}
SCAN_SUFFIXES = frozenset(_READERS)
_BAGS = (".bag", ".db3", ".mcap", "a ROS 2 bag")
_FOLDER_KINDS = {"a ROS 2 bag": is_bag_folder, "a folder of depth images": is_rgbd_folder}


@dataclass(frozen=True)
class Reading:
    """Options for reading files; see `load_scans`."""

    origin: Sequence[float] | None = None
    frame: str | None = None
    poses_frame: str | None = None
    sensor_frame: str | None = None
    topic: str | Sequence[str] = ()
    camera: Camera | None = None
    strict: bool = False
    report: ScanReport | None = None

    def __post_init__(self) -> None:
        if self.frame not in (None, "sensor", "world"):
            raise ValueError(f'frame must be "sensor", "world" or None; got {self.frame!r}')

    @cached_property
    def readers(self) -> dict[str, Callable[[Path], Readout]]:
        """The reader of each extension and kind of folder, with its options."""
        of_bags = partial(
            read_bag,
            topics=(self.topic,) if isinstance(self.topic, str) else tuple(self.topic),
            poses_frame=self.poses_frame,
            sensor_frame=self.sensor_frame,
        )
        return {
            **_READERS,
            **dict.fromkeys(_BAGS, of_bags),
            ".bin": partial(read_kitti, poses_frame=self.poses_frame),
            "a folder of depth images": partial(read_rgbd, camera=self.camera or Camera()),
        }


def load_scans(
    path: PathLike | Sequence[PathLike],
    origin: Sequence[float] | None = None,
    *,
    frame: str | None = None,
    poses_frame: str | None = None,
    sensor_frame: str | None = None,
    topic: str | Sequence[str] = (),
    camera: Camera | None = None,
    strict: bool = False,
    report: ScanReport | None = None,
) -> Scans:
    """Read the scans of one file, of several files, or of all scan files of a folder, in order.

    Each file is one scan, unless its format distinguishes several scans. A folder is read in natural
    order (scan_10 after scan_9), without its subfolders; the folder of a ROS 2 bag or of depth
    images is read as one unit.

    Args:
        path: a file, a folder, or several of them.
        origin: (D,) sensor position [m] for scans that do not contain one. It also replaces a
            VIEWPOINT or pose at zero, which programs write if they do not know the pose.
        frame: frame of the points of PLY, PCD, text and LAS files. "sensor": points are transformed by
            the pose of each file (from a pose file, or VIEWPOINT); "world": a pose file only gives the
            sensor positions; None: as "world", but pose files are ignored.
        poses_frame: whose poses a pose file contains, "camera" or "lidar"; for a bag, the tf frame of
            the pose topic, if its messages do not name it.
        sensor_frame: for a bag, the frame of the sensor if clouds are in another frame.
        topic: topic of a bag's clouds or poses, or both; required if there are several.
        camera: settings for a folder of depth images.
        strict: raise an error instead of guessing.
        report: receives the contents of the files and the assumptions.

    Returns:
        All scans, world frame.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: a file cannot be read, has no sensor position, or is of another dimension.
        ImportError: a file needs an optional library.

    Warns:
        ScanFileWarning: part of a file was left out.
    """
    reading = Reading(origin, frame, poses_frame, sensor_frame, topic, camera, strict, report)
    files = expand_paths(path, _READERS, _kind_of_folder)
    readouts = [_read(file, reading) for file in files]
    if origin is not None and not any(readout.needs_origin for readout in readouts):
        raise unused_origin(origin, files)
    dims = {readout.dim: file for file, readout in zip(files, readouts, strict=True)}
    if len(dims) > 1:
        found = ", ".join(f"{dim} in {file}" for dim, file in sorted(dims.items()))
        raise ValueError(f"path must hold scans of one dimension; got {found}")
    placeholders = sum(map(_num_placeholders, readouts))
    scans = concatenate_scans(
        [
            _finished(readout, file, reading, placeholders)
            for file, readout in zip(files, readouts, strict=True)
        ]
    )
    if not len(scans):
        raise no_ray_left(files, [note for readout in readouts for note in readout.notes])
    return scans


def iter_scans(
    path: PathLike | Sequence[PathLike],
    origin: Sequence[float] | None = None,
    *,
    frame: str | None = None,
    poses_frame: str | None = None,
    sensor_frame: str | None = None,
    topic: str | Sequence[str] = (),
    camera: Camera | None = None,
    strict: bool = False,
    report: ScanReport | None = None,
) -> Iterator[Scans]:
    """Read the scans of `load_scans` one at a time.

    Each file is read when it is needed, so a folder of any length needs the memory of one file.
    The rays of a moving sensor (LAS with a trajectory by GPS time) each have their own origin; they
    are returned in packets of 32,768 in the order of time.

    Args:
        path: a file, a folder, or several of them.
        origin: see `load_scans`.
        frame: see `load_scans`.
        poses_frame: see `load_scans`.
        sensor_frame: see `load_scans`.
        topic: see `load_scans`.
        camera: see `load_scans`.
        strict: see `load_scans`.
        report: see `load_scans`.

    Yields:
        One scan each, as `Scans` with a single origin, or one packet of a moving sensor.

    Raises:
        FileNotFoundError, ValueError, ImportError: see `load_scans`; raised when the file is read.
            If no file needs the given origin, the error is raised at the end (with one file, at once).
    """
    reading = Reading(origin, frame, poses_frame, sensor_frame, topic, camera, strict, report)
    for scans, moves in _scans_of_each_file(path, reading, max_rays=None):
        order = scans.scan_id.argsort(stable=True)
        counts = scans.scan_id.bincount(minlength=scans.num_scans).tolist()
        for number, rays in enumerate(order.split(PACKET_RAYS if moves else counts)):
            scan = scans.select(rays)
            if moves:
                used, scan_id = scan.scan_id.unique(return_inverse=True)
            else:
                used, scan_id = torch.tensor([number]), torch.zeros_like(scan.scan_id)
            yield scan.with_origins(used, scan_id)


def iter_pieces(
    path: PathLike | Sequence[PathLike],
    reading: Reading | None = None,
    *,
    max_rays: int = PIECE_RAYS,
) -> Iterator[Scans]:
    """All rays of `load_scans` in order, a piece of at most ``max_rays`` at a time.

    LAS, LAZ, binary PLY and ``.npz`` files are read piece by piece and may be larger than memory;
    of other files one at a time is in memory.

    Errors: as `iter_scans`; an error is raised when the piece is read.
    """
    for scans, _ in _scans_of_each_file(path, reading or Reading(), max_rays):
        for start in range(0, len(scans), max_rays):
            yield scans.select(torch.arange(start, min(len(scans), start + max_rays)))


def _scans_of_each_file(
    path: PathLike | Sequence[PathLike],
    reading: Reading,
    max_rays: int | None,
) -> Iterator[tuple[Scans, bool]]:
    """The scans of one file after the other, and whether each of their rays has its own origin.

    Some formats come in pieces of max_rays.
    """
    files = expand_paths(path, _READERS, _kind_of_folder)
    origin_is_used, placeholders = reading.origin is None, 0
    for number, file in enumerate(files):
        before = placeholders
        for readout in _pieces(file, reading, max_rays):
            if readout.needs_origin:
                origin_is_used = True
            elif len(files) == 1 and not origin_is_used:
                raise unused_origin(reading.origin or (), files)
            placeholders = before + _num_placeholders(readout)
            if placeholders == 1 and number + 1 < len(files) and reading.origin is None:
                # The first scan of a drive may stand at zero; if the next does, too, none does.
                placeholders += _num_placeholders(_read(files[number + 1], reading))
            scans = _finished(readout, file, reading, placeholders)
            yield scans, readout.times is not None and scans.num_scans > 1
    if not origin_is_used:
        raise unused_origin(reading.origin or (), files)


def _pieces(file: Path, reading: Reading, max_rays: int | None) -> Iterator[Readout]:
    """The readout of a file, in pieces if max_rays is given and the format has a reader for it."""
    reader = None if file.is_dir() else _PIECE_READERS.get(file.suffix.lower())
    if reader is None or max_rays is None:
        yield _read(file, reading)
        return
    pieces = reader(file, max_rays)
    while True:
        with naming_errors(file):
            readout = next(pieces, None)
            if readout is None:
                return
            readout = _placed(readout, file, reading)
        yield readout


def load_points(path: PathLike) -> Tensor:
    """Read the points of one file: ``.npy``, ``.npz`` with ``points``, or a scan file.

    Args:
        path: the file.

    Returns:
        (N, D) float64 positions [m]; for a scan file, those of the hits.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be read, or does not contain an (N, D) array of numbers.
        ImportError: the file needs an optional library.
    """
    file = Path(path)
    if file.is_dir():
        raise ValueError(f"path must be one file of points; {file} is a folder")
    (file,) = expand_paths(file, _POINT_READERS)
    with naming_errors(file):
        readout = _POINT_READERS[file.suffix.lower()](file)
    hits = readout if readout.is_return is None else readout.select(readout.is_return)
    return torch.from_numpy(hits.ends)


def _kind_of_folder(folder: Path) -> str | None:
    """The kind of a folder that is read as a whole; None for a folder of scan files."""
    return next((kind for kind, is_kind in _FOLDER_KINDS.items() if is_kind(folder)), None)


def _read(file: Path, reading: Reading) -> Readout:
    """Read one file or folder; errors name it."""
    kind = (_kind_of_folder(file) if file.is_dir() else None) or file.suffix.lower()
    with naming_errors(file):
        return _placed(reading.readers[kind](file), file, reading)


def _placed(readout: Readout, file: Path, reading: Reading) -> Readout:
    """Points in the world frame, as far as it is known which frame they are in."""
    if file.suffix.lower() in _MAY_HOLD_ZEROS:
        readout = without_zeros(readout)
    if reading.origin is None and reading.frame != "sensor":
        tracked = seen_from_track(readout, file)
        if tracked is not None:
            return tracked
    return placed(readout, file, reading.frame, reading.poses_frame)


def _finished(
    readout: Readout,
    file: Path,
    reading: Reading,
    num_placeholders: int,
) -> Scans:
    """The readout as Scans, once its sensor positions are known and its notes accepted."""
    readout = with_origins(readout, file, reading.origin, num_placeholders)
    readout = note_not_finite(readout)
    scans = scans_from(readout, file)
    check_notes(file, readout.notes, reading.strict)
    if reading.report is not None:
        reading.report.add(file, scans, readout.notes)
    return scans


def _num_placeholders(readout: Readout) -> int:
    """How many scans have a sensor position that is only a placeholder."""
    return readout.num_scans if readout.origin_is_placeholder else 0
