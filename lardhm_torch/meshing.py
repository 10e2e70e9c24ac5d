"""Maps to surfaces: marching cubes in blocks, faces that data supports, colored vertices."""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.features import nearest_centers
from lardhm_torch.querying import BLOCK_POINTS, cluster_boxes, occupancy_gradient

if TYPE_CHECKING:
    import trimesh

BLOCK_CELLS = 24  # cells along a block's edge
MIN_SLOPE = 0.5  # change of log-odds over one standard deviation that makes a surface
COLORS = ("height", "cluster", "probability")
MESH_SUFFIXES = (".glb", ".obj", ".off", ".ply", ".stl")


def extract_mesh(
    model: Any,
    resolution: float = 0.05,
    threshold: float = 0.5,
    bounds: tuple[Any, Any] | None = None,
    *,
    color: str | None = "height",
    min_slope: float = MIN_SLOPE,
    progress: bool = False,
) -> trimesh.Trimesh:
    """The surface on which the map's probability equals a threshold, normals into free space.

    Marching cubes on the log-odds, in blocks of which only those near a supporting cluster are
    evaluated. Supporting are the clusters that pull away from 1/2 to the threshold's side: positive
    weights for a threshold of 1/2 or more, negative ones below.

    Where data ends, both classes' tails vanish and log-odds wander around 0, so the level set at 1/2
    has sheets there that nothing was measured for. They are told by their slope: a face is kept only
    if, at its vertices, log-odds change by at least ``min_slope`` over one standard deviation of the
    nearest supporting cluster (its smallest). A measured surface changes by several; the rule has
    no unit and holds at every resolution.

    Args:
        model: a 3-D map.
        resolution: edge of a lattice cell [m].
        threshold: probability of occupancy on the surface, between 0 and 1.
        bounds: lower and upper corner of the part to mesh, world frame [m]; left out: all of it.
        color: of the vertices: "height", "cluster" (one color for each nearest supporting
            cluster), "probability" (at the center of that cluster), or None.
        min_slope: change of log-odds over one standard deviation at a surface; 0 keeps all faces.
        progress: show a progress bar.

    Returns:
        Mesh in world coordinates; without faces where the map crosses the threshold nowhere.

    Raises:
        ValueError: the map is not 3-D or is empty, or an argument is not in its range.

    Source: Guizilini & Ramos 2016, Section IV (marching cubes, colors of the nearest cluster).
    """
    _check_meshing(model, resolution, threshold, color, min_slope)
    level = math.log(threshold / (1 - threshold))
    supporters = ((model.weights > 0) if level >= 0 else (model.weights < 0)).nonzero().squeeze(1)
    lower, upper = (box[supporters].cpu() for box in cluster_boxes(model))
    if bounds is not None:
        start, end = (torch.as_tensor(b, dtype=torch.float64).cpu() for b in bounds)
        touching = ((upper >= start) & (lower <= end)).all(dim=1)
        lower, upper = lower[touching].maximum(start), upper[touching].minimum(end)
    if len(lower) == 0:
        return _to_mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    corner = lower.amin(dim=0) if bounds is None else start
    cells = ((upper.amax(dim=0) - corner) / resolution + 1e-6).floor().long().clamp(min=1)
    blocks = _active_blocks((lower - corner) / resolution, (upper - corner) / resolution, cells)
    vertices, faces = _march_blocks(model, corner, resolution, blocks, cells, level, progress)
    world = vertices * resolution + corner.numpy()
    nearest, slope = _nearest_supporter(model, supporters, world)
    faces = faces[(slope >= min_slope)[faces].all(axis=1)]
    mesh = _to_mesh(world, faces, _vertex_colors(model, world, nearest, color))
    mesh.remove_unreferenced_vertices()
    return mesh


def save_mesh(mesh: trimesh.Trimesh, path: str | Path) -> None:
    """Write a mesh, its format chosen by the extension; an existing file is replaced at the end.

    Raises:
        ValueError: the extension is not one of .glb, .obj, .off, .ply, .stl.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        known = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"path must end in one of {known} for a mesh; got {path.name!r}")
    partial = path.with_name(f".{path.name}.partial{path.suffix}")
    try:
        mesh.export(partial, file_type=path.suffix[1:].lower())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _check_meshing(
    model: Any, resolution: float, threshold: float, color: str | None, min_slope: float
) -> None:
    if model.dim != 3:
        raise ValueError(
            f"a mesh needs a 3-D map; got {model.dim}-D. For 2-D use query_slice or query_grid"
        )
    if len(model.centers) == 0:
        raise ValueError("the map must hold clusters to have a surface; it is empty: fit it first")
    if not (resolution > 0 and math.isfinite(resolution)):
        raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
    if not 0 < threshold < 1:
        raise ValueError(f"threshold must be between 0 and 1, both excluded; got {threshold}")
    if color is not None and color not in COLORS:
        raise ValueError(f"color must be one of {', '.join(COLORS)}, or None; got {color!r}")
    if not min_slope >= 0:
        raise ValueError(f"min_slope must be >= 0; got {min_slope}")


def _active_blocks(lower: Tensor, upper: Tensor, cells: Tensor) -> Tensor:
    """(B, 3) numbers of the blocks that some box touches, ascending; boxes in cells from the corner."""
    last_block = (cells - 1) // BLOCK_CELLS
    first = (lower / BLOCK_CELLS).floor().long().clamp(min=0).minimum(last_block)
    last = (upper / BLOCK_CELLS).floor().long().clamp(min=0).minimum(last_block)
    found = []
    for offset in itertools.product(*(range(int(n) + 1) for n in (last - first).amax(dim=0))):
        block = first + torch.tensor(offset)
        found.append(block[(block <= last).all(dim=1)].unique(dim=0))
    return torch.cat(found).unique(dim=0)


def _march_blocks(
    model: Any,
    corner: Tensor,
    resolution: float,
    blocks: Tensor,
    cells: Tensor,
    level: float,
    progress: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in cells from the corner, and faces (F, 3) of all blocks, joined at seams."""
    from tqdm import tqdm

    local = torch.stack(torch.meshgrid(*[torch.arange(BLOCK_CELLS + 1)] * 3, indexing="ij"), dim=-1)
    parts, num_vertices = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))], 0
    batches = blocks.split(max(1, BLOCK_POINTS // local[..., 0].numel()))
    for batch in tqdm(batches, desc="mesh", disable=None if progress else True):
        first_cells = batch * BLOCK_CELLS  # (B, 3)
        points = corner + resolution * (first_cells[:, None, None, None] + local)
        with torch.no_grad():
            log_odds = model.log_odds(points.to(model.centers.device)).float().cpu().numpy()
        for first_cell, values in zip(first_cells, log_odds, strict=True):
            n = (cells - first_cell).clamp(max=BLOCK_CELLS) + 1  # lattice planes inside the bounds
            vertices, faces = _march(values[: n[0], : n[1], : n[2]], level)
            parts.append((vertices + first_cell.numpy(), faces + num_vertices))
            num_vertices += len(vertices)
    return _join(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))


def _march(values: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes on one block: vertices in cells from its corner, and faces.

    The gradient points into obstacles, so "ascent" turns the faces toward free space.
    """
    from skimage.measure import marching_cubes

    if not values.min() < level < values.max():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    vertices, faces, _, _ = marching_cubes(
        values, level, gradient_direction="ascent", allow_degenerate=False
    )
    return vertices.astype(np.float64), faces.astype(np.int64)


def _join(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One vertex for each position: blocks share lattice planes and agree on them to the last bit."""
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return unique, faces[~collapsed]


def _nearest_supporter(
    model: Any, supporters: Tensor, world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(V,) nearest supporting cluster, and (V,) change of log-odds over its standard deviation."""
    points = torch.as_tensor(world, device=model.centers.device)
    centers = model.centers.detach()[supporters]
    thickness = torch.linalg.svdvals(model.scale_tril.detach()[supporters].double())[:, -1]
    nearest, slopes = [], []
    for chunk in points.split(BLOCK_POINTS // 4):
        local = (chunk - model.origin).to(centers.dtype)
        nearest.append(nearest_centers(local, centers, 1).squeeze(1))
        gradient = occupancy_gradient(model, chunk)
        slopes.append(torch.linalg.vector_norm(gradient, dim=1) * thickness[nearest[-1]])
    return supporters[torch.cat(nearest)].cpu().numpy(), torch.cat(slopes).cpu().numpy()


def _vertex_colors(
    model: Any, world: np.ndarray, nearest: np.ndarray, color: str | None
) -> np.ndarray | None:
    """(V, 4) RGBA of the vertices, or None for no colors."""
    from matplotlib import colormaps

    if color is None or len(world) == 0:
        return None
    if color == "cluster":
        return colormaps["tab20"](nearest * 7 % 20, bytes=True)
    if color == "probability":
        with torch.no_grad():
            at_centers = model(model.centers.double() + model.origin).cpu().numpy()
        return colormaps["viridis"](2 * at_centers[nearest] - 1, bytes=True)
    low, high = np.quantile(world[:, 2], [0.01, 0.99])  # a few stray faces shall not set the scale
    return colormaps["viridis"]((world[:, 2] - low) / max(high - low, 1e-9), bytes=True)


def _to_mesh(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None
) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
