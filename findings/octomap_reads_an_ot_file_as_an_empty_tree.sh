#!/usr/bin/env bash
# octomap-python 1.10.0.0 (OctoMap 1.10): OcTree(b"map.ot") expects a .bt file. Given the other
# OctoMap format, or a file that does not exist, it prints two lines to standard error and makes a
# valid empty tree with cells of 0.1 m: nothing is occupied, every ray is unknown, and no exception
# tells a program so. Use OcTree.read(b"map.ot"), and check size().
#
# Output seen (standard output):
#   written: 0.05 m, 247 nodes; .bt 0.05 m, 247; .ot 0.1 m, 0; missing file 0.1 m, 0;
#   read() 0.05 m, 247
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q octomap-python==1.10.0.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import octomap

tree = octomap.OcTree(0.05)
tree.insertPointCloud(np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]]), np.zeros(3))
tree.writeBinary(b"map.bt")
tree.write(b"map.ot")


def words(found) -> str:
    return f"{found.getResolution():g} m, {found.size()}"


wrong = [octomap.OcTree(name) for name in (b"map.ot", b"missing.bt")]
right = [octomap.OcTree(b"map.bt"), octomap.OcTree.read(b"map.ot")]
print(f"written: {words(tree)} nodes; .bt {words(right[0])}; .ot {words(wrong[0])};", end=" ")
print(f"missing file {words(wrong[1])}; read() {words(right[1])}")
empty = all(found.size() == 0 for found in wrong) and all(found.size() for found in right)
raise SystemExit(0 if empty else "the behavior has changed")
PYTHON
