#!/usr/bin/env bash
# octomap-python 1.10.0.0 (OctoMap 1.10): an .ot file holds the log-odds of every node, but neither
# the occupancy threshold nor the probabilities of a hit and a miss nor the clamping limits. A tree
# built with a threshold of 0.8 has the default 0.5 after reading; a node that was hit once (0.75),
# which the robot that wrote the file took for free, is an obstacle for the one that reads it, and
# further scans are added with another sensor model. Set all five values again after read().
#
# Output seen:
#   written: threshold 0.80, hit 0.75 -> reading: threshold 0.50, hit 0.70; occupied nodes 0 -> 1
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q octomap-python==1.10.0.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import octomap

tree = octomap.OcTree(0.1)
tree.setOccupancyThres(0.8)
tree.setProbHit(0.75)
tree.insertPointCloud(np.array([[3.0, 0.0, 0.0]]), np.zeros(3))
tree.write(b"map.ot")
read = octomap.OcTree.read(b"map.ot")


def occupied(found) -> int:
    return sum(found.isNodeOccupied(node) for node in found.begin_leafs())


def words(found) -> str:
    return f"threshold {found.getOccupancyThres():.2f}, hit {found.getProbHit():.2f}"


print(f"written: {words(tree)} -> reading: {words(read)};", end=" ")
print(f"occupied nodes {occupied(tree)} -> {occupied(read)}")
forgotten = abs(read.getOccupancyThres() - 0.5) < 1e-6 and occupied(tree) < occupied(read)
raise SystemExit(0 if forgotten else "the behavior has changed")
PYTHON
