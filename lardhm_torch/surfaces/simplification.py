"""Fewer faces for viewers and physics engines, by quadric error metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh


def simplify_mesh(mesh: trimesh.Trimesh, num_faces: int) -> trimesh.Trimesh:
    """Simplify a mesh to about ``num_faces`` faces. Flat parts get large faces.

    A watertight mesh stays watertight (see `_closed`). Vertices get the color and the attributes of the
    nearest old vertex.

    Args:
        mesh: the mesh [m].
        num_faces: target number of faces.

    Returns:
        A new mesh, or the given mesh if it has no more faces than that.

    Raises:
        ValueError: num_faces is below 1.
        ImportError: fast-simplification is not installed.

    Source: Garland & Heckbert 1997, quadric error metrics (by fast-simplification).
    """
    import trimesh
    from scipy.spatial import cKDTree

    if num_faces < 1:
        raise ValueError(f"num_faces must be at least 1; got {num_faces}")
    if len(mesh.faces) <= num_faces:
        return mesh
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError(
            "fewer faces need fast-simplification, which is not installed; "
            'install the extra: pip install "lardhm_torch[view]"'
        ) from error
    middle = mesh.vertices.mean(axis=0)  # float32 is enough near zero
    vertices, faces = fast_simplification.simplify(
        (mesh.vertices - middle).astype(np.float32),
        mesh.faces.astype(np.int32),
        target_count=num_faces,
    )
    vertices = vertices.astype(np.float64) + middle
    if mesh.is_watertight and mesh.is_winding_consistent:
        vertices, faces = _closed(vertices, faces)
    visual: Any = mesh.visual
    has_colors = visual is not None and visual.kind == "vertex"
    attributes = dict(mesh.vertex_attributes)
    if not has_colors and not attributes:
        return trimesh.Trimesh(vertices, faces, process=False)
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    return trimesh.Trimesh(
        vertices,
        faces,
        vertex_colors=visual.vertex_colors[nearest] if has_colors else None,
        vertex_attributes={name: np.asarray(v)[nearest] for name, v in attributes.items()},
        process=False,
    )


def _closed(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A simplified watertight surface with exactly two faces at each edge.

    Each edge has as many faces to one side as to the other, because collapsing edges preserves that, but
    there can be more than two. Faces that lie back to back are removed. At other edges, faces are paired,
    and each pair gets a middle of the edge of its own, 1 % away from it.
    """
    faces = _without_opposites(faces)
    while len(pairs := _extra_pairs(faces)):
        split: list[list[int]] = []
        taken: set[int] = set()
        for pair in pairs.tolist():  # a face can be split once at a time
            if taken.isdisjoint(owners := {half // 3 for half in pair}):
                taken |= owners
                split.append(pair)
        halves = np.array(split)  # (P, 2) half edges: 3 face + corner where it starts
        face, corner = halves // 3, halves % 3
        start, end, apex = (faces[face, (corner + step) % 3] for step in range(3))
        middle = 0.495 * (vertices[start] + vertices[end]) + 0.01 * vertices[apex]
        new = np.repeat(len(vertices) + np.arange(len(split))[:, None], 2, axis=1)
        faces[face, (corner + 1) % 3] = new
        faces = np.concatenate([faces, np.stack([new, end, apex], axis=2).reshape(-1, 3)])
        vertices = np.concatenate([vertices, middle.mean(axis=1)])
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _without_opposites(faces: np.ndarray) -> np.ndarray:
    """The faces without pairs that have the same corners in opposite order."""
    corners = np.sort(faces, axis=1)
    _, group = np.unique(corners, axis=0, return_inverse=True)
    following = (np.roll(faces, -1, axis=1) == corners[:, 1:2]) & (faces == corners[:, :1])
    is_even = following.any(axis=1)
    kept = np.ones(len(faces), dtype=bool)
    counts = [np.bincount(group[side], minlength=group.max() + 1) for side in (is_even, ~is_even)]
    for side in (is_even, ~is_even):
        rows = np.flatnonzero(side)[np.argsort(group[side], kind="stable")]
        own = group[rows]
        rank = np.arange(len(rows)) - np.searchsorted(own, own)
        kept[rows] = rank >= np.minimum(*counts)[own]
    return faces[kept]


def _extra_pairs(faces: np.ndarray) -> np.ndarray:
    """(P, 2) half edges in opposite directions, at edges with more than two of them."""
    starts, ends = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    order = np.lexsort((starts < ends, high, low))
    is_first = np.r_[True, (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)]
    begins = np.flatnonzero(is_first)
    counts = np.diff(np.r_[begins, len(order)])
    found = [
        order[begin : begin + count].reshape(2, -1).T
        for begin, count in zip(begins[counts > 2], counts[counts > 2], strict=True)
    ]
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *found])
