"""Maps to surfaces: marching cubes in blocks, faces that data supports, moved to where hits lie."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.queries.grids import (
    EVIDENCE,
    SURFACES,
    cluster_boxes,
    grid_axes,
    lattice_values,
    nearest_support,
    pieces,
)
from lardhm_torch.surfaces.ridge import CHUNK_VERTICES, mesh_on_ridge
from lardhm_torch.surfaces.vertex_colors import COLORS, vertex_colors

if TYPE_CHECKING:
    import trimesh

BLOCK_CELLS = 24  # cells along a block's edge
PROBES = (1.0, 2.0, 3.0)  # standard deviations before and behind a face where evidence is sought


def extract_mesh(
    model: Any,
    resolution: float = 0.05,
    threshold: float = 0.5,
    bounds: tuple[Any, Any] | None = None,
    *,
    surface: str = "peak",
    color: str | None = "height",
    evidence: float | None = EVIDENCE,
    progress: bool = False,
) -> trimesh.Trimesh:
    """The surface of what is occupied, normals into free space.

    Marching cubes on the log-odds find where the probability equals the threshold, in blocks of
    which only those near a supporting cluster are evaluated. Supporting are the clusters that pull
    away from 1/2 to the threshold's side: positive weights for a threshold of 1/2 or more, negative
    ones below. Then

    - ``surface="peak"`` moves every vertex to the ridge of the log-odds behind it, where the hits
      lie, and leaves out faces that no one ridge is behind (`ridge.mesh_on_ridge`). Both faces of
      a thing thinner than the kernels meet in the middle of it.
    - ``surface="crossing"`` leaves it where the probability equals the threshold. At 1/2 this is
      5 to 10 cm in front of the surface, because free space is learned only up to some centimeters
      before the hits: closed around everything occupied, and on the safe side for a robot.

    Where data ends, both classes' tails vanish and log-odds wander around 0, so the level set at 1/2
    has sheets there, and backs of walls, that nothing was measured for. A face is kept only if the
    map is sure on both sides of it: within three standard deviations of the nearest supporting
    cluster (its smallest), log-odds exceed the threshold's by ``evidence`` behind each vertex and
    fall short of it by as much in front. The rule has no unit and holds at every resolution.

    Args:
        model: a 3-D map.
        resolution: edge of a lattice cell [m]. Through cells much larger than a surface is thick
            (standard deviation of its clusters across it), it slips and is left with holes.
        threshold: occupied is what exceeds this probability, between 0 and 1.
        bounds: lower and upper corner of the part to mesh, world frame [m]; left out: all of it.
        surface: "peak" or "crossing", as for `rays.raycast`.
        color: of the vertices: "height", "cluster" (one color for each nearest supporting
            cluster), "probability" (at the center of that cluster), or None.
        evidence: log-odds on both sides of a face, see above; None keeps all faces.
        progress: show a progress bar.

    Returns:
        Mesh in world coordinates; without faces where the map crosses the threshold nowhere.

    Raises:
        ValueError: the map is not 3-D or is empty, or an argument is not in its range.

    Source: Guizilini & Ramos 2016, Section IV (marching cubes, colors of the nearest cluster).
    """
    _check_meshing(model, resolution, threshold, evidence)
    for name, value, known in (("surface", surface, SURFACES), ("color", color, (*COLORS, None))):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(map(str, known))}; got {value!r}")
    lattice = surface_lattice(model, resolution, threshold, bounds, progress=progress)
    return lattice_mesh(model, lattice, threshold, surface=surface, color=color, evidence=evidence)


class SurfaceLattice(NamedTuple):
    """Log-odds on the blocks of a lattice in which a surface may lie.

    ``corner`` (3,) world [m], ``resolution`` [m], ``cells`` (3,) number of cells, and the blocks as
    pairs of the first cell (3,) and values (n + 1, n + 1, n + 1); a generator, unless ``keep`` made
    it a list to march again.
    """

    corner: Tensor
    resolution: float
    cells: Tensor
    blocks: Iterable[tuple[Tensor, np.ndarray]]


def surface_lattice(
    model: Any,
    resolution: float,
    threshold: float = 0.5,
    bounds: tuple[Any, Any] | None = None,
    *,
    keep: bool = False,
    progress: bool = False,
) -> SurfaceLattice:
    """What `lattice_mesh` marches on: good for all thresholds on the same side of 1/2."""
    lower, upper = (box.cpu() for box in cluster_boxes(model, _side(threshold)))
    if bounds is not None:
        corner, end = (torch.as_tensor(b, dtype=torch.float64).cpu() for b in bounds)
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
    model: Any,
    lattice: SurfaceLattice,
    threshold: float = 0.5,
    *,
    surface: str = "peak",
    color: str | None = "height",
    evidence: float | None = EVIDENCE,
) -> trimesh.Trimesh:
    """As `extract_mesh`, on a lattice that was made for this map and this side of 1/2."""
    import trimesh

    level = math.log(threshold / (1 - threshold))
    vertices, faces = _march_blocks(lattice.blocks, level)
    world = vertices * lattice.resolution + lattice.corner.numpy()
    mesh = trimesh.Trimesh(world, faces, process=False)
    if len(faces) and evidence is not None:
        seen = _has_evidence(model, mesh, _side(threshold), level, evidence)
        mesh.update_faces(seen[faces].all(axis=1))
        mesh.remove_unreferenced_vertices()
    if len(mesh.faces) and surface == "peak":
        mesh = mesh_on_ridge(model, mesh, lattice.resolution)
    colors = vertex_colors(model, mesh.vertices, _side(threshold), color)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)


def _check_meshing(model: Any, resolution: float, threshold: float, evidence: float | None) -> None:
    if model.dim != 3:
        raise ValueError(
            f"a mesh needs a 3-D map; got {model.dim}-D. For 2-D use query_slice or query_grid"
        )
    if not any(len(piece.centers) for piece in pieces(model)):
        raise ValueError("the map must hold clusters to have a surface; it is empty: fit it first")
    if not (resolution > 0 and math.isfinite(resolution)):
        raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
    if not 0 < threshold < 1:
        raise ValueError(f"threshold must be between 0 and 1, both excluded; got {threshold}")
    if evidence is not None and not evidence >= 0:
        raise ValueError(f"evidence must be >= 0, or None to keep all faces; got {evidence}")


def active_blocks(lower: Tensor, upper: Tensor, cells: Tensor) -> Tensor:
    """(B, 3) numbers of the blocks that some box touches, ascending; boxes in cells from the corner."""
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
    model: Any, corner: Tensor, resolution: float, blocks: Tensor, cells: Tensor, progress: bool
) -> Iterator[tuple[Tensor, np.ndarray]]:
    """First cell (3,) and log-odds of every block, those inside the bounds."""
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
    """Vertices (V, 3), in cells from the corner, and faces (F, 3) of all blocks, joined at seams."""
    parts, num_vertices = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))], 0
    for first_cell, values in blocks:
        vertices, faces = _march(values, level)
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
    """One vertex for each position: blocks share lattice planes and agree on them to the last bit.

    Only vertices on a plane between blocks can have a twin; those alone are sorted.
    """
    seam = np.flatnonzero((vertices % BLOCK_CELLS == 0).any(axis=1))
    _, first, twin = np.unique(vertices[seam], axis=0, return_index=True, return_inverse=True)
    owner = np.arange(len(vertices))
    owner[seam] = seam[first[twin.reshape(-1)]]
    kept, index = np.unique(owner, return_inverse=True)
    faces = index.reshape(-1)[faces]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return vertices[kept], faces[~collapsed]


def _side(threshold: float) -> int:
    """Sign of the weights that pull away from 1/2 to the threshold's side."""
    return 1 if threshold >= 0.5 else -1


@torch.no_grad()
def _has_evidence(
    model: Any, mesh: trimesh.Trimesh, side: int, level: float, evidence: float
) -> np.ndarray:
    """(V,) whether log-odds are clearly above the level behind a vertex and clearly below in front."""
    device = model.origin.device
    vertices = torch.as_tensor(np.array(mesh.vertices), device=device)
    normals = torch.as_tensor(np.array(mesh.vertex_normals), device=device)
    steps = normals * nearest_support(model, vertices, side).thickness[:, None]
    depths = torch.tensor(PROBES, dtype=torch.float64, device=device)[:, None, None]
    result = []
    for start, step in zip(
        vertices.split(CHUNK_VERTICES), steps.split(CHUNK_VERTICES), strict=True
    ):
        in_front = model.log_odds(start + depths * step).amin(dim=0)
        behind = model.log_odds(start - depths * step).amax(dim=0)
        result.append((in_front < level - evidence) & (behind > level + evidence))
    return torch.cat(result).cpu().numpy()
