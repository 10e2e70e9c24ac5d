"""Colors of points on a surface by a channel of the map: its colors, values or classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from lardhm_torch.channels import CLASS
from lardhm_torch.maps import OccupancyMap

UNKNOWN_COLOR = (150, 150, 150)  # where no hit with a value is near
CHUNK_VERTICES = 1 << 18  # vertices evaluated at a time


@torch.no_grad()
def channel_values(model: Any, vertices: np.ndarray, name: str) -> np.ndarray:
    """(V, 3) world positions [m] -> (V, ...) values of a channel, or of a class probability each."""
    points = torch.as_tensor(np.array(vertices), device=model.origin.device)
    parts = [model.channel(part, name) for part in points.split(CHUNK_VERTICES)]
    return torch.cat(parts).double().cpu().numpy()


def class_labels(model: Any, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) world positions [m] -> (V,) int32 most likely class; -1 where nothing is near."""
    probability = channel_values(model, vertices, CLASS)
    numbers = np.array(model.classes, dtype=np.int32)[probability.argmax(axis=1)]
    is_known = probability.max(axis=1) > 1 / probability.shape[1] + 1e-4
    return np.where(is_known | (probability.shape[1] == 1), numbers, -1)


def class_colors(classes: Sequence[int]) -> dict[int, tuple[int, int, int]]:
    """A color for each class number, RGB; those of one number are equal in all maps."""
    from matplotlib import colormaps

    table = colormaps["tab20"](np.arange(20), bytes=True)[:, :3]
    table = np.concatenate([table[::2], table[1::2]])  # strong colors first
    rows = table.tolist()
    return {number: (*rows[number % 20],) for number in classes}


def label_colors(labels: np.ndarray) -> np.ndarray:
    """(V,) class numbers, -1 where unknown -> (V, 4) uint8 RGBA."""
    colors = _unknown_colors(len(labels))
    for number, color in class_colors(sorted(set(labels.tolist()) - {-1})).items():
        colors[labels == number, :3] = color
    return colors


def _unknown_colors(count: int) -> np.ndarray:
    return np.full((count, 4), (*UNKNOWN_COLOR, 255), dtype=np.uint8)


def channel_colors(model: OccupancyMap, vertices: np.ndarray, name: str) -> np.ndarray:
    """Colors of points by a channel: colors as they are, classes by number, values from dark to bright.

    Args:
        model: a map with this channel.
        vertices: (V, 3) world positions [m].
        name: of the channel.

    Returns:
        (V, 4) uint8 RGBA; gray where no hit with a value is near.

    Raises:
        ValueError: the channel has neither one nor three values.
    """
    from matplotlib import colormaps

    if name == CLASS:
        return label_colors(class_labels(model, vertices))
    colors = _unknown_colors(len(vertices))
    values = channel_values(model, vertices, name)
    if values.ndim == 2 and values.shape[1] != 3:
        raise ValueError(
            f"a channel must have one or three values to be a color; {name!r} has {values.shape[1]}"
        )
    is_known = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
    known = values[is_known]
    if values.ndim == 2:
        colors[is_known, :3] = (255 * known.clip(0, 1)).round()
    elif len(known):
        low, high = np.quantile(known, [0.02, 0.98])
        scaled = (known - low) / max(high - low, 1e-9)
        colors[is_known] = colormaps["viridis"](scaled, bytes=True)
    return colors
