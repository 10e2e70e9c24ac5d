#!/usr/bin/env bash
# pye57 0.4.19: write_scan_raw(rotation=, translation=) turns only the lowest and the highest corner
# of the points into the global frame and stores them as cartesianBounds. After half a turn about z
# xMinimum lies above xMaximum; after an eighth of a turn the box is too small on both sides. (ASTM
# E2807 gives the bounds of the points as stored, before the pose.) A reader that trusts the
# bounds, for a region of interest or a grid, leaves out points. Compute them from the points.
#
# Output seen:
#   half a turn: bounds of x -1.00 to -4.00; points -4.00 to -1.00
#   an eighth of a turn: bounds of x -0.71 to 0.71; points -1.41 to 1.41
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pye57==0.4.19 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import tempfile
from pathlib import Path

import numpy as np
import pye57

corners = np.array([[x, y, 0.0] for x in (1.0, 4.0) for y in (2.0, 3.0)])


def bounds_and_points(turn: float) -> tuple[float, float, float, float]:
    path = str(Path(tempfile.mkdtemp()) / "scan.e57")
    rotation = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])  # w x y z, about z
    data = {f"cartesian{name}": corners[:, i] for i, name in enumerate("XYZ")}
    file = pye57.E57(path, mode="w")
    file.write_scan_raw(data, rotation=rotation, translation=np.zeros(3))
    file.close()
    file = pye57.E57(path)
    header, x = file.get_header(0), file.read_scan(0, ignore_missing_fields=True)["cartesianX"]
    return header.xMinimum, header.xMaximum, float(x.min()), float(x.max())


half, eighth = bounds_and_points(np.pi), bounds_and_points(np.pi / 4)
for name, found in (("half a turn", half), ("an eighth of a turn", eighth)):
    low, high, first, last = found
    print(f"{name}: bounds of x {low:.2f} to {high:.2f}; points {first:.2f} to {last:.2f}")
wrong = half[0] > half[1] and eighth[0] > eighth[2] + 0.1 and eighth[1] < eighth[3] - 0.1
sys.exit(0 if wrong else "the behavior has changed")
PYTHON
