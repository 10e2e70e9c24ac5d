"""Move a mesh from a level set of the log-odds to the ridge behind it, where the hits lie.

Free space is learned only up to some centimeters before each hit, so the level set at probability
1/2 lies in front of the hits. Across a surface, the log-odds are largest at the hits themselves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap
from lardhm_torch.queries.grids import nearest_support
from lardhm_torch.queries.raycasting import first_peak, parabola_vertex

if TYPE_CHECKING:
    import trimesh

MAX_DEPTH = 4.0  # standard deviations behind a vertex within which its ridge is sought
STEPS = 16  # into which this depth is divided
CHUNK_VERTICES = 1 << 18  # vertices evaluated at a time


@torch.no_grad()
def mesh_on_ridge(model: OccupancyMap, mesh: trimesh.Trimesh, resolution: float) -> trimesh.Trimesh:
    """Move the vertices of a level-set mesh against their normals to the ridge of the log-odds.

    The ridge is sought within four standard deviations of the nearest occupied cluster (its
    smallest). Each vertex moves by the mean of its own depth and those of its neighbors. A face is
    removed if a corner and its neighbors have no ridge, or if the depths of its corners differ by
    more than a cell: they belong to different surfaces.

    Args:
        model: the map.
        mesh: level set of its probability, normals into free space.
        resolution: edge of the cells that the mesh was made with [m].

    Returns:
        A new mesh without colors.
    """
    import trimesh

    device = model.origin.device
    vertices = torch.as_tensor(np.array(mesh.vertices), device=device)
    normals = torch.as_tensor(np.array(mesh.vertex_normals), device=device)
    faces = torch.as_tensor(np.array(mesh.faces), device=device)
    thickness = nearest_support(model, vertices, sign=1).thickness
    depths = mean_with_neighbors(ridge_depths(model, vertices, normals, thickness), faces)
    corners = depths[faces]
    kept = corners.amax(dim=1) - corners.amin(dim=1) <= resolution  # False if one is NaN
    moved = vertices - depths.nan_to_num()[:, None] * normals
    result = trimesh.Trimesh(moved.cpu().numpy(), faces[kept].cpu().numpy(), process=False)
    result.remove_unreferenced_vertices()
    return result


@torch.no_grad()
def ridge_depths(
    model: OccupancyMap, vertices: Tensor, normals: Tensor, thickness: Tensor
) -> Tensor:
    """Depth of the first peak of the log-odds behind each vertex.

    Args:
        model: the map.
        vertices: (V, D) world positions [m].
        normals: (V, D) of length 1, into free space.
        thickness: (V,) standard deviation of the surface across itself [m].

    Returns:
        (V,) depths against the normals [m]; NaN if the peak is at either end of the `MAX_DEPTH`
        standard deviations searched.
    """
    numbers = torch.arange(STEPS + 1, device=vertices.device)[:, None, None]
    strides = thickness * (MAX_DEPTH / STEPS)
    depths = []
    for start, step in zip(
        vertices.split(CHUNK_VERTICES),
        (normals * strides[:, None]).split(CHUNK_VERTICES),
        strict=True,
    ):
        depths.append(_peak_position(model.log_odds(start - numbers * step).double().T))
    return torch.cat(depths) * strides


def _peak_position(log_odds: Tensor) -> Tensor:
    """(V, S) log-odds at equal steps -> (V,) position of the first peak in steps; NaN at an end.

    A parabola through three steps gives the position between steps.
    """
    last = log_odds.shape[1] - 1
    peak = first_peak(log_odds)
    around = peak.clamp(1, last - 1)[:, None] + torch.arange(-1, 2, device=peak.device)
    position = peak + parabola_vertex(log_odds.gather(1, around))
    return torch.where((peak > 0) & (peak < last), position, torch.nan)


def mean_with_neighbors(values: Tensor, faces: Tensor) -> Tensor:
    """Mean of each vertex's value and those of its neighbors; NaN values are ignored.

    Args:
        values: (V,).
        faces: (F, 3) vertices of each face.

    Returns:
        (V,), NaN where neither the vertex nor any neighbor has a value.
    """
    known = ~values.isnan()
    sums, counts = torch.where(known, values, 0.0), known.to(values.dtype)
    first, second = _edges(faces)
    ends, others = torch.cat([first, second]), torch.cat([second, first])
    return sums.index_add(0, ends, sums[others]) / counts.index_add(0, ends, counts[others])


def _edges(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends of each edge, each edge once."""
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    low, high = pairs.unbind(dim=1)
    keys = (low * (int(faces.max()) + 1) + high).unique()  # much faster than unique rows
    return keys // (int(faces.max()) + 1), keys % (int(faces.max()) + 1)
