"""PTX (Leica Cyclone): scans on a grid of columns and rows, each with its scanner's pose."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.no_returns import NO_RETURNS, grid_directions
from lardhm_torch.io.notes import Note
from lardhm_torch.io.origins import with_identities
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.records import header_count, text_encoding
from lardhm_torch.io.trajectories import check_rigid, move_points

_HEADER_LINES = 10
_LEAST_BYTES = 8  # of the line of a point: "0 0 0 0"


@dataclass(frozen=True)
class _Scan:
    """One scan of the file.

    Args:
        points: (C R, 3) in the scanner's frame [m]; zero where a beam met nothing.
        shape: columns C and rows R of the grid, the points column by column.
        pose: (4, 4) world_from_scanner.
    """

    points: NDArray[np.float64]
    shape: tuple[int, int]
    pose: NDArray[np.float64]


def read_ptx(path: Path) -> Readout:
    """Every scan of a PTX file, moved by its matrix; the origin is the scanner's position.

    A point at exactly zero is a beam without return. Its direction follows from the grid where all
    beams of a column have one azimuth and all of a row one elevation; else it is left out.

    Raises:
        ValueError: the file is cut short, a header is broken, or no point is left.

    Source: the header as Leica describes it: columns, rows, position, three axes, 4 x 4 matrix for
    row vectors (its last line is the translation).
    """
    size = os.path.getsize(path)
    scans = []
    with open(path, encoding=text_encoding(path)) as file:
        while (scan := _next_scan(file, size)) is not None:
            scans.append(scan)
    if not scans:
        raise ValueError("a header of 10 lines is needed; the file is empty")
    ends, scan_id, is_return, lost = [], [], [], 0
    for number, scan in enumerate(scans):
        hits, free, left_out = _beams(scan)
        ends += [move_points(scan.pose, hits), move_points(scan.pose, free)]
        is_return += [np.ones(len(hits), dtype=bool), np.zeros(len(free), dtype=bool)]
        scan_id += [np.full(len(hits) + len(free), number)]
        lost += left_out
    if not any(map(len, ends)):
        raise ValueError("at least one point is needed; all are at exactly zero")
    poses = np.stack([scan.pose for scan in scans])
    readout = Readout(
        np.concatenate(ends),
        poses[:, :3, 3].copy(),
        np.concatenate(scan_id),
        np.concatenate(is_return),
        origin_cure="Export the scans with their positions",
        notes=_notes(int(sum(map(np.sum, map(np.logical_not, is_return)))), lost),
    )
    return with_identities(readout, (poses == np.eye(4)).all(axis=(1, 2)))


def _notes(num_free: int, num_lost: int) -> tuple[Note, ...]:
    notes = [Note("scanner positions from the headers")]
    if num_free:
        notes.append(Note(NO_RETURNS, num_free))
    if num_lost:
        text = "points at exactly zero are left out (no measurement)"
        notes.append(Note(text, num_lost, is_loss=True))
    return tuple(notes)


def _beams(scan: _Scan) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """(h, 3) hits, (f, 3) ends of beams without return, scanner frame; how many are left out."""
    is_zero = (scan.points == 0).all(axis=1)
    hits = scan.points[~is_zero]
    directions = grid_directions(scan.points, scan.shape) if is_zero.any() and len(hits) else None
    if directions is None:
        return hits, np.empty((0, 3)), int(is_zero.sum())
    known = is_zero & np.isfinite(directions).all(axis=1)
    longest = np.nanmax(np.linalg.norm(hits, axis=1))
    return hits, longest * directions[known], int(is_zero.sum() - known.sum())


def _next_scan(file: TextIO, size: int) -> _Scan | None:
    """The scan at the file's position; None at its end."""
    lines = [file.readline(65_536).split() for _ in range(_HEADER_LINES)]
    if not any(lines):
        return None
    shape = tuple(header_count(" ".join(words), "columns and rows") for words in lines[:2])
    count = shape[0] * shape[1]
    if count * _LEAST_BYTES > size:
        raise ValueError(f"{count} points are declared; {size} bytes are too few")
    points = np.empty((0, 3))
    if count:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no line left: counted below
            points = np.loadtxt(file, usecols=(0, 1, 2), max_rows=count, comments=None, ndmin=2)
    if len(points) != count:
        raise ValueError(f"{count} points are declared; got {len(points)} lines")
    pose, shift = _pose(lines[2:])
    return _Scan(np.where((points == 0).all(1)[:, None], 0, points - shift), shape, pose)  # type: ignore[arg-type]


def _pose(lines: list[list[str]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(4, 4) world_from_scanner, and (3,) where the scanner is in the frame of the points."""
    if [len(words) for words in lines] != [3, 3, 3, 3, 4, 4, 4, 4]:
        raise ValueError("a header needs a position, three axes and a 4 x 4 matrix; it has not")
    try:
        rows = [[float(word) for word in words] for words in lines]
    except ValueError as error:
        raise ValueError(f"a header must hold numbers: {error}") from error
    position, matrix = np.array(rows[0]), np.array(rows[4:]).T
    check_rigid(matrix[None], "the matrix of the header")
    if not np.isfinite(position).all():
        raise ValueError(f"the position in a header must be finite; got {position.tolist()}")
    shift = np.zeros(3)
    if (matrix == np.eye(4)).all():  # the points are registered already
        matrix[:3, 3] = shift = position
    elif position.any() and not np.allclose(position, matrix[:3, 3], rtol=1e-6, atol=1e-3):
        raise ValueError(
            f"position {position.tolist()} and translation {matrix[:3, 3].tolist()} of a header "
            "must agree. Make them equal, or set the position to 0 0 0 to use the matrix"
        )
    return matrix, shift
