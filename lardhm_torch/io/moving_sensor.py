"""Points with GPS times, each seen from where a moving sensor was: mobile and airborne LAS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import POSE_FILES
from lardhm_torch.io.pose_files import read_track
from lardhm_torch.io.poses import find_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.trajectories import MAX_STAMP_GAP, STAMP_ROUNDING

ORIGIN_STEP = 1e-3  # [m] rays whose sensor moved less share one origin
_FARTHEST = 50e3  # [m] from the points: positions in other coordinates are farther
_WEEK = 604_800.0  # [s]
_ADJUSTED = 1e9  # [s] LAS counts "adjusted standard GPS time" from here
_UNIX = 315_964_800.0 - 18.0  # [s] GPS time counts from 1980 and, since 2017, is 18 s ahead
TRACK_FILES = (*POSE_FILES, "sbet.txt")


@dataclass(frozen=True)
class Track:
    """Positions over time.

    Args:
        stamps: (L,) strictly ascending [s], in the clock of the file.
        positions: (L, 3) world frame [m].
    """

    stamps: NDArray[np.float64]
    positions: NDArray[np.float64]

    @property
    def longest_step(self) -> float:
        """How long an interval may be before it counts as a gap [s]."""
        steps = np.diff(self.stamps)
        return max(2 * MAX_STAMP_GAP, 2.5 * float(np.median(steps))) if len(steps) else 0.0

    def covers(self, times: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) whether each time lies between two stamps without a gap."""
        right = np.searchsorted(self.stamps, times).clip(1, max(1, len(self.stamps) - 1))
        is_inside = (times >= self.stamps[0] - STAMP_ROUNDING) & (
            times <= self.stamps[-1] + STAMP_ROUNDING
        )
        if len(self.stamps) == 1:
            return is_inside
        return is_inside & (self.stamps[right] - self.stamps[right - 1] <= self.longest_step)


def seen_from_track(readout: Readout, file: Path) -> Readout | None:
    """Each point seen from the position at its time, by a trajectory beside the file.

    The trajectory is text, ``time x y z`` and what follows (an SBET exported to the coordinates of
    the points), or TUM's lines. Its clock may be that of the points, or GPS seconds of the week,
    since 1980, or Unix time, where theirs is LAS's adjusted standard GPS time, and the other way
    round. Points before the first and after the last position, and in gaps, are left out.

    Returns:
        None where there is no trajectory, or one of poses with stamps of another kind.

    Raises:
        ValueError: the trajectory is none, or does not cover the points.
    """
    if readout.times is None or readout.dim != 3:
        return None
    source = find_beside(file, TRACK_FILES)
    if source is None:
        return None
    track, is_only_track = _read_track(source, source.stat().st_mtime_ns)
    if track is None:
        return None
    times, clock, is_covered = _in_clock_of(track, readout.times)
    if not is_covered.any():
        if not is_only_track:
            return None
        raise ValueError(
            f"{source} must cover the GPS times of the points, {readout.times.min():.3f} to "
            f"{readout.times.max():.3f} s; it goes from {track.stamps[0]:.3f} to "
            f"{track.stamps[-1]:.3f} s"
        )
    notes = [Note(f"each point seen from its position in {source.name}{clock}")]
    if not is_covered.all():
        text = f"points left out: {source.name} does not cover their GPS times"
        notes.append(Note(text, int((~is_covered).sum()), is_loss=True))
        readout, times = readout.select(is_covered), times[is_covered]
    origins, scan_id = _origins(track, times)
    _check_coordinates(readout.ends, origins[scan_id], source)
    seen = replace(readout, origins=origins, scan_id=scan_id, origin_is_placeholder=False)
    return seen.noting(*notes)


@lru_cache(maxsize=2)
def _read_track(path: Path, changed: int) -> tuple[Track | None, bool]:
    """Positions over time, and whether the file can be nothing else; None for KITTI's lines."""
    rows, columns = read_track(path)
    if rows is None:
        return None, False
    stamps, first = np.unique(rows[:, 0], return_index=True)
    return Track(stamps, rows[first, 1:]), columns != 8


def _in_clock_of(
    track: Track, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], str, NDArray[np.bool_]]:
    """Times in the clock of a track, what was done to them, and which of them it covers."""
    week = np.floor((track.stamps[0] + _ADJUSTED) / _WEEK) * _WEEK
    start = np.floor((times.min() + _ADJUSTED) / _WEEK) * _WEEK
    shifts = {"": 0.0}
    if times.max() > 2 * _WEEK:  # adjusted standard GPS time, not that of the week
        shifts[", in GPS seconds of the week"] = _ADJUSTED - start
        shifts[", in GPS seconds since 1980"] = _ADJUSTED
        shifts[", in Unix time"] = _ADJUSTED + _UNIX
    elif track.stamps[0] > 2 * _WEEK:
        shifts[", in adjusted standard GPS time"] = week - _ADJUSTED
        for name, since in (("GPS seconds since 1980", 0.0), ("Unix time", _UNIX)):
            shifts[f", in {name}"] = np.floor((track.stamps[0] - since) / _WEEK) * _WEEK + since
    found = [(track.covers(times + shift), shift, name) for name, shift in shifts.items()]
    is_covered, shift, name = max(found, key=lambda item: int(item[0].sum()))
    return times + shift, name, is_covered


def _origins(
    track: Track, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(S, 3) sensor positions a millimeter apart, and (R,) which one each ray starts from."""
    lengths = np.linalg.norm(np.diff(track.positions, axis=0), axis=1)
    along = np.r_[0.0, np.cumsum(lengths)]
    steps = np.floor(np.interp(times, track.stamps, along) / ORIGIN_STEP)
    _, first, scan_id = np.unique(steps, return_index=True, return_inverse=True)
    axes = [np.interp(times[first], track.stamps, axis) for axis in track.positions.T]
    return np.stack(axes, axis=1), scan_id.reshape(-1).astype(np.int64)


def _check_coordinates(
    ends: NDArray[np.float64], starts: NDArray[np.float64], source: Path
) -> None:
    """Raise a ValueError if sensor and points cannot be in the same coordinates."""
    some = slice(None, None, 1 + len(ends) // 1000)
    distance = float(np.median(np.linalg.norm(ends[some] - starts[some], axis=1)))
    if distance > _FARTHEST:
        raise ValueError(
            f"{source} must be in the coordinates of the points; the sensor would be "
            f"{distance / 1000:.0f} km from them"
        )
