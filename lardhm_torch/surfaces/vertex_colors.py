"""Colors of a surface's vertices: height, nearest cluster, how sure, how well known."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.queries.grids import nearest_support

COLORS = ("height", "cluster", "probability", "variance")
CHUNK_VERTICES = 1 << 18  # whose variance is asked at a time


@torch.no_grad()
def vertex_colors(
    model: Any, vertices: np.ndarray, side: int, color: str | None
) -> np.ndarray | None:
    """(V, 3) world positions [m] -> (V, 4) RGBA, or None for no colors.

    "cluster" and "probability" (at its center) are those of the nearest cluster whose weight has
    the sign ``side``.
    """
    from matplotlib import colormaps

    if color is None or len(vertices) == 0:
        return None
    if color == "height":
        return colormaps["viridis"](_stretch(vertices[:, 2]), bytes=True)
    places = torch.as_tensor(np.array(vertices), device=model.origin.device)
    if color == "variance":
        variance = torch.cat([model.variance(part) for part in places.split(CHUNK_VERTICES)])
        return colormaps["plasma"](_stretch(variance.double().cpu().numpy()), bytes=True)
    centers = nearest_support(model, places, side).centers
    if color == "cluster":
        return colormaps["tab20"](_shades(centers), bytes=True)
    return colormaps["viridis"](2 * model(centers).cpu().numpy() - 1, bytes=True)


def _shades(centers: Tensor) -> np.ndarray:
    """(V,) one of 20 for each center (V, 3), by its place in millimeters: neighbors differ mostly."""
    place = (torch.nan_to_num(centers) * 1e3).round().long().cpu()
    mixed = (place * torch.tensor([73856093, 19349663, 83492791])).sum(dim=1)
    return (((mixed * 2654435761) >> 16) % 20).numpy()


def _stretch(values: np.ndarray) -> np.ndarray:
    """Values to colors' [0, 1]; a few stray faces shall not set the scale."""
    low, high = np.quantile(values, [0.01, 0.99])
    return (values - low) / max(high - low, 1e-9)
