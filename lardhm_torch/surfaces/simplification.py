"""Fewer faces for viewers and physics engines, by quadric error metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh


def simplify_mesh(mesh: trimesh.Trimesh, num_faces: int) -> trimesh.Trimesh:
    """Simplify a mesh to about ``num_faces`` faces. Flat parts get large faces.

    A closed mesh usually stays closed. Vertices get the color and label of the nearest old vertex.

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
