"""From a level of the probability to the ridge of the log-odds behind it, where the hits lie.

Free space is learned only up to some centimeters before each hit, so the surface at 1/2 lies in
front of what was measured. Across a surface log-odds are largest at the hits themselves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.queries.grids import EVIDENCE, nearest_support

if TYPE_CHECKING:
    import trimesh

REACH = 4.0  # standard deviations behind a vertex within which its ridge is sought
STEPS = 16  # into which the reach is divided
CHUNK_VERTICES = 1 << 18  # probed at a time


@torch.no_grad()
def mesh_on_ridge(model: Any, mesh: trimesh.Trimesh, resolution: float) -> trimesh.Trimesh:
    """A level's mesh, its vertices moved against their normals to the ridge of the log-odds.

    The way is sought within four standard deviations of the nearest occupied cluster (across its
    surface), and is the mean of a vertex's own and its neighbors'. A face is left out where a
    corner and its neighbors found no ridge, or where the ways of its corners differ by more than a
    cell: its corners have met different surfaces.

    Args:
        model: a map.
        mesh: faces at one level of its probability, normals into free space.
        resolution: edge of the cells that the mesh was made with [m].
    """
    import trimesh

    device = model.origin.device
    vertices = torch.as_tensor(np.array(mesh.vertices), device=device)
    normals = torch.as_tensor(np.array(mesh.vertex_normals), device=device)
    faces = torch.as_tensor(np.array(mesh.faces), device=device)
    thickness = nearest_support(model, vertices, sign=1).thickness
    depths = mean_with_neighbors(ridge_depths(model, vertices, normals, thickness), faces)
    corners = depths[faces]
    kept = corners.amax(dim=1) - corners.amin(dim=1) <= resolution  # never, if one is NaN
    moved = vertices - depths.nan_to_num()[:, None] * normals
    result = trimesh.Trimesh(moved.cpu().numpy(), faces[kept].cpu().numpy(), process=False)
    result.remove_unreferenced_vertices()
    return result


@torch.no_grad()
def ridge_depths(model: Any, vertices: Tensor, normals: Tensor, thickness: Tensor) -> Tensor:
    """How far behind each vertex log-odds are largest, before they fall by 1 from there.

    Args:
        model: anything with ``log_odds(points)``.
        vertices: (V, D) world positions [m].
        normals: (V, D) of length 1, into free space.
        thickness: (V,) standard deviation of the surface across itself [m].

    Returns:
        (V,) depths against the normals [m]; NaN where log-odds rise all the way to `REACH` standard
        deviations, or not at all.
    """
    numbers = torch.arange(STEPS + 1, device=vertices.device)[:, None, None]
    strides = thickness * (REACH / STEPS)
    found = []
    for start, step in zip(
        vertices.split(CHUNK_VERTICES),
        (normals * strides[:, None]).split(CHUNK_VERTICES),
        strict=True,
    ):
        found.append(_first_top(model.log_odds(start - numbers * step).double()))
    return torch.cat(found) * strides


def _first_top(values: Tensor) -> Tensor:
    """(S, V) values at equal steps -> (V,) where their first top is, in steps; NaN if at an end.

    Between steps it is the top of the parabola through three of them.
    """
    highest = values.cummax(dim=0)
    fallen = values < highest.values - EVIDENCE
    last = len(values) - 1
    end = torch.where(fallen.any(dim=0), fallen.to(torch.uint8).argmax(dim=0), last)
    top = highest.indices.gather(0, end[None]).squeeze(0)
    around = top.clamp(1, last - 1) + torch.arange(-1, 2, device=top.device)[:, None]
    before, here, after = values.gather(0, around)
    bend = before - 2 * here + after
    shift = torch.where(bend < 0, 0.5 * (before - after) / bend, 0.0).clamp(-1.0, 1.0)
    return torch.where((top > 0) & (top < last), top + shift, torch.nan)


def mean_with_neighbors(values: Tensor, faces: Tensor) -> Tensor:
    """(V,) mean of each vertex's value and those of its neighbors in (F, 3) faces; NaN do not count.

    NaN only where there is no value at all.
    """
    known = ~values.isnan()
    sums, counts = torch.where(known, values, 0.0), known.to(values.dtype)
    first, second = _edges(faces)
    ends, others = torch.cat([first, second]), torch.cat([second, first])
    return sums.index_add(0, ends, sums[others]) / counts.index_add(0, ends, counts[others])


def _edges(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends of each edge, once."""
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    low, high = pairs.unbind(dim=1)
    keys = (low * (int(faces.max()) + 1) + high).unique()  # many times faster than unique rows
    return keys // (int(faces.max()) + 1), keys % (int(faces.max()) + 1)
