"""E57 through pye57 (extra "io"): scans with their poses, cartesian or spherical."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import joined_columns
from lardhm_torch.io.e57_channels import CHANNEL_FIELDS, channels_of, white_of
from lardhm_torch.io.no_returns import NO_RETURNS
from lardhm_torch.io.notes import Note
from lardhm_torch.io.origins import with_identities
from lardhm_torch.io.readout import Readout, rows_at_zero, whole_numbers
from lardhm_torch.io.trajectories import move_points, poses_from_quaternions

_PAGE = 1024  # bytes, the last four of which are a checksum
_LEAST_BYTES = 2  # of a record: three coordinates take more, and all-equal ones are no scan
_RECORDS_AT_A_TIME = 1 << 16
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_ZEROS = "points at exactly zero are left out (no measurement)"


def read_e57(path: Path) -> Readout:
    """One scan for each entry of data3D that has points, moved by its pose, which is its origin.

    Points that the scanner marked invalid are left out, as are those at exactly zero. Where it
    marked the range alone as invalid, the beam had no return: it is free up to the longest range
    of its scan. A field returnIndex gives target_index. Colors and intensity are channels, missing
    where they are marked as invalid. Identity poses are what writers put when
    they know none (`with_identities`); a scan without a pose among scans with one has no known
    origin.

    Raises:
        ImportError: pye57 is not installed.
        ValueError: the file is damaged or cut short, or has no points.

    Source: ASTM E2807-11; http://www.libe57.org/.
    """
    _check_before_opening(path)
    try:
        import pye57
    except ImportError as error:
        raise ImportError(
            f"{path} needs pye57. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    scans, poses = [], []
    with pye57.E57(str(path)) as file:
        for number in range(file.scan_count):
            header = file.get_header(number)
            scan = _scan_of(_read_columns(file, header, path.stat().st_size))
            if len(scan.ends):
                poses.append(_pose_of(header))
                pose = poses[-1]
                scans.append(
                    scan if pose is None else replace(scan, ends=move_points(pose, scan.ends))
                )
    if not scans:
        raise ValueError("at least one point is needed; got none")
    counts: dict[str, int] = {}
    for note in (note for scan in scans for note in scan.notes):
        counts[note.text] = counts.get(note.text, 0) + (note.count or 0)
    notes = [Note(text, count, is_loss=text == _ZEROS) for text, count in counts.items()]
    return _with_poses(
        Readout(
            np.concatenate([scan.ends for scan in scans]),
            is_return=np.concatenate([scan.is_return for scan in scans]),
            target_index=np.concatenate([scan.target_index for scan in scans]),
            scan_id=np.repeat(np.arange(len(scans)), [len(scan.ends) for scan in scans]),
            origin_cure="Export the scans with their poses",
            notes=tuple(notes),
            channels=joined_columns([(scan.channels, len(scan.ends)) for scan in scans]),
        ),
        poses,
    )


def _with_poses(readout: Readout, poses: list[NDArray[np.float64] | None]) -> Readout:
    """The readout with the position of each scan: NaN where there is no pose."""
    unknown = np.full((4, 4), np.nan)
    matrices = np.stack([unknown if pose is None else pose for pose in poses])
    is_identity = (matrices == np.eye(4)).all(axis=(1, 2))
    is_real = np.isfinite(matrices).all(axis=(1, 2)) & ~is_identity
    if not is_real.any() and not is_identity.all():
        return readout
    readout = with_identities(replace(readout, origins=matrices[:, :3, 3]), is_identity)
    if is_identity.all():
        return readout
    return readout.noting(Note("scanner positions from the poses"))


def _check_before_opening(path: Path) -> None:
    """Check the header against the file size, and refuse XML whose entities may expand without limit."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        header = file.read(48).ljust(48, b"\0")
        signature, _, length, xml_at, xml_size, page = struct.unpack("<8s8s4Q", header)
        if signature != b"ASTM-E57" or page != _PAGE:
            raise ValueError(f"an E57 file begins with ASTM-E57; got {header[:8]!r}")
        pages = xml_size // (_PAGE - 4) + 2
        if length != size or size % _PAGE or not 48 <= xml_at <= xml_at + xml_size <= size:
            raise ValueError(
                f"{length} bytes in pages of {_PAGE} are declared, XML of {xml_size} bytes at "
                f"{xml_at}; got {size} bytes"
            )
        file.seek(xml_at - xml_at % _PAGE)
        content = file.read(pages * _PAGE)
    logical = b"".join(content[i : i + _PAGE - 4] for i in range(0, len(content), _PAGE))
    xml = logical[xml_at % _PAGE :][:xml_size]
    if not xml.startswith(b"<?xml") or b"<!DOCTYPE" in xml or b"<!ENTITY" in xml:
        raise ValueError("the XML part must begin with <?xml and define no entities")


def _read_columns(file: Any, header: Any, size: int) -> dict[str, NDArray[np.float64]]:
    """The fields of a scan that are needed, a piece at a time."""
    from pye57 import libe57

    names = next((n for n in (_CARTESIAN, _SPHERICAL) if set(n) <= set(header.point_fields)), None)
    count = header.point_count
    if names is None:
        raise ValueError(f"coordinates are needed; got {', '.join(header.point_fields)}")
    if count * _LEAST_BYTES > size:
        raise ValueError(f"{count} points are declared; {size} bytes are too few")
    state = names[0].removesuffix("X").removesuffix("Range") + "InvalidState"
    others = (state, "returnIndex", *CHANNEL_FIELDS)
    wanted = [*names, *(n for n in others if n in header.point_fields)]
    capacity = min(count, _RECORDS_AT_A_TIME)
    piece = {name: np.empty(capacity) for name in wanted}
    if not count:
        return {**piece, "state": np.empty(0)}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in piece.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, capacity, True, True))
    reader, pieces, left = header.points.reader(buffers), [], count
    while left > 0 and (got := reader.read()):
        pieces.append({name: values[:got].copy() for name, values in piece.items()})
        left -= got
    reader.close()
    if left:
        raise ValueError(f"{count} points are declared; got {count - left}")
    columns = {name: np.concatenate([part[name] for part in pieces]) for name in wanted}
    columns["state"] = columns.pop(state, np.zeros(count))
    white = white_of(header)
    if white is not None:
        columns["white"] = np.full(count, white)
    return columns


def _scan_of(columns: dict[str, NDArray[np.float64]]) -> Readout:
    """The rays of one scan, scanner frame; state 0: a hit, 1: a direction alone, 2: nothing."""
    state, points = columns["state"], _points_of(columns)
    is_zero = rows_at_zero(points)
    is_hit, is_beam = (state == 0) & ~is_zero, (state == 1) & ~is_zero
    if is_beam.any():
        ranges = np.linalg.norm(points, axis=1)
        longest = float(np.nanmax(ranges[is_hit], initial=0.0))
        is_beam &= longest > 0
        points[is_beam] *= (longest / ranges[is_beam])[:, None]
    target = columns.get("returnIndex", np.zeros(len(points)))
    readout = Readout(
        points,
        is_return=is_hit,
        target_index=whole_numbers(target, "returnIndex", 0, 255) + 1,
        channels=channels_of(columns),
    )
    kept = is_hit | is_beam
    readout = readout if kept.all() else readout.select(kept)
    counts = {
        _ZEROS: int(((state == 0) & is_zero).sum()),
        NO_RETURNS: int(is_beam.sum()),
        "points marked invalid are left out": int(((state != 0) & ~is_beam).sum()),
    }
    return readout.noting(*(Note(text, count) for text, count in counts.items() if count))


def _points_of(columns: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """(n, 3) cartesian points, scanner frame [m]; angles of spherical ones are in radians."""
    if _CARTESIAN[0] in columns:
        return np.stack([columns[name] for name in _CARTESIAN], axis=1)
    ranges, azimuth, elevation = (columns[name] for name in _SPHERICAL)
    flat = ranges * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)], axis=1
    )


def _pose_of(header: Any) -> NDArray[np.float64] | None:
    """(4, 4) world_from_scanner; None without one. Missing parts of a pose are the identity."""
    if not header.has_pose():
        return None
    node = header.node["pose"]
    turn, shift = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    if node.isDefined("rotation"):
        turn = [node["rotation"][axis].value() for axis in "wxyz"]
    if node.isDefined("translation"):
        shift = [node["translation"][axis].value() for axis in "xyz"]
    quaternion = np.array([[*turn[1:], turn[0]]])
    return poses_from_quaternions(np.array([shift]), quaternion)[0]
