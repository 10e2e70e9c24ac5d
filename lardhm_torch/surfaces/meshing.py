"""Surface meshes: a level set followed by marching cubes, and moved to the ridge of the log-odds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from lardhm_torch.channels import CLASS
from lardhm_torch.maps import (
    OccupancyMap,
    TensorLike,
    channel_names,
    log_odds_variance,
    pieces,
    reads_copy,
    to_tensor,
)
from lardhm_torch.queries.grids import (
    LOG_ODDS_MARGIN,
    SURFACES,
    cluster_boxes,
    grid_axes,
    threshold_log_odds,
)
from lardhm_torch.surfaces.channel_colors import UNKNOWN_COLOR, class_labels, label_colors
from lardhm_torch.surfaces.closing import closed_sheet
from lardhm_torch.surfaces.estimate import check_mesh_memory, estimate_mesh
from lardhm_torch.surfaces.following import Rule, Sheet, follow_surface, seed_blocks
from lardhm_torch.surfaces.lattice import BLOCK_CELLS, Lattice, blocks_near_boxes, border_blocks
from lardhm_torch.surfaces.ridge import sheet_on_ridge
from lardhm_torch.surfaces.vertex_colors import COLORS, vertex_colors

if TYPE_CHECKING:
    import trimesh

RIM = 3  # cells around a part: a vertex moves by the means of its neighbors and of theirs


@reads_copy
def extract_mesh(
    model: OccupancyMap,
    resolution: float = 0.05,
    threshold: float = 0.5,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    *,
    surface: str = "peak",
    color: str | None = "height",
    log_odds_margin: float | None = LOG_ODDS_MARGIN,
    watertight: bool = False,
    progress: bool = False,
) -> trimesh.Trimesh:
    """Surface mesh of occupied space; normals point into free space.

    A level set of the log-odds is followed from block to block by marching cubes, beginning near the
    supporting clusters: those with positive weights for a threshold of 1/2 or more, with negative ones
    below. Time and memory grow with the surface.

    - ``surface="peak"`` follows the border of known free space, ``log_odds_margin`` below the threshold,
      and moves every vertex to the ridge of the log-odds behind it, where the hits lie and `raycast`
      ends. It removes faces whose corners have no common ridge (`ridge.sheet_on_ridge`). Both faces of
      an object thinner than the kernels meet in its middle.
    - ``surface="crossing"`` is the level set at the threshold. At 1/2 it lies 5 to 10 cm in front of the
      surface, because free space is learned only up to some centimeters before the hits. It encloses
      everything occupied, which is conservative for a robot.

    A face is kept only if there is measured occupied space behind it, by the margin of `raycast`, and
    free space in front of it, three margins below the threshold or twice as far below it as the space
    beyond the surface (`following.follow_surface`). Without this rule, there would be faces in unmeasured
    space, where the log-odds vary around 0, and on the backs of walls. The rule does not depend on the
    resolution.

    A mesh of measured surfaces is open where nothing was measured. With ``watertight``, it is the whole
    boundary of the space known to be free (by one margin), which counts everything else as occupied and
    ends at the bounds: two faces at each edge, normals to the inside. Where there is no measured surface,
    it closes the gap. Vertices there are gray, and 1 in the vertex attribute "closing" (0 elsewhere).

    Args:
        model: a 3-D map.
        resolution: edge of a lattice cell [m]. Objects with free space on both sides that are much
            thinner than a cell get holes.
        threshold: space with a higher probability is occupied, between 0 and 1.
        bounds: lower and upper corner of the part to mesh, world frame [m]; None: all of the map.
        surface: "peak" or "crossing", as for `raycast`.
        color: of the vertices: "height", "cluster" (one color for each nearest supporting
            cluster), "probability" (at the center of that cluster), "variance" (of the log-odds,
            dark where certain; needs `LardHilbertMap.fit_uncertainty`), the name of a channel of the
            map ("color", "intensity", "class", ...; gray where it is unknown), or None. Meshes
            colored by class have the class numbers as vertex attribute "label", -1 where unknown.
            `save_mesh` writes vertex attributes to .ply.
        log_odds_margin: required on both sides of a face, see above; None keeps all faces, which takes
            time and memory in proportion to the volume.
        watertight: close the surface where nothing was measured, see above.
        progress: show a progress bar.

    Returns:
        Mesh in world coordinates [m]; without faces if the map has no such surface.

    Raises:
        ValueError: the map is not 3-D or is empty, an argument is outside its range, or the mesh would
            not fit in memory.
        RuntimeError: color is "variance" and the posterior of the map has not been computed.

    Source: Guizilini & Ramos 2016, Section IV (marching cubes, colors of the nearest cluster).
    """
    _check_meshing(model, resolution, threshold, log_odds_margin)
    if watertight:
        _check_watertight(threshold, log_odds_margin)
    colors = (*COLORS, *channel_names(model), None)
    for name, value, allowed in (("surface", surface, SURFACES), ("color", color, colors)):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(map(str, allowed))}; got {value!r}")
    if color == "variance":
        log_odds_variance(model, model.origin[None])  # raises now rather than after minutes
    lattice = surface_lattice(model, resolution, threshold, bounds, watertight=watertight)
    return lattice_mesh(
        model,
        lattice,
        threshold,
        surface=surface,
        color=color,
        log_odds_margin=log_odds_margin,
        watertight=watertight,
        progress=progress,
    )


def surface_lattice(
    model: OccupancyMap,
    resolution: float,
    threshold: float = 0.5,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    *,
    keep: bool = False,
    watertight: bool = False,
) -> Lattice | None:
    """Lattice for `lattice_mesh`, valid for all thresholds on the same side of 1/2.

    Its points are whole multiples of the resolution and its blocks are at multiples of their edge.
    Around a part of the map, it has `RIM` more cells or more, so vertices at the bounds are where they
    are in the mesh of the whole map: parts that are meshed one by one fit together. ``keep`` keeps its
    log-odds for further thresholds; the other arguments are those of `extract_mesh`.

    Returns:
        The lattice; None if no supporting cluster is near the bounds.
    """
    sign, corners = -1 if watertight else _sign(threshold), None
    if bounds is not None:
        corner, end = (to_tensor(b, "bounds").cpu() for b in bounds)
        corners = corner, end
        if len(grid_axes(corner, end, resolution)) != 3:
            raise ValueError(f"bounds must have 3 coordinates; got {len(corner)}")
    lower, upper = (box.cpu().numpy() for box in cluster_boxes(model, sign, corners))
    if corners is not None:
        low, high = (end.numpy() for end in corners)
        touching = ((upper >= low) & (lower <= high)).all(axis=1)
        lower, upper = lower[touching], upper[touching]
    if len(lower) == 0:
        return None
    expected = estimate_mesh(model, resolution, corners, _sign(threshold), watertight=watertight)
    check_mesh_memory(resolution, expected)
    core = None
    if bounds is None:
        first = np.floor(lower.min(axis=0) / resolution)
        last = np.ceil(upper.max(axis=0) / resolution)
    else:
        first, last = np.round(low / resolution), np.round(high / resolution)
        core = np.stack([first, np.maximum(last, first + 1)]).astype(np.int64)
    if not watertight:  # blocks are the same in all parts of a map
        first = np.floor((first - RIM) / BLOCK_CELLS) * BLOCK_CELLS
        last = np.ceil((last + RIM) / BLOCK_CELLS) * BLOCK_CELLS
    cells = (last - first).clip(min=1).astype(np.int64)
    return Lattice(first.astype(np.int64), cells, resolution, keep=keep, core=core)


def lattice_mesh(
    model: OccupancyMap,
    lattice: Lattice | None,
    threshold: float = 0.5,
    *,
    surface: str = "peak",
    color: str | None = "height",
    log_odds_margin: float | None = LOG_ODDS_MARGIN,
    watertight: bool = False,
    progress: bool = False,
    report: Callable[[int], object] = lambda _: None,
) -> trimesh.Trimesh:
    """As `extract_mesh`, on the lattice of this map and this side of 1/2.

    ``report`` is called with the number of new faces now and then; what it raises ends the work.
    """
    import trimesh
    from tqdm import tqdm

    if lattice is None:
        return trimesh.Trimesh(process=False)
    sign, on_ridge = _sign(threshold), surface == "peak"
    bounds = lattice.bounds if lattice.is_cut else None
    bar: dict[str, Any] = {"unit": " faces", "disable": None if progress else True}
    if progress:
        expected = estimate_mesh(model, lattice.resolution, bounds, sign, watertight=watertight)
        bar |= {"total": expected.faces, "desc": f"mesh, {expected}"}
    with tqdm(**bar) as counter:

        def count(faces: int) -> None:
            counter.update(faces)
            report(faces)

        if watertight:
            margin = log_odds_margin or 0.0
            sheet = closed_sheet(model, lattice, threshold, margin, on_ridge=on_ridge, report=count)
        else:
            level = _open_sheet(
                model, lattice, threshold, log_odds_margin, count, from_free=on_ridge
            )
            sheet = sheet_on_ridge(model, level, lattice.resolution) if on_ridge else level
            if lattice.is_cut:
                inside = lattice.in_core(level.vertices[sheet.faces].mean(axis=1))
                sheet = sheet._replace(faces=sheet.faces[inside])
    report(0)
    vertices, faces, normals, _, closing = sheet.without_unused()
    attributes: dict[str, Any] = {} if closing is None else {"closing": closing.astype(np.int32)}
    if color == CLASS and len(vertices):
        attributes["label"] = class_labels(model, vertices)
        colors: np.ndarray | None = label_colors(attributes["label"])
    else:
        colors = vertex_colors(model, vertices, sign, color)
    if colors is not None and closing is not None:
        colors[closing, :3] = UNKNOWN_COLOR
    return trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=normals if len(normals) else None,
        vertex_colors=colors,
        vertex_attributes=attributes,
        process=False,
    )


def _open_sheet(
    model: OccupancyMap,
    lattice: Lattice,
    threshold: float,
    log_odds_margin: float | None,
    report: Callable[[int], object],
    *,
    from_free: bool,
) -> Sheet:
    """The measured parts of the level set at a threshold, or of the border of free space before it."""
    level = threshold_log_odds(threshold)
    followed = min(level, 0.0) - log_odds_margin if from_free and log_odds_margin else level
    rule = Rule(followed, _sign(threshold), level, log_odds_margin)
    boxes = cluster_boxes(model, rule.sign, lattice.bounds if lattice.is_cut else None)
    if log_odds_margin is None:
        starts = blocks_near_boxes(lattice, *boxes)
        return follow_surface(model, lattice, starts, rule, allowed=starts, report=report)
    starts = seed_blocks(model, lattice, rule)
    if lattice.is_cut:  # a surface that comes from outside the bounds crosses them
        starts = np.union1d(starts, border_blocks(lattice, *boxes))
    return follow_surface(model, lattice, starts, rule, report=report)


def _check_meshing(
    model: OccupancyMap, resolution: float, threshold: float, log_odds_margin: float | None
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
    if log_odds_margin is not None and not log_odds_margin >= 0:
        raise ValueError(
            f"log_odds_margin must be >= 0, or None to keep all faces; got {log_odds_margin}"
        )


def _check_watertight(threshold: float, log_odds_margin: float | None) -> None:
    if log_odds_margin is None:
        raise ValueError("log_odds_margin must be a number with watertight; got None")
    if threshold_log_odds(threshold) >= log_odds_margin:
        raise ValueError(
            "threshold must be lower with watertight, or unmeasured space would count as free; got "
            f"{threshold}, whose log-odds are not below log_odds_margin = {log_odds_margin}"
        )


def _sign(threshold: float) -> int:
    """Sign of the weights that support a surface at this threshold."""
    return 1 if threshold >= 0.5 else -1
