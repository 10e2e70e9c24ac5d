#!/usr/bin/env bash
# meshio 5.3.5: vertex colors of an OBJ file ("v x y z r g b", as trimesh, MeshLab and Blender write
# them) become columns 4 to 6 of Mesh.points.
#
# points has shape (N, 6) instead of (N, 3), without a warning: distances and bounding boxes
# computed from it mix meters with colors. The colors are not in point_data. trimesh reads the same
# file as (N, 3) vertices and colors. Cure: points[:, :3].
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q meshio==5.3.5 trimesh==5.2.0 numpy==2.2.6
"$folder/venv/bin/python" - "$folder/box.obj" <<'PYTHON'
import sys
from importlib.metadata import version

import meshio
import numpy as np
import trimesh

box = trimesh.creation.box()
box.visual.vertex_colors = np.tile([51, 102, 255, 255], (8, 1))
box.export(sys.argv[1])
first = next(line for line in open(sys.argv[1]) if line.startswith("v "))
mesh = meshio.read(sys.argv[1])
print(f"written: {first.strip()}")
print(f"meshio {version('meshio')}: points {mesh.points.shape}, point_data {list(mesh.point_data)}")
print(f"first point: {mesh.points[0].round(3).tolist()}")
print(f"trimesh {version('trimesh')}: vertices {trimesh.load(sys.argv[1], process=False).vertices.shape}")
assert mesh.points.shape == (8, 6), "colors are no coordinates now"
assert not mesh.point_data, "colors are point data now"
PYTHON
# Output seen:
#   written: v -0.50000000 -0.50000000 -0.50000000 0.20000000 0.40000000 1.00000000
#   meshio 5.3.5: points (8, 6), point_data []
#   first point: [-0.5, -0.5, -0.5, 0.2, 0.4, 1.0]
#   trimesh 5.2.0: vertices (8, 3)
