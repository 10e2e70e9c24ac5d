"""Channels of E57 scans: color and intensity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import scaled_colors

_COLORS = ("colorRed", "colorGreen", "colorBlue")
CHANNEL_FIELDS = (*_COLORS, "intensity", "isColorInvalid", "isIntensityInvalid")


def white_of(header: Any) -> float | None:
    """The number of white: the limit of the colors of a scan, else of their type; None without colors."""
    if not set(_COLORS) <= set(header.point_fields):
        return None
    limits = "colorLimits"
    if header.node.isDefined(limits) and header.node[limits].isDefined("colorRedMaximum"):
        white = float(header.node[limits]["colorRedMaximum"].value())
    else:
        entry = header.points.prototype()["colorRed"]
        white = float(entry.maximum())
    return white if np.isfinite(white) and 0 < white < 2**32 else 255.0


def channels_of(columns: dict[str, NDArray[np.float64]]) -> dict[str, NDArray]:
    """Color and intensity of the records of a scan."""
    channels: dict[str, NDArray] = {}
    if "white" in columns and len(columns["white"]):
        colors = np.stack([columns[name] for name in _COLORS], axis=1)
        channels["color"] = scaled_colors(colors, float(columns["white"][0]))
        if "isColorInvalid" in columns:
            channels["color"][columns["isColorInvalid"] != 0] = np.nan
    if "intensity" in columns:
        values = columns["intensity"].astype(np.float32)
        is_known = np.isfinite(values)
        if "isIntensityInvalid" in columns:
            is_known &= columns["isIntensityInvalid"] == 0
        channels["intensity"] = np.where(is_known, values, np.float32(np.nan))
    return channels
