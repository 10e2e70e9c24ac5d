"""Meshes to files: PLY, OBJ, GLB, OFF, STL."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lardhm_torch.io.atomic_files import replaced_file

if TYPE_CHECKING:
    import trimesh

FLOAT32_ERROR = 1e-4  # [m] what coordinates in a mesh file may be off
MESH_SUFFIXES = (".glb", ".obj", ".off", ".ply", ".stl")


def save_mesh(mesh: trimesh.Trimesh, path: str | Path) -> None:
    """Write a mesh in the format of the extension; an existing file is replaced atomically.

    Far from zero (UTM), float32 is too coarse for a mesh. Then .ply stores float64, and .glb a mesh
    near zero with a translation; .obj and .off are text. .stl always stores float32, so a warning is
    issued. .ply, .glb and .obj store vertex colors; .ply also integer vertex attributes ("label").

    Args:
        mesh: the mesh [m].
        path: file that ends in .glb, .obj, .off, .ply or .stl.

    Raises:
        ValueError: the extension is not one of .glb, .obj, .off, .ply, .stl.
        FileNotFoundError: the folder of path does not exist.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        known = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"path must end in one of {known} for a mesh; got {path.name!r}")
    error = float(np.abs(mesh.vertices - mesh.vertices.astype(np.float32)).max(initial=0.0))
    is_coarse = error > FLOAT32_ERROR
    if suffix == ".glb":  # has no integer attributes
        mesh = mesh.copy()
        mesh.vertex_attributes.clear()
    with replaced_file(path) as partial:
        if is_coarse and suffix == ".ply":
            partial.write_bytes(_float64_ply(mesh))
        elif is_coarse and suffix == ".glb":
            _near_zero(mesh).export(partial, file_type="glb")
        else:
            mesh.export(partial, file_type=suffix[1:])
    if is_coarse and suffix == ".stl":
        warnings.warn(
            f"STL stores float32, which moved vertices by up to {error:.2g} m; .ply does not",
            stacklevel=2,
        )


def _float64_ply(mesh: trimesh.Trimesh) -> bytes:
    """A binary PLY file with float64 coordinates, and colors and labels where the mesh has them."""
    vertex = [(name, "<f8") for name in "xyz"]
    visual: Any = mesh.visual
    has_colors = visual.kind == "vertex"
    if has_colors:
        vertex += [(name, "u1") for name in ("red", "green", "blue", "alpha")]
    vertex += [(name, "<i4") for name in mesh.vertex_attributes]
    vertices = np.zeros(len(mesh.vertices), vertex)
    for name, values in mesh.vertex_attributes.items():
        vertices[name] = values
    columns = np.hstack([mesh.vertices, visual.vertex_colors]) if has_colors else mesh.vertices
    for (name, _), values in zip(vertex, columns.T, strict=False):
        vertices[name] = values
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    types = {"<f8": "double", "u1": "uchar", "<i4": "int"}
    lines += [f"property {types[kind]} {name}" for name, kind in vertex]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*lines, ""]).encode() + vertices.tobytes() + faces.tobytes()


def _near_zero(mesh: trimesh.Trimesh) -> trimesh.Scene:
    """The mesh around zero in a scene that shifts it to where it is."""
    import trimesh

    center, shift = mesh.vertices.mean(axis=0).round(), np.eye(4)
    shift[:3, 3] = center
    near = trimesh.Trimesh(mesh.vertices - center, mesh.faces, visual=mesh.visual, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(near, transform=shift)
    return scene
