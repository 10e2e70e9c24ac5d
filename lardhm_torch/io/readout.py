"""The contents of a scan file, before they are known to be complete."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import CHANNEL_COLUMNS, channels_from_columns
from lardhm_torch.io.notes import Note

RAY_COLUMNS = frozenset(
    {"x", "y", "z", "ox", "oy", "oz", "scan_id", "is_return", "target_index", "return_number"}
)
COLUMN_NAMES = RAY_COLUMNS | CHANNEL_COLUMNS  # those that are read


@dataclass(frozen=True)
class Readout:
    """Rays of one file, as arrays; None where the file says nothing.

    Args:
        ends: (R, D) float64 ray ends, world frame [m].
        origins: (S, D) float64 sensor positions [m]; a row of NaN: not known for this scan.
        scan_id: (R,) int64 index into origins.
        is_return: (R,) bool.
        target_index: (R,) int64, 1 = first return of a pulse.
        world_from_sensor: (4, 4) pose the file carries, which has not moved its points.
        origin_is_placeholder: origins is what writers put when they know no pose.
        origin_cure: how a file of this format can carry its sensor position.
        notes: what was assumed or left out.
        times: (R,) float64 when each ray was measured [s], in the clock of the file.
        grid: rows and columns of an organized cloud, whose rays come row by row.
        channels: (R, ...) values of the rays by name, see `lardhm_torch.channels`.
        scan_times: (S,) float64 time stamp of each scan [s].
    """

    ends: NDArray[np.float64]
    origins: NDArray[np.float64] | None = None
    scan_id: NDArray[np.int64] | None = None
    is_return: NDArray[np.bool_] | None = None
    target_index: NDArray[np.int64] | None = None
    world_from_sensor: NDArray[np.float64] | None = None
    origin_is_placeholder: bool = False
    origin_cure: str = "Add columns ox oy oz"
    notes: tuple[Note, ...] = ()
    times: NDArray[np.float64] | None = None
    grid: tuple[int, int] | None = None
    channels: Mapping[str, NDArray] = field(default_factory=dict)
    scan_times: NDArray[np.float64] | None = None

    def noting(self, *notes: Note) -> Readout:
        """The same with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def select(self, rays: NDArray) -> Readout:
        """The given rays (mask or indices), with all origins kept."""
        columns = ("ends", "scan_id", "is_return", "target_index", "times")
        values = {name: getattr(self, name) for name in columns}
        kept = {name: value[rays] for name, value in values.items() if value is not None}
        channels = {name: values[rays] for name, values in self.channels.items()}
        return replace(self, **kept, grid=None, channels=channels)

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return self.ends.shape[1]

    @property
    def needs_origin(self) -> bool:
        """Whether a sensor position from the caller is needed."""
        if self.origins is None or self.origin_is_placeholder:
            return True
        return bool(np.isnan(self.origins).any())

    @property
    def num_scans(self) -> int:
        """Number of scans S."""
        if self.origins is not None:
            return len(self.origins)
        if self.scan_id is None or not len(self.scan_id):
            return 1
        return int(self.scan_id.max()) + 1


def rows_at_zero(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(R,) whether all coordinates of a point are 0; by columns, which is the fastest."""
    is_zero = points[:, 0] == 0
    for axis in range(1, points.shape[1] if np.count_nonzero(is_zero) else 1):
        is_zero &= points[:, axis] == 0
    return is_zero


def without_zeros(readout: Readout) -> Readout:
    """The readout without points at exactly zero, in the coordinates of the file.

    Many writers put (0, 0, 0) where a beam met nothing or a point was invalid. As hits they would
    be phantoms; where the sensor is at zero itself, rays without length.
    """
    is_zero = rows_at_zero(readout.ends)
    count = int(np.count_nonzero(is_zero))
    if not count:
        return readout
    note = Note("points at exactly zero are left out (no measurement)", count, is_loss=True)
    return readout.select(~is_zero).noting(note)


def readout_from_columns(columns: Mapping[str, NDArray]) -> Readout:
    """Named columns of equal length as rays: x y [z], ox oy [oz], scan_id, is_return, target_index.

    Columns of `channel_columns` have the types of the file and become channels.
    Rows with the same scan_id and the same origin are one scan. Scans are numbered in ascending
    scan_id, or, without one, in order of first appearance.

    Raises:
        ValueError: there is no x or y, no row, only part of an origin, or a value out of range.
    """
    names = [name for name in ("x", "y", "z") if name in columns]
    if names[:2] != ["x", "y"]:
        raise ValueError(f"columns x and y are needed; got {', '.join(columns) or 'none'}")
    ends = np.stack([columns[name] for name in names], axis=1).astype(np.float64, copy=False)
    if not len(ends):
        raise ValueError("at least one point is needed; got none")
    origin_names = [name for name in ("ox", "oy", "oz") if name in columns]
    if origin_names and origin_names != ["o" + name for name in names]:
        raise ValueError(
            f"the origin needs the columns {', '.join('o' + name for name in names)}; "
            f"got {', '.join(origin_names)}"
        )
    origins, scan_id = _scans_of_rows(columns, origin_names)
    target = columns.get("target_index", columns.get("return_number"))
    notes = (Note("sensor positions from columns ox oy oz"),) if origin_names else ()
    is_return = columns.get("is_return")
    return Readout(
        ends,
        origins,
        scan_id,
        None if is_return is None else whole_numbers(is_return, "is_return", 0, 1).astype(bool),
        None if target is None else whole_numbers(target, "target_index", 1, 2**31),
        notes=notes,
        channels=channels_from_columns(columns),
    )


def whole_numbers(values: NDArray, name: str, lowest: int, highest: int) -> NDArray[np.int64]:
    """(R,) values as int64.

    Raises:
        ValueError: one is not a whole number from lowest to highest.
    """
    fits = (values >= lowest) & (values <= highest) & (values == np.floor(values))
    if not fits.all():
        row = int(np.argmin(fits))
        raise ValueError(
            f"{name} must be a whole number from {lowest} to {highest}; "
            f"got {values[row]} at row {row}"
        )
    return values.astype(np.int64)


def _scans_of_rows(
    columns: Mapping[str, NDArray], origin_names: list[str]
) -> tuple[NDArray[np.float64] | None, NDArray[np.int64] | None]:
    """((S, D) origins, (R,) scan_id) from what tells the rows apart; None where nothing does."""
    keys = [np.asarray(columns[name], dtype=np.float64) for name in origin_names]
    if "scan_id" in columns:
        whole_numbers(columns["scan_id"], "scan_id", -(2**31), 2**31)
        keys.insert(0, columns["scan_id"].astype(np.float64))
    if not keys:
        return None, None
    rows = np.stack(keys, axis=1)
    if not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise ValueError(f"{', '.join(origin_names)} must be finite; got {rows[row]} at row {row}")
    # Rows of one scan usually follow each other: sorting the first row of each run is enough.
    starts = np.flatnonzero(np.r_[True, (rows[1:] != rows[:-1]).any(axis=1)])
    scans, first, number = np.unique(rows[starts], axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)  # NumPy 2.0 alone returns (n, 1) here
    if "scan_id" not in columns:
        order = np.argsort(first)
        scans, number = scans[order], np.argsort(order)[number]
    scan_id = np.repeat(number, np.diff(np.r_[starts, len(rows)])).astype(np.int64)
    origins = scans[:, -len(origin_names) :] if origin_names else None
    return origins, scan_id
