#!/usr/bin/env bash
# pye57 0.4.19: E57.write_scan_raw without rotation and translation writes an identity pose.
#
# The standard makes the pose optional, and leaving it out says that none is known. After
# write_scan_raw every reader finds a pose (has_pose() is True) that puts the scanner at the origin:
# registered points of several scans then all seem to be seen from (0, 0, 0).
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

columns = {f"cartesian{axis}": np.arange(5.0) + 100 for axis in "XYZ"}
with pye57.E57(sys.argv[1], mode="w") as file:
    file.write_scan_raw(columns)  # neither rotation nor translation
with pye57.E57(sys.argv[1]) as file:
    header = file.get_header(0)
    has_pose = header.has_pose()
    print(f"pye57 {version('pye57')}: has_pose() is {has_pose}")
    print(f"translation {header.translation.tolist()}, rotation {header.rotation.tolist()}")
assert has_pose, "a scan without a pose stays one now"
PYTHON
# Output seen:
#   pye57 0.4.19: has_pose() is True
#   translation [0.0, 0.0, 0.0], rotation [1.0, 0.0, 0.0, 0.0]
