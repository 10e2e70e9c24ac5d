#!/usr/bin/env bash
# VTK 9.7.2 (PyVista 0.49.1): coordinates of type double in a PLY file are read as float32.
#
# A mesh at UTM coordinates moves by up to a quarter of a meter, without a warning, and neighboring
# vertices collapse: the reader has no option for the precision. The same mesh as OBJ is read in
# double precision. plyfile reads the PLY file exactly.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pyvista==0.49.1 vtk==9.7.2 plyfile==1.1.5 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import plyfile
import pyvista

points = np.random.default_rng(0).uniform(0, 10, (999, 3)) + [500_000, 4_500_000, 100]
faces = np.arange(999).reshape(-1, 3)
vertex = np.zeros(999, [("x", "f8"), ("y", "f8"), ("z", "f8")])
vertex["x"], vertex["y"], vertex["z"] = points.T
face = np.zeros(333, [("vertex_indices", "i4", (3,))])
face["vertex_indices"] = faces
elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(face, "face")]
plyfile.PlyData(elements).write(f"{sys.argv[1]}/a.ply")
assert b"property double x" in open(f"{sys.argv[1]}/a.ply", "rb").read(200)
with open(f"{sys.argv[1]}/a.obj", "w") as file:
    file.writelines(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points)
    file.writelines(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
errors = {}
for name in ("a.ply", "a.obj"):
    read = np.asarray(pyvista.read(f"{sys.argv[1]}/{name}").points)
    errors[name] = np.abs(read - points).max()
    print(f"VTK {version('vtk')}: {name} read as {read.dtype}, off by up to {errors[name]:.6f} m")
exact = plyfile.PlyData.read(f"{sys.argv[1]}/a.ply")["vertex"]["y"]
print(f"plyfile {version('plyfile')}: a.ply off by {np.abs(exact - points[:, 1]).max():.6f} m")
assert 0.2 < errors["a.ply"] <= 0.25, "double coordinates keep their precision now"
assert errors["a.obj"] < 1e-6
PYTHON
# Output seen:
#   VTK 9.7.2: a.ply read as float32, off by up to 0.249857 m
#   VTK 9.7.2: a.obj read as float64, off by up to 0.000001 m
#   plyfile 1.1.5: a.ply off by 0.000000 m
