#!/usr/bin/env bash
# viser 1.1.1: scene.add_point_cloud stores points in half precision unless precision="float32" is given.
# At 100 m the steps are 6 cm: walls of an outdoor scan become layers, and clouds that are registered to a
# centimeter look misaligned. Coordinates beyond 65 km, as in UTM, become infinity, and the cloud is not
# visible; numpy's warning of an overflow is all that tells so. Meshes and lines are float32, so a mesh
# and its points disagree. Cure: precision="float32", and coordinates near the origin.
#
# Output seen, for points at 100.00, 100.02, 100.04, 100.06 and 450000 m:
#   float16: [100.0, 100.0, 100.06, 100.06, inf]
#   float32: [100.0, 100.02, 100.04, 100.06, 450000.0]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q viser==1.1.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON' | grep float
import warnings

import numpy as np
import viser

warnings.simplefilter("ignore")  # overflow in a cast
walls = 100 + 0.02 * np.arange(4)
points = np.column_stack([[*walls, 450_000.0], np.zeros((5, 2))])
server = viser.ViserServer(port=8765, verbose=False)
stored = [
    server.scene.add_point_cloud("/scan", points, (0, 0, 0), **settings).points
    for settings in ({}, {"precision": "float32"})
]
server.stop()
for found in stored:
    print(f"{found.dtype}: {np.round(found[:, 0].astype(float), 2).tolist()}")
assert stored[0].dtype == np.float16 and stored[1].dtype == np.float32, "the behavior has changed"
assert np.isinf(stored[0][4, 0]) and abs(stored[1][1, 0] - walls[1]) < 1e-4, "the behavior has changed"
assert max(abs(stored[0][:4, 0].astype(float) - walls)) > 0.019, "the behavior has changed"
PYTHON
