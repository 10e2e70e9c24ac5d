#!/usr/bin/env bash
# laspy 2.7.0: coordinates are stored as 32-bit integers times a scale. A value that does not fit, such
# as infinity, raises an error; NaN, which organized clouds use for rays without a return, passes
# the check and becomes the smallest integer: with a scale of 1 mm a point at -2147483.648 m, on disk
# and in the bounds of the header. (numpy 2.4.6 warns of an invalid value in a cast; the file is
# written.) Drop points that are not finite before the assignment.
#
# Output seen:
#   inf raises OverflowError; nan becomes -2147483.648; header from -2147483.648 to 3.000
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import laspy
import numpy as np

header = laspy.LasHeader(point_format=1, version="1.2")
header.scales = [0.001] * 3
cloud = laspy.LasData(header)
cloud.y = cloud.z = np.zeros(3)
try:
    cloud.x = np.array([1.0, np.inf, 3.0])
    error = "nothing"
except OverflowError as raised:
    error = type(raised).__name__
cloud.x = np.array([1.0, np.nan, 3.0])
cloud.write("cloud.las")
read = laspy.read("cloud.las")
low, high = read.header.mins[0], read.header.maxs[0]
print(f"inf raises {error}; nan becomes {read.x[1]:.3f};", end=" ")
print(f"header from {low:.3f} to {high:.3f}")
seen = error == "OverflowError" and read.x[1] < -2e6 and low < -2e6
raise SystemExit(0 if seen else "the behavior has changed")
PYTHON
