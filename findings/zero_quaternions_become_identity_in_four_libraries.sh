#!/usr/bin/env bash
# A quaternion 0 0 0 0 is what a ROS message holds whose orientation was never set. transforms3d 0.4.2,
# pytransform3d 3.17.0, trimesh 5.2.0 and gtsam 4.3.0 turn it into the identity, without an error or a
# warning: a sensor of unknown orientation looks straight ahead, and its scans are added to the
# map. scipy 1.17.1 and spatialmath 1.1.18 raise an error. Cure: check the norm before the conversion.
#
# Output seen:
#   identity: transforms3d, pytransform3d, trimesh, gtsam; error: scipy, spatialmath
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q transforms3d==0.4.2 pytransform3d==3.17.0 trimesh==5.2.0 gtsam==4.3.0 \
	scipy==1.17.1 spatialmath-python==1.1.18 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import gtsam
import numpy as np
import pytransform3d.rotations
import spatialmath
import transforms3d
import trimesh
from scipy.spatial.transform import Rotation

warnings.simplefilter("error")
unset = np.zeros(4)
libraries = {
    "transforms3d": transforms3d.quaternions.quat2mat,
    "pytransform3d": pytransform3d.rotations.matrix_from_quaternion,
    "trimesh": lambda quaternion: trimesh.transformations.quaternion_matrix(quaternion)[:3, :3],
    "gtsam": lambda quaternion: gtsam.Rot3.Quaternion(*quaternion).matrix(),
    "scipy": lambda quaternion: Rotation.from_quat(quaternion).as_matrix(),
    "spatialmath": lambda quaternion: spatialmath.UnitQuaternion(quaternion).R,
}
silent, refused = [], []
for name, matrix in libraries.items():
    try:
        assert np.array_equal(matrix(unset), np.eye(3)), "the behavior has changed"
        silent.append(name)
    except ValueError:
        refused.append(name)
print(f"identity: {', '.join(silent)}; error: {', '.join(refused)}")
assert silent == list(libraries)[:4] and refused == list(libraries)[4:], "the behavior has changed"
PYTHON
