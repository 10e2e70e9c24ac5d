#!/usr/bin/env bash
# pye57 0.4.19: E57.write_scan_raw stores coordinates in single precision, whatever it is given.
#
# Float64 UTM coordinates come back off by up to a quarter of a meter, without a warning. Subtract
# an offset before writing, and keep it in the pose (translation), which is stored in double
# precision.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pye57==0.4.19 numpy==2.2.6
"$folder/venv/bin/python" - "$folder/scan.e57" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
import pye57

points = np.random.default_rng(0).uniform(0, 10, (1000, 3))
northing = 4_500_000.0 + points[:, 1]
columns = {"cartesianX": points[:, 0], "cartesianY": northing, "cartesianZ": points[:, 2]}
with pye57.E57(sys.argv[1], mode="w") as file:
    file.write_scan_raw(columns)
with pye57.E57(sys.argv[1]) as file:
    read = file.read_scan_raw(0)["cartesianY"]
error = np.abs(read - northing).max()
print(f"pye57 {version('pye57')}: written {northing.dtype}, read {read.dtype}")
print(f"largest error of a northing near 4,500,000 m: {error:.3f} m")
assert 0.2 < error <= 0.25, "coordinates keep their precision now"
PYTHON
# Output seen:
#   pye57 0.4.19: written float64, read float64
#   largest error of a northing near 4,500,000 m: 0.250 m
