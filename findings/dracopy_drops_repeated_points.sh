#!/usr/bin/env bash
# DracoPy 2.2.0: encode() of a point cloud keeps one of all points that are equal. In an organized
# cloud, where every ray without a return is a point 0 0 0, all of these become one, and the rows
# after the first move: time stamps, rings or directions in an array of their own no longer fit, and
# the cloud no longer has rows times columns. preserve_order=True keeps all points in their order.
#
# Output seen:
#   8 rays, 3 without return: 6 points come back, row 4 holds x = 0; preserve_order=True: 8, x = 4
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q DracoPy==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import DracoPy
import numpy as np

cloud = np.zeros((8, 3), dtype=np.float32)
hits = [0, 2, 4, 6, 7]
cloud[hits, 0] = hits
cloud[hits, 1] = 1  # rays 1, 3 and 5 have no return and stay 0 0 0


def decoded(**options) -> np.ndarray:
    return DracoPy.decode(DracoPy.encode(cloud, **options)).points


few, all_rows = decoded(), decoded(preserve_order=True)
print(f"8 rays, 3 without return: {len(few)} points come back,", end=" ")
print(f"row 4 holds x = {few[4, 0]:.0f}; ", end="")
print(f"preserve_order=True: {len(all_rows)}, x = {all_rows[4, 0]:.0f}")
dropped = len(few) == 6 and round(float(few[4, 0])) != 4 and round(float(all_rows[4, 0])) == 4
raise SystemExit(0 if dropped else "the behavior has changed")
PYTHON
