"""Sensor position of each scan: from the file or from the caller; otherwise an error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lardhm_torch.io.no_returns import seen_beams
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import POSE_FILES
from lardhm_torch.io.poses import find_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.scans import Scans

FARTHEST_START = 100.0  # [m] a sensor at zero would have points nearer than this
_GIVE_IT = "load_scans(path, origin=(x, y, z)), --origin X,Y,Z on the command line"


def with_origins(
    readout: Readout, file: Path, origin: Sequence[float] | None, num_placeholders: int
) -> Readout:
    """The readout with a sensor position for every scan.

    Args:
        readout: of one file, or a piece of it.
        file: for messages, and to look for a pose file beside it.
        origin: (D,) what the caller says, for scans whose position the file does not know [m].
        num_placeholders: scans of the whole call whose position is a placeholder.

    Raises:
        ValueError: a position is not known, or is a placeholder that cannot be right.
    """
    if not readout.needs_origin:
        return readout
    if origin is not None:
        return _filled(readout, file, origin)
    if readout.origins is None or not readout.origin_is_placeholder:
        raise _unknown(readout, file)
    wrong = _why_placeholder_is_wrong(readout, file, num_placeholders)
    if wrong:
        raise ValueError(
            f"{file} must contain the sensor position. Its pose is the identity, which many programs "
            f"write if they have no pose, and {wrong}. {readout.origin_cure} or give it: "
            f"{_GIVE_IT}.{_hint(file)}"
        )
    zero = ",".join("0" * readout.dim)
    note = Note(
        "identity pose assumed to be that of a sensor at zero", cure=f"--origin {zero} confirms it"
    )
    return seen_beams(replace(readout, origin_is_placeholder=False)).noting(note)


def with_identities(readout: Readout, is_identity: NDArray[np.bool_]) -> Readout:
    """The readout of a file with several poses, some of which (S,) are the identity.

    If all of them are, they are placeholders (`with_origins`). One among others may be the scan
    that the others are registered to, unless its points are far away; more than one are unknown.
    """
    assert readout.origins is not None
    if is_identity.all() or not is_identity.any():
        return replace(readout, origin_is_placeholder=bool(is_identity.all()))
    scan = int(np.argmax(is_identity))
    is_one = int(is_identity.sum()) == 1
    ends = readout.ends if readout.scan_id is None else readout.ends[readout.scan_id == scan]
    if is_one and _nearest(ends) <= FARTHEST_START:
        cure = "if the others are registered to this scan; else export it with its pose"
        return readout.noting(
            Note(f"the identity pose of scan {scan} is assumed to be valid", cure=cure)
        )
    return replace(readout, origins=np.where(is_identity[:, None], np.nan, readout.origins))


def _filled(readout: Readout, file: Path, origin: Sequence[float]) -> Readout:
    """The given origin where none is known, or only a placeholder."""
    if len(origin) != readout.dim:
        raise ValueError(
            f"origin must be ({readout.dim},), as the points of {file}; got {tuple(origin)}"
        )
    given = np.tile(np.array(origin, dtype=np.float64), (readout.num_scans, 1))
    if readout.origins is not None and not readout.origin_is_placeholder:
        given = np.where(np.isnan(readout.origins), given, readout.origins)
    note = Note("sensor position as given (origin)")
    return seen_beams(replace(readout, origins=given, origin_is_placeholder=False)).noting(note)


def _unknown(readout: Readout, file: Path) -> ValueError:
    which = ""
    if readout.origins is not None:
        missing = np.flatnonzero(np.isnan(readout.origins).any(axis=1))
        which = f" for {len(missing)} of {readout.num_scans} scans, the first of them {missing[0]}"
    return ValueError(
        f"{file} must contain the sensor position; it does not{which}. {readout.origin_cure} or "
        f"give it: {_GIVE_IT}.{_hint(file)}"
    )


def _why_placeholder_is_wrong(readout: Readout, file: Path, num_placeholders: int) -> str:
    """The reason why no sensor can have been at zero; empty if there is none."""
    if num_placeholders > 1:
        return f"{num_placeholders} scans have it"
    poses = find_beside(file, POSE_FILES)
    if poses is not None:
        return f"there is {poses.name} beside it"
    near = _nearest(readout.ends)
    if near > FARTHEST_START:
        return f"the points are {near:.0f} m and more from there"
    return ""


def _nearest(ends: NDArray[np.float64]) -> float:
    """How far the nearest points are from zero, but for a hundredth of them [m]."""
    ranges = np.linalg.norm(ends[:: 1 + len(ends) // 100_000], axis=1)
    ranges = ranges[np.isfinite(ranges)]
    return float(np.quantile(ranges, 0.01)) if len(ranges) else 0.0


def _hint(file: Path) -> str:
    poses = find_beside(file, POSE_FILES)
    return "" if poses is None else f' For {poses.name}: frame="sensor" or frame="world".'


def unused_origin(origin: Sequence[float], files: Sequence[Path]) -> ValueError:
    """The error for an origin that no file needs."""
    names = str(files[0]) if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    return ValueError(
        "origin must be left out when the files carry their own sensor positions; "
        f"got origin={tuple(origin)} for {names}"
    )


def note_not_finite(readout: Readout) -> Readout:
    """The readout with a note of how many ends are NaN or infinite: sampling drops these rays."""
    if math.isfinite(readout.ends.sum()):  # takes no memory
        return readout
    count = int((~np.isfinite(readout.ends).all(axis=1)).sum())
    return readout.noting(
        Note("points are not finite (no measurement): sampling drops them", count)
    )


def scans_from(readout: Readout, file: Path) -> Scans:
    """The readout, which has its origins, as Scans.

    Raises:
        ValueError: the arrays do not fit each other, or an origin is not finite.
    """
    columns = {
        "origins": readout.origins,
        "ends": readout.ends,
        "scan_id": readout.scan_id,
        "is_return": readout.is_return,
        "target_index": readout.target_index,
        "times": readout.scan_times,
    }
    known = {name: torch.from_numpy(v) for name, v in columns.items() if v is not None}
    channels = {name: torch.from_numpy(v) for name, v in readout.channels.items()}
    try:
        scans = Scans(**known, channels=channels)
    except ValueError as error:
        raise ValueError(f"{file} does not hold scans: {error}") from error
    if not np.isfinite(scans.origins.numpy()).all():
        raise ValueError(f"{file}: origins must be finite; got {scans.origins.tolist()[:3]}")
    return scans
