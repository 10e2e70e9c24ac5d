"""Surface meshes: marching cubes in blocks, removal of unsupported faces, ridge refinement."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, log_odds_variance, pieces, to_tensor
from lardhm_torch.queries.grids import (
    EVIDENCE,
    SURFACES,
    cluster_boxes,
    grid_axes,
    lattice_values,
    nearest_support,
    threshold_log_odds,
)
from lardhm_torch.surfaces.ridge import CHUNK_VERTICES, mesh_on_ridge
from lardhm_torch.surfaces.vertex_colors import COLORS, vertex_colors

if TYPE_CHECKING:
    import trimesh

BLOCK_CELLS = 24  # cells along a block's edge
PROBES = (1.0, 2.0, 3.0)  # standard deviations in front of and behind a vertex, where it is tested


def extract_mesh(
    model: OccupancyMap,
    resolution: float = 0.05,
    threshold: float = 0.5,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    *,
    surface: str = "peak",
    color: str | None = "height",
    evidence: float | None = EVIDENCE,
    progress: bool = False,
) -> trimesh.Trimesh:
    """Surface mesh of occupied space; normals point into free space.

    Marching cubes find the level set of the log-odds at the threshold, in blocks; only blocks near
    a supporting cluster are evaluated. Supporting clusters have positive weights for a threshold of
    1/2 or more, and negative ones below. Then

    - ``surface="peak"`` moves every vertex to the ridge of the log-odds behind it, where the hits
      lie, and removes faces whose corners have no common ridge (`ridge.mesh_on_ridge`). Both faces
      of an object thinner than the kernels meet in its middle.
    - ``surface="crossing"`` keeps the level set. At 1/2 it lies 5 to 10 cm in front of the surface,
      because free space is learned only up to some centimeters before the hits. It encloses
      everything occupied, which is conservative for a robot.

    Where measurements end, the kernels of both classes fade and the log-odds vary around 0, so the
    level set at 1/2 has sheets in unmeasured space and backs of walls. A face is therefore kept
    only if the map is certain on both sides of each vertex: within three standard deviations of the
    nearest supporting cluster (its smallest), the log-odds exceed those of the threshold by
    ``evidence`` behind the vertex, and fall below them by as much in front. This rule does not
    depend on the resolution.

    Args:
        model: a 3-D map.
        resolution: edge of a lattice cell [m]. With cells much larger than the thickness of a
            surface (standard deviation of its clusters across it), the mesh has holes.
        threshold: space with a higher probability is occupied, between 0 and 1.
        bounds: lower and upper corner of the part to mesh, world frame [m]; None: all of the map.
        surface: "peak" or "crossing", as for `raycast`.
        color: of the vertices: "height", "cluster" (one color for each nearest supporting
            cluster), "probability" (at the center of that cluster), "variance" (of the log-odds,
            dark where certain; needs `LardHilbertMap.fit_uncertainty`), or None.
        evidence: log-odds required on both sides of a face, see above; None keeps all faces.
        progress: show a progress bar.

    Returns:
        Mesh in world coordinates [m]; without faces if the map has no such surface.

    Raises:
        ValueError: the map is not 3-D or is empty, or an argument is outside its range.
        RuntimeError: color is "variance" and the posterior of the map has not been computed.

    Source: Guizilini & Ramos 2016, Section IV (marching cubes, colors of the nearest cluster).
    """
    _check_meshing(model, resolution, threshold, evidence)
    for name, value, allowed in (("surface", surface, SURFACES), ("color", color, (*COLORS, None))):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(map(str, allowed))}; got {value!r}")
    if color == "variance":
        log_odds_variance(model, model.origin[None])  # raises now rather than after minutes
    lattice = surface_lattice(model, resolution, threshold, bounds, progress=progress)
    return lattice_mesh(model, lattice, threshold, surface=surface, color=color, evidence=evidence)


class SurfaceLattice(NamedTuple):
    """Log-odds on the blocks of a lattice that may contain the surface.

    ``corner`` (3,) lower corner, world frame [m]; ``resolution`` [m]; ``cells`` (3,) number of
    cells; ``blocks`` pairs of first cell (3,) and log-odds (n + 1, n + 1, n + 1): a generator, or a
    list that can be used again.
    """

    corner: Tensor
    resolution: float
    cells: Tensor
    blocks: Iterable[tuple[Tensor, np.ndarray]]


def surface_lattice(
    model: OccupancyMap,
    resolution: float,
    threshold: float = 0.5,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    *,
    keep: bool = False,
    progress: bool = False,
) -> SurfaceLattice:
    """Log-odds for `lattice_mesh`, valid for all thresholds on the same side of 1/2.

    ``keep`` stores the blocks in a list; the other arguments are those of `extract_mesh`.
    """
    lower, upper = (box.cpu() for box in cluster_boxes(model, _sign(threshold)))
    if bounds is not None:
        corner, end = (to_tensor(b, "bounds").cpu() for b in bounds)
        if len(grid_axes(corner, end, resolution)) != 3:
            raise ValueError(f"bounds must have 3 coordinates; got {len(corner)}")
        touching = ((upper >= corner) & (lower <= end)).all(dim=1)
        lower, upper = lower[touching].maximum(corner), upper[touching].minimum(end)
    if len(lower) == 0:
        return SurfaceLattice(torch.zeros(3).double(), resolution, torch.ones(3), [])
    if bounds is None:
        corner = lower.amin(dim=0)
        end = upper.amax(dim=0) + resolution  # whole cells cover the boxes
    cells = ((end - corner) / resolution + 1e-6).floor().long().clamp(min=1)
    active = active_blocks((lower - corner) / resolution, (upper - corner) / resolution, cells)
    blocks = _block_values(model, corner, resolution, active, cells, progress)
    return SurfaceLattice(corner, resolution, cells, list(blocks) if keep else blocks)


def lattice_mesh(
    model: OccupancyMap,
    lattice: SurfaceLattice,
    threshold: float = 0.5,
    *,
    surface: str = "peak",
    color: str | None = "height",
    evidence: float | None = EVIDENCE,
) -> trimesh.Trimesh:
    """As `extract_mesh`, from the lattice of this map and this side of 1/2."""
    import trimesh

    level = threshold_log_odds(threshold)
    vertices, faces = _march_blocks(lattice.blocks, level)
    world = vertices * lattice.resolution + lattice.corner.numpy()
    mesh = trimesh.Trimesh(world, faces, process=False)
    if len(faces) and evidence is not None:
        supported = _is_supported(model, mesh, _sign(threshold), level, evidence)
        mesh.update_faces(supported[faces].all(axis=1))
        mesh.remove_unreferenced_vertices()
    if len(mesh.faces) and surface == "peak":
        mesh = mesh_on_ridge(model, mesh, lattice.resolution)
    colors = vertex_colors(model, mesh.vertices, _sign(threshold), color)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)


def _check_meshing(
    model: OccupancyMap, resolution: float, threshold: float, evidence: float | None
) -> None:
    if model.dim != 3:
        raise ValueError(
            f"a mesh needs a 3-D map; got {model.dim}-D. For 2-D use query_slice or query_grid"
        )
    if not any(len(piece.centers) for piece in pieces(model)):
        raise ValueError("the map must hold clusters to have a surface; it is empty: fit it first")
    if not (resolution > 0 and math.isfinite(resolution)):
        raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
    threshold_log_odds(threshold)  # raises
    if evidence is not None and not evidence >= 0:
        raise ValueError(f"evidence must be >= 0, or None to keep all faces; got {evidence}")


def active_blocks(lower: Tensor, upper: Tensor, cells: Tensor) -> Tensor:
    """Blocks that any of N boxes touches.

    Args:
        lower: (N, 3) lower corners, in cells from the corner of the lattice.
        upper: (N, 3) upper corners.
        cells: (3,) number of cells of the lattice.

    Returns:
        (B, 3) block indices, ascending.
    """
    last_block = (cells - 1) // BLOCK_CELLS
    first = (lower / BLOCK_CELLS).floor().long().clamp(min=0).minimum(last_block)
    last = (upper / BLOCK_CELLS).floor().long().clamp(min=0).minimum(last_block)
    found = []
    for offset in itertools.product(*(range(int(n) + 1) for n in (last - first).amax(dim=0))):
        block = first + torch.tensor(offset)
        found.append(block[(block <= last).all(dim=1)].unique(dim=0))
    return torch.cat(found).unique(dim=0)


@torch.no_grad()
def _block_values(
    model: OccupancyMap,
    corner: Tensor,
    resolution: float,
    blocks: Tensor,
    cells: Tensor,
    progress: bool,
) -> Iterator[tuple[Tensor, np.ndarray]]:
    """First cell (3,) and log-odds of every block, cut at the end of the lattice."""
    from tqdm import tqdm

    device = model.origin.device
    for block in tqdm(blocks, desc="mesh", disable=None if progress else True):
        first_cell = block * BLOCK_CELLS
        last_cell = (first_cell + BLOCK_CELLS).minimum(cells)
        axes = [
            (start + resolution * torch.arange(int(first), int(last) + 1, dtype=torch.float64)).to(
                device
            )
            for start, first, last in zip(corner, first_cell, last_cell, strict=True)
        ]
        yield first_cell, lattice_values(model, axes, probability=False).float().cpu().numpy()


def _march_blocks(
    blocks: Iterable[tuple[Tensor, np.ndarray]], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in cells from the corner, and faces (F, 3) of all blocks, welded."""
    parts, num_vertices = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))], 0
    for first_cell, values in blocks:
        vertices, faces = _march(values, level)
        parts.append((vertices + first_cell.numpy(), faces + num_vertices))
        num_vertices += len(vertices)
    return _weld(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))


def _march(values: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes on one block: vertices in cells from its corner, and faces.

    The gradient points into obstacles; "ascent" makes the normals point into free space.
    """
    from skimage.measure import marching_cubes

    if not values.min() < level < values.max():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    vertices, faces, _, _ = marching_cubes(
        values, level, gradient_direction="ascent", allow_degenerate=False
    )
    return vertices.astype(np.float64), faces.astype(np.int64)


def _weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at the same position.

    Neighboring blocks share a lattice plane and have exactly the same vertices on it. Only vertices
    on such planes can be duplicates, so only those are sorted.
    """
    seam = np.flatnonzero((vertices % BLOCK_CELLS == 0).any(axis=1))
    _, first, inverse = np.unique(vertices[seam], axis=0, return_index=True, return_inverse=True)
    owner = np.arange(len(vertices))
    owner[seam] = seam[first[inverse.reshape(-1)]]
    kept, index = np.unique(owner, return_inverse=True)
    faces = index.reshape(-1)[faces]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return vertices[kept], faces[~collapsed]


def _sign(threshold: float) -> int:
    """Sign of the weights that support a surface at this threshold."""
    return 1 if threshold >= 0.5 else -1


@torch.no_grad()
def _is_supported(
    model: OccupancyMap, mesh: trimesh.Trimesh, sign: int, level: float, evidence: float
) -> np.ndarray:
    """(V,) whether log-odds are clearly above the level behind each vertex, clearly below before."""
    device = model.origin.device
    vertices = torch.as_tensor(np.array(mesh.vertices), device=device)
    normals = torch.as_tensor(np.array(mesh.vertex_normals), device=device)
    steps = normals * nearest_support(model, vertices, sign).thickness[:, None]
    depths = torch.tensor(PROBES, dtype=torch.float64, device=device)[:, None, None]
    supported = []
    for start, step in zip(
        vertices.split(CHUNK_VERTICES), steps.split(CHUNK_VERTICES), strict=True
    ):
        in_front = model.log_odds(start + depths * step).amin(dim=0)
        behind = model.log_odds(start - depths * step).amax(dim=0)
        supported.append((in_front < level - evidence) & (behind > level + evidence))
    return torch.cat(supported).cpu().numpy()
