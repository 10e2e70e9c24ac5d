#!/usr/bin/env bash
# Open3D 0.20.0: read_point_cloud of a .pts file takes the first number of the file for the number
# of points and does not use the rest of that line. Scanners write this line; CloudCompare and
# scripts often do not, and then the first coordinate, cut to an integer, decides how many points are
# read: of four points that start with "2.5 0 0" two are returned, without the first, and no warning
# is given. Write the count, or use another suffix (.xyz).
#
# Output seen:
#   with a count 4 points; without 2 points, starting at x = 3.5
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q open3d==0.20.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import open3d

rows = "2.5 0 0\n3.5 1 0\n4.5 2 0\n5.5 3 0\n"


def points(text: str) -> np.ndarray:
    with open("cloud.pts", "w") as file:
        file.write(text)
    return np.asarray(open3d.io.read_point_cloud("cloud.pts").points)


right, wrong = points("4\n" + rows), points(rows)
print(f"with a count {len(right)} points;", end=" ")
print(f"without {len(wrong)} points, starting at x = {wrong[0, 0]:g}")
seen = len(right) == 4 and len(wrong) == 2 and wrong[0, 0] == 3.5
raise SystemExit(0 if seen else "the behavior has changed")
PYTHON
