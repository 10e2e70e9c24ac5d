#!/usr/bin/env bash
# gtsam 4.3.0: Rot3.Quaternion(w, x, y, z) and Rot3(w, x, y, z) neither normalize the quaternion nor
# check it, and the matrix is no rotation then: the mean of the quaternions of two headings 1.5 rad
# apart (norm 0.93) brings a point 10 m ahead to 9.68 m, and the inverse of the pose does not undo the
# pose. Yaw is wrong, too. Rot3(matrix) accepts twice the identity in the same way. scipy, transforms3d
# and gtsam's own readG2o normalize. Cure: divide by the norm.
#
# Output seen, for a mean heading of 0.750 rad:
#   gtsam 9.683 m, yaw 0.655, pose and inverse: scale 0.938; scipy 10.000 m, yaw 0.750
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q gtsam==4.3.0 scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

x, y, z, w = Rotation.from_euler("z", [[0.0], [1.5]]).as_quat().mean(axis=0)
turned, ahead = gtsam.Rot3.Quaternion(w, x, y, z), np.array([10.0, 0.0, 0.0])
pose = gtsam.Pose3(turned, np.zeros(3))
scale = pose.compose(pose.inverse()).matrix()[0, 0]
same = Rotation.from_quat([x, y, z, w])
lengths = [np.linalg.norm(point) for point in (turned.rotate(ahead), same.apply(ahead))]
print(f"gtsam {lengths[0]:.3f} m, yaw {turned.yaw():.3f}, pose and inverse: scale {scale:.3f};", end=" ")
print(f"scipy {lengths[1]:.3f} m, yaw {same.as_euler('zyx')[0]:.3f}")
assert lengths[0] < 9.8 and scale < 0.95 and turned.yaw() < 0.7, "the behavior has changed"
assert abs(lengths[1] - 10) < 1e-9, "the behavior has changed"
assert gtsam.Rot3(2 * np.eye(3)).matrix()[0, 0] == 2, "the behavior has changed"
PYTHON
