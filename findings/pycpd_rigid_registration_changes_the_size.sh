#!/usr/bin/env bash
# pycpd 2.0.0: RigidRegistration also estimates a scale, and the released version has no way to keep it
# at 1: scale=False is accepted and ignored, as any name is. Aligned with a whole room, a scan of 60 % of
# it grows by a quarter, so that lengths of the result are no meters and rotation and translation are
# no pose of the sensor. The rotation has to be applied from the right, too: Y @ R, the transpose of what
# a pose holds. Cure: use another method for rigid motions, and check that the returned scale is 1.
#
# Output seen, for a scan that was moved by 0.10 m, 0.10 m and 0 m:
#   default: scale 1.250, shift 2.81 -0.09 -1.19
#   scale=False: scale 1.250, shift 2.81 -0.09 -1.19
#   result: Y @ R
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pycpd==2.0.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycpd

rng = np.random.default_rng(0)
size = np.array([10.0, 8.0, 3.0])
room = rng.random((500, 3)) * size
axis, rows = rng.integers(0, 3, len(room)), np.arange(len(room))
room[rows, axis] = np.where(rng.random(len(room)) < 0.5, 0.0, size[axis])
scan = room[room[:, 0] < 6] + rng.normal(0, 0.02, ((room[:, 0] < 6).sum(), 3)) - [0.1, 0.1, 0.0]
scales = []
for name, settings in {"default": {}, "scale=False": {"scale": False}}.items():
    found, (scale, turn, shift) = pycpd.RigidRegistration(X=room, Y=scan, **settings).register()
    print(f"{name}: scale {scale:.3f}, shift", *(f"{value:.2f}" for value in np.ravel(shift)))
    scales.append(scale)
from_right = np.allclose(found, scale * scan @ turn + shift)
print("result:", "Y @ R" if from_right else "R @ y")
assert min(scales) > 1.1 and from_right, "the behavior has changed"
PYTHON
