"""Channels of LAS points: intensity, colors of 8 or 16 bits, classification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import joined_columns, scaled_colors

BYTE, WORD = 255.0, 65535.0  # the number of white
_COLORS = ("red", "green", "blue")


def white_of(points: Any, before: float) -> float:
    """The number of white: 65535 from the first value above 255 on, as the format demands, else 255."""
    if not set(_COLORS) <= set(points.point_format.dimension_names):
        return before
    largest = max(int(np.max(points[name], initial=0)) for name in _COLORS)
    return WORD if largest > BYTE else before


def channels_of(points: Any, white: float) -> dict[str, NDArray]:
    """Channels of points; those that are 0 at all of them are left out."""
    names = set(points.point_format.dimension_names)
    channels: dict[str, NDArray] = {}
    intensity = np.array(points.intensity, dtype=np.float32)
    if intensity.any():
        channels["intensity"] = intensity
    if set(_COLORS) <= names:
        colors = np.stack([np.asarray(points[name]) for name in _COLORS], axis=1)
        if colors.any():
            channels["color"] = scaled_colors(colors, white)
    classes = np.array(points.classification, dtype=np.int64)
    if classes.any():
        channels["class"] = np.where(classes == 0, -1, classes)  # 0: created, never classified
    return channels


def joined_channels(
    parts: Sequence[tuple[dict[str, NDArray], int, float]],
) -> dict[str, NDArray]:
    """Channels of all pieces: their channels, numbers of points and numbers of white."""
    white = max(part[2] for part in parts)
    scaled = []
    for channels, count, own_white in parts:
        if "color" in channels:
            color = channels["color"] * np.float32(own_white / white)
            channels = {**channels, "color": color}
        scaled.append((channels, count))
    return joined_columns(scaled)
