#!/usr/bin/env bash
# Open3D 0.19.0: read_triangle_mesh reads the vertices of OBJ and OFF files in single precision.
#
# TriangleMesh.vertices is float64, but at UTM coordinates the values are off by up to a quarter of a
# meter, without a warning. A PLY file with double coordinates is read exactly. Shift such meshes
# before writing, or use PLY.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q open3d==0.19.0 plyfile==1.1.5 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import numpy as np
import open3d as o3d
import plyfile

folder = sys.argv[1]
points = np.random.default_rng(0).uniform(0, 10, (999, 3)) + [500_000, 4_500_000, 100]
faces = np.arange(999).reshape(-1, 3)
with open(f"{folder}/a.obj", "w") as file:
    file.writelines(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points)
    file.writelines(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
with open(f"{folder}/a.off", "w") as file:
    file.write("OFF\n999 333 0\n")
    file.writelines(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points)
    file.writelines(f"3 {a} {b} {c}\n" for a, b, c in faces)
vertex = np.zeros(999, [("x", "f8"), ("y", "f8"), ("z", "f8")])
vertex["x"], vertex["y"], vertex["z"] = points.T
face = np.zeros(333, [("vertex_indices", "i4", (3,))])
face["vertex_indices"] = faces
elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
plyfile.PlyData(elements).write(f"{folder}/a.ply")
errors = {}
for name in ("a.obj", "a.off", "a.ply"):
    read = np.asarray(o3d.io.read_triangle_mesh(f"{folder}/{name}").vertices)
    errors[name] = np.abs(read - points).max()
    print(f"Open3D {o3d.__version__}: {name} read as {read.dtype}, off by up to {errors[name]:.6f} m")
assert errors["a.ply"] < 1e-6
assert all(0.2 < errors[name] <= 0.25 for name in ("a.obj", "a.off")), "precision is kept now"
PYTHON
# Output seen:
#   Open3D 0.19.0: a.obj read as float64, off by up to 0.249857 m
#   Open3D 0.19.0: a.off read as float64, off by up to 0.249857 m
#   Open3D 0.19.0: a.ply read as float64, off by up to 0.000000 m
