#!/usr/bin/env bash
# scipy 1.17.1: ndimage.distance_transform_edt gives the distance to the nearest zero of a grid. A grid
# without a zero, such as a local costmap of free space with obstacles as zeros, gets distances to a cell
# at index -1, next to its first corner: a free room of 2 m x 3 m has an obstacle 0.05 m from one corner
# and 3.56 m from the opposite one. There is no warning, and return_indices names row -1, which numpy
# takes for the last row. The same grid gives infinity in edt 3.1.2 and 3.4e38 in OpenCV 5.0.0.
# Known (scipy issues 1616 and 15585). Cure: fill the result with infinity unless (grid == 0).any().
#
# Output seen:
#   clearance 0.05 to 3.56 m, nearest obstacle in cell [-1, 0]; edt inf, OpenCV 3.4e+38
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q scipy==1.17.1 numpy==2.4.6 edt==3.1.2 opencv-python-headless==5.0.0.93
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import edt
import numpy as np
from scipy.ndimage import distance_transform_edt

is_free = np.ones((40, 60), dtype=np.uint8)
clearance, cells = distance_transform_edt(is_free, sampling=0.05, return_indices=True)
others = edt.edt(is_free).min(), cv2.distanceTransform(is_free, cv2.DIST_L2, 5).min()
print(f"clearance {clearance.min():.2f} to {clearance.max():.2f} m,", end=" ")
print(f"nearest obstacle in cell {cells[:, 20, 30].tolist()};", end=" ")
print(f"edt {others[0]}, OpenCV {others[1]:.1e}")
assert np.isclose(clearance[0, 0], 0.05) and clearance.max() < 4, "the behavior has changed"
assert (cells == np.array([-1, 0])[:, None, None]).all(), "the behavior has changed"
assert min(others) > 1e30, "the behavior has changed"
PYTHON
