#!/usr/bin/env bash
# meshio 5.3.5: properties of type uchar in PLY files are read as int8.
#
# Colors above 127 become negative (200 is read as -56), and meshio writes them back as "int8": the
# colors of the file have changed. plyfile reads the same file as uint8.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q meshio==5.3.5 plyfile==1.1.5 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from importlib.metadata import version

import meshio
import numpy as np
import plyfile

vertices = np.zeros(3, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1")])
vertices["x"], vertices["red"] = [0, 1, 2], [100, 200, 255]
element = plyfile.PlyElement.describe(vertices, "vertex")
plyfile.PlyData([element]).write(f"{sys.argv[1]}/colors.ply")
header = open(f"{sys.argv[1]}/colors.ply", "rb").read().split(b"end_header")[0]
assert b"property uchar red" in header
read = meshio.read(f"{sys.argv[1]}/colors.ply").point_data["red"]
print(f"meshio {version('meshio')}: written uchar 100 200 255; read {read.dtype} {read.tolist()}")
other = plyfile.PlyData.read(f"{sys.argv[1]}/colors.ply")["vertex"]["red"]
print(f"plyfile {version('plyfile')}: {other.dtype} {other.tolist()}")
assert read.tolist() == [100, -56, -1], "meshio reads uchar without a sign now"
PYTHON
# Output seen:
#   meshio 5.3.5: written uchar 100 200 255; read int8 [100, -56, -1]
#   plyfile 1.1.5: uint8 [100, 200, 255]
