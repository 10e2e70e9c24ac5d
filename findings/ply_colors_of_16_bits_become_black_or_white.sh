#!/usr/bin/env bash
# PLY files may hold colors as ushort (laser scanners and LAS have 16 bits). Four readers give three
# wrong answers, without an error: VTK 9.7.2 and trimesh 5.2.0 keep the lower 8 bits, so that a
# middle gray of 32768 is black and 256 is black, too; Open3D 0.20.0 (legacy) divides by 255, so that
# white is 257 instead of 1; pymeshlab 2025.7.post1 makes every point white. (Open3D's tensor reader
# leaves the colors out and says so.) Convert to 8 bits before writing, or read with plyfile.
#
# Output seen, for the red values 65535, 32768 and 256, of which the first is the brightest:
#   VTK 255 0 0; trimesh 255 0 0; Open3D 257.0 128.5 1.0; MeshLab 1.0 1.0 1.0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q vtk==9.7.2 trimesh==5.2.0 open3d==0.20.0 \
    pymeshlab==2025.7.post1 plyfile==1.1.5
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import open3d
import pymeshlab
import trimesh
from plyfile import PlyData, PlyElement
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOPLY import vtkPLYReader

fields = [(name, "f4") for name in "xyz"] + [(name, "u2") for name in ("red", "green", "blue")]
cloud = np.zeros(3, dtype=fields)
cloud["x"], cloud["red"] = [0, 1, 2], [65535, 32768, 256]
PlyData([PlyElement.describe(cloud, "vertex")]).write("colors.ply")

reader = vtkPLYReader()
reader.SetFileName("colors.ply")
reader.Update()
meshes = pymeshlab.MeshSet()
meshes.load_new_mesh("colors.ply")
found = {
    "VTK": vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars()),
    "trimesh": trimesh.load("colors.ply").colors,
    "Open3D": np.asarray(open3d.io.read_point_cloud("colors.ply").colors).round(1),
    "MeshLab": meshes.current_mesh().vertex_color_matrix(),
}
text = "; ".join(f"{name} {' '.join(str(v) for v in rows[:, 0])}" for name, rows in found.items())
print(text)
seen = "VTK 255 0 0; trimesh 255 0 0; Open3D 257.0 128.5 1.0; MeshLab 1.0 1.0 1.0"
raise SystemExit(0 if text == seen else "the behavior has changed")
PYTHON
