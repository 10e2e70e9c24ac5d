#!/usr/bin/env bash
# The same field, 1 inside and 0 outside as an occupancy map has it: the faces of PyMCubes 0.1.6 look
# outward, those of scikit-image 0.26.0 with its default gradient_direction="descent" look into the
# solid. Signed volumes, ray tests, back-face culling and normals of a mesh change sign when one
# library replaces the other. For occupancy, give scikit-image gradient_direction="ascent", or march
# on the negated field.
#
# Output seen:
#   signed volume: PyMCubes 23.2, scikit-image -23.2, with gradient_direction="ascent" 23.2
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q PyMCubes==0.1.6 scikit-image==0.26.0 trimesh==5.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import mcubes
import numpy as np
import trimesh
from skimage.measure import marching_cubes

field = np.zeros((5, 5, 5))
field[1:4, 1:4, 1:4] = 1


def volume(vertices, faces) -> float:
    return round(float(trimesh.Trimesh(vertices, faces, process=False).volume), 1)


found = [
    volume(*mcubes.marching_cubes(field, 0.5)),
    volume(*marching_cubes(field, 0.5)[:2]),
    volume(*marching_cubes(field, 0.5, gradient_direction="ascent")[:2]),
]
print(f"signed volume: PyMCubes {found[0]}, scikit-image {found[1]},", end=" ")
print(f'with gradient_direction="ascent" {found[2]}')
opposite = found[0] > 0 > found[1] and found[2] > 0
raise SystemExit(0 if opposite else "the behavior has changed")
PYTHON
