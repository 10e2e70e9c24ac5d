"""Named columns of files as channels: colors, packed colors, intensity, classes.

Bytes and 16-bit numbers of colors follow from the type of their columns; of floating point colors, the
largest value tells whether 1, 255 or 65535 is white.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.channels import CLASS, COLOR, INTENSITY, MOST_CLASSES

_COLORS = ("red", "green", "blue")
_PACKED = ("rgb", "rgba")
_CLASSES = ("class", "label", "classification")
_INTENSITIES = ("intensity", "scalar_intensity", "reflectivity", "reflectance")
_VALUES = ("ring",)
CHANNEL_COLUMNS = frozenset((*_COLORS, *_PACKED, *_CLASSES, *_INTENSITIES, *_VALUES))
Columns = Mapping[str, NDArray]


def channels_from_columns(columns: Columns) -> dict[str, NDArray]:
    """The channels among (R,) columns, which have the types of the file; others are left out."""
    found: dict[str, NDArray] = {}
    packed = next((columns[name] for name in _PACKED if name in columns), None)
    if all(name in columns for name in _COLORS):
        found[COLOR] = scaled_colors(np.stack([columns[name] for name in _COLORS], axis=1))
    elif packed is not None:
        found[COLOR] = unpacked_colors(packed)
    for name in (*_INTENSITIES, *_VALUES):
        channel = name if name in _VALUES else INTENSITY
        if name in columns and channel not in found:
            found[channel] = finite_values(columns[name])
    for name in _CLASSES:
        if name in columns and CLASS not in found:
            classes = class_numbers(columns[name])
            found[name if classes is None else CLASS] = (
                finite_values(columns[name]) if classes is None else classes
            )
    return found


def joined_columns(parts: Sequence[tuple[Mapping[str, NDArray], int]]) -> dict[str, NDArray]:
    """Channels of several parts, with the number of rows of each; missing where a part has none."""
    joined = {}
    for name in dict.fromkeys(name for channels, _ in parts for name in channels):
        like = next(channels[name] for channels, _ in parts if name in channels)
        missing = -1 if like.dtype.kind == "i" else np.nan
        joined[name] = np.concatenate(
            [
                channels[name]
                if name in channels
                else np.full((count, *like.shape[1:]), missing, like.dtype)
                for channels, count in parts
            ]
        )
    return joined


def scaled_colors(values: NDArray, white: float | None = None) -> NDArray[np.float32]:
    """(R, 3) numbers of any type -> (R, 3) from 0 to 1; NaN where a float is none.

    Args:
        values: the numbers.
        white: the number of white; None: by the type, or the largest value of floats.
    """
    if white is None:
        white = _white(values)
    colors = values.astype(np.float32) / np.float32(white)
    colors[~np.isfinite(colors).all(axis=1)] = np.nan
    return np.clip(colors, 0, 1)


def _white(values: NDArray) -> float:
    if values.dtype.kind in "iu" and values.dtype.itemsize == 1:
        return 255.0
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        return 65535.0
    finite = values[np.isfinite(values)]
    largest = float(finite.max()) if len(finite) else 1.0
    limits = (255.0, 65535.0) if values.dtype.kind in "iu" else (1.0, 255.0, 65535.0)
    return next((limit for limit in limits if largest <= limit), max(largest, 1.0))


def unpacked_colors(values: NDArray) -> NDArray[np.float32]:
    """(R,) 0x00RRGGBB as integers, or as the bits of float32 -> (R, 3) from 0 to 1."""
    if values.dtype.kind == "f":
        values = np.ascontiguousarray(values, np.float32).view(np.uint32)
    words = values.astype(np.int64)
    channels = [(words >> shift) & 0xFF for shift in (16, 8, 0)]
    return np.stack(channels, axis=1).astype(np.float32) / np.float32(255)


def class_numbers(values: NDArray) -> NDArray[np.int64] | None:
    """(R,) numbers as classes, -1 where one is NaN; None if some are no class numbers."""
    known = np.isfinite(values)
    whole = np.where(known, values, -1)
    fits = (whole >= -1) & (whole < MOST_CLASSES) & (whole == np.floor(whole))
    return whole.astype(np.int64) if bool(fits.all()) else None


def finite_values(values: NDArray) -> NDArray[np.float32]:
    """Numbers of any type as float32; NaN, missing, where they are not finite."""
    numbers = values.astype(np.float32)
    if math.isfinite(numbers.sum()):  # all are, which is the usual case
        return numbers
    return np.where(np.isfinite(numbers), numbers, np.float32(np.nan))
