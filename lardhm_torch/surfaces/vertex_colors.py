"""Vertex colors of a surface: height, nearest cluster, probability, uncertainty, or a channel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, log_odds_variance
from lardhm_torch.queries.grids import nearest_support
from lardhm_torch.surfaces.channel_colors import CHUNK_VERTICES, channel_colors

COLORS = ("height", "cluster", "probability", "variance")


@torch.no_grad()
def vertex_colors(
    model: OccupancyMap, vertices: np.ndarray, sign: int, color: str | None
) -> np.ndarray | None:
    """Colors of the vertices of a mesh.

    Args:
        model: the map.
        vertices: (V, 3) world positions [m].
        sign: of the weights of the clusters that "cluster" and "probability" refer to.
        color: one of `COLORS`, the name of a channel, or None.

    Returns:
        (V, 4) uint8 RGBA; None without vertices or with color None.
    """
    from matplotlib import colormaps

    if color is None or len(vertices) == 0:
        return None
    if color == "height":
        return colormaps["viridis"](_stretched(vertices[:, 2], 0.01), bytes=True)
    if color == "variance":
        return variance_colors(model, vertices)
    if color not in COLORS:
        return channel_colors(model, vertices, color)
    points = torch.as_tensor(np.array(vertices), device=model.origin.device)
    centers = nearest_support(model, points, sign).centers
    if color == "cluster":
        return colormaps["tab20"](_color_numbers(centers), bytes=True)
    return colormaps["viridis"](2 * model(centers).cpu().numpy() - 1, bytes=True)


@torch.no_grad()
def variance_colors(model: OccupancyMap, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) world positions [m] -> (V, 4) uint8 RGBA: dark where the map is certain, else bright.

    The scale is logarithmic, from the 2 % to the 98 % quantile of the variances.
    """
    from matplotlib import colormaps

    points = torch.as_tensor(np.array(vertices), device=model.origin.device)
    variance = torch.cat([log_odds_variance(model, part) for part in points.split(CHUNK_VERTICES)])
    logs = np.log10(np.maximum(variance.double().cpu().numpy(), 1e-12))
    return colormaps["magma"](_stretched(logs, 0.02), bytes=True)


def has_variance(model: OccupancyMap) -> bool:
    """Whether the map can color by variance: it has ``variance``, and its posterior is computed."""
    try:
        log_odds_variance(model, model.centers[:1].detach().double() + model.origin)
    except (ValueError, RuntimeError):
        return False
    return True


def _color_numbers(centers: Tensor) -> np.ndarray:
    """(V, 3) centers -> (V,) one of 20 colors, by a hash of the position in millimeters."""
    position = (torch.nan_to_num(centers) * 1e3).round().long().cpu()
    mixed = (position * torch.tensor([73856093, 19349663, 83492791])).sum(dim=1)
    return (((mixed * 2654435761) >> 16) % 20).numpy()


def _stretched(values: np.ndarray, tail: float) -> np.ndarray:
    """Scale values so that the given quantiles at both ends are 0 and 1: outliers do not count."""
    low, high = np.quantile(values, [tail, 1 - tail])
    return (values - low) / max(high - low, 1e-9)
