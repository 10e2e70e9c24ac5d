#!/usr/bin/env bash
# Roll, pitch and yaw of ROS and URDF are Rz(yaw) Ry(pitch) Rx(roll). scipy 1.17.1's "xyz", transforms3d
# 0.4.2 and gtsam 4.3.0's RzRyRx agree with that. Two others take the same three angles and turn in another
# order: get_rotation_matrix_from_xyz of Open3D 0.20.0 is Rx Ry Rz (scipy's "XYZ"), and the orientation of
# actors in VTK 9.7.2 and PyVista 0.49.1 is Rz Rx Ry. With one angle alone all agree, so that a simple test
# passes; a tilted sensor is off by decimeters a few meters away. Cure: pass matrices or quaternions.
# (Open3D's wheel needs libusb-1.0 of the system.)
#
# Output seen, for 10, 20 and 30 degrees and a point at (10, 0, 0):
#   scipy xyz: 8.14 4.70 -3.42
#   transforms3d: 8.14 4.70 -3.42
#   gtsam: 8.14 4.70 -3.42
#   Open3D xyz: 8.14 5.44 -2.05
#   PyVista: 7.84 5.21 -3.37
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q open3d==0.20.0 pyvista==0.49.1 vtk==9.7.2 scipy==1.17.1 \
	transforms3d==0.4.2 gtsam==4.3.0
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam
import numpy as np
import open3d
import pyvista
import transforms3d
from scipy.spatial.transform import Rotation

degrees = np.array([10.0, 20.0, 30.0])
angles = np.radians(degrees)
actor = pyvista.Actor()
actor.orientation = degrees
matrix = actor.GetMatrix()
turns = {
    "scipy xyz": Rotation.from_euler("xyz", angles).as_matrix(),
    "transforms3d": transforms3d.euler.euler2mat(*angles),
    "gtsam": gtsam.Rot3.RzRyRx(*angles).matrix(),
    "Open3D xyz": open3d.geometry.get_rotation_matrix_from_xyz(angles),
    "PyVista": np.array([[matrix.GetElement(row, column) for column in range(3)] for row in range(3)]),
}
for name, turn in turns.items():
    print(f"{name}:", *(f"{value:.2f}" for value in turn @ [10.0, 0.0, 0.0]))
ours, *same, first, second = turns.values()
assert all(np.allclose(turn, ours) for turn in same), "the behavior has changed"
assert np.allclose(first, Rotation.from_euler("XYZ", angles).as_matrix()), "the behavior has changed"
in_order = Rotation.from_euler("ZXY", angles[[2, 0, 1]]).as_matrix()
assert np.allclose(second, in_order) and not np.allclose(second, first), "the behavior has changed"
PYTHON
