#!/usr/bin/env bash
# gtsam 4.3.0: readG2o(path) reads the 2-D records of a file only; its second argument, is3D, is False
# by default. A file of 3-D poses gives an empty graph and no values, without an error or a warning,
# and so does a 2-D file with is3D=True. The optimizer accepts the empty graph and ends with an error
# of 0, as after a perfect adjustment. Cure: readG2o(path, True), and check graph.size().
#
# Output seen:
#   3-D file: 0 factors, 0 poses, error 0.0; with is3D=True 1 factors, 2 poses
#   2-D file with is3D=True: 0 factors, 0 poses
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q gtsam==4.3.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import gtsam

with open("3d.g2o", "w") as file:
    file.write("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n")
    file.write("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1")
    file.write("".join(f" {int(row == column)}" for row in range(6) for column in range(row, 6)))
    file.write("\n")
with open("2d.g2o", "w") as file:
    file.write("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")


def size(path: str, *is_3d: bool) -> tuple[int, int]:
    graph, poses = gtsam.readG2o(path, *is_3d)
    return graph.size(), poses.size()


graph, poses = gtsam.readG2o("3d.g2o")
optimizer = gtsam.LevenbergMarquardtOptimizer(graph, poses)
optimizer.optimize()
default, right, other = size("3d.g2o"), size("3d.g2o", True), size("2d.g2o", True)
print(f"3-D file: {default[0]} factors, {default[1]} poses, error {optimizer.error()};", end=" ")
print(f"with is3D=True {right[0]} factors, {right[1]} poses")
print(f"2-D file with is3D=True: {other[0]} factors, {other[1]} poses")
assert default == other == (0, 0) and right == (1, 2), "the behavior has changed"
assert optimizer.error() == 0, "the behavior has changed"
PYTHON
