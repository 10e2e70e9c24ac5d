"""Watertight surfaces: the boundary of known free space, closed where nothing was measured."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from lardhm_torch.maps import OccupancyMap
from lardhm_torch.queries.grids import cluster_boxes, threshold_log_odds
from lardhm_torch.surfaces.following import Rule, Sheet, follow_surface, seed_blocks
from lardhm_torch.surfaces.lattice import Lattice, border_blocks
from lardhm_torch.surfaces.ridge import (
    CHUNK_VERTICES,
    mean_with_neighbors,
    ridge_depths,
    turned_over,
)

HALVINGS = 6  # of the depth of vertices whose faces turn over, before they stay where they are


@torch.no_grad()
def closed_sheet(
    model: OccupancyMap,
    lattice: Lattice,
    threshold: float,
    log_odds_margin: float,
    *,
    on_ridge: bool,
    report: Callable[[int], object] = lambda _: None,
) -> Sheet:
    """Boundary of the space that is known to be free, from within; the rest counts as occupied.

    The level set lies a margin below the threshold, and is closed at the border of the lattice. Vertices
    with a ridge of the log-odds behind them, within `ridge.MAX_DEPTH` standard deviations of the nearest
    occupied cluster and a margin above the threshold, belong to measured surfaces. With ``on_ridge``,
    they move to this ridge, but not so far that a face would turn over. All others close gaps.

    Returns:
        The surface, with ``closing``.
    """
    level = threshold_log_odds(threshold)
    rule = Rule(level - log_odds_margin, 1, level, None, is_closed=True)
    starts = [seed_blocks(model, lattice, rule._replace(sign=sign)) for sign in (1, -1)]
    if lattice.is_cut:
        starts.append(border_blocks(lattice, *cluster_boxes(model, -1, lattice.bounds)))
    sheet = follow_surface(model, lattice, np.unique(np.concatenate(starts)), rule, report=report)
    if len(sheet.vertices) == 0:
        return sheet
    vertices, faces, normals, thickness, _ = sheet
    columns = [torch.from_numpy(c).to(model.origin.device) for c in (vertices, normals, thickness)]
    depths = ridge_depths(model, *columns)
    ridge = columns[0] - depths.nan_to_num()[:, None] * columns[1]
    log_odds = torch.cat([model.log_odds(part) for part in ridge.split(CHUNK_VERTICES)])
    depths[log_odds <= level + log_odds_margin] = torch.nan
    found = depths.cpu().numpy()
    if on_ridge:
        sheet = sheet._replace(vertices=_moved(vertices, faces, normals, found))
    return sheet._replace(closing=np.isnan(found))


def _moved(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, depths: np.ndarray
) -> np.ndarray:
    """The vertices moved against the normals, less far where a face would turn over."""
    depths = np.nan_to_num(mean_with_neighbors(depths[:, None], faces))
    upright = faces[~turned_over(vertices, faces, normals)]
    for left in reversed(range(HALVINGS)):
        moved = vertices - depths * normals
        turned = turned_over(moved, upright, normals)
        depths[upright[turned]] *= 0.5 if left else 0.0
    return vertices - depths * normals
