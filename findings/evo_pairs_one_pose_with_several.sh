#!/usr/bin/env bash
# evo 1.38.1: sync.associate_trajectories takes, for every stamp of one trajectory, the nearest of the
# other within max_diff, whether or not that one is taken. Poses that come in bursts, as after a
# network delay, or an estimate at a higher rate are paired with one reference pose several times: the
# result has repeated stamps, such poses count more than once in the error, and pairs for the relative
# error have no motion in between. Thin the denser trajectory first, or drop repeated stamps.
#
# Output seen:
#   4 pairs; reference 0.000 0.000 0.100 0.100; estimate 0.004 0.005 0.100 0.105
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q evo==1.38.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D


def trajectory(*stamps: float) -> PoseTrajectory3D:
    count = len(stamps)
    positions = np.column_stack([stamps, np.zeros((count, 2))])
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return PoseTrajectory3D(positions, turns, timestamps=np.array(stamps))


def words(found: PoseTrajectory3D) -> str:
    return " ".join(f"{stamp:.3f}" for stamp in found.timestamps)


reference, estimate = sync.associate_trajectories(
    trajectory(0.0, 0.1, 0.2, 0.3), trajectory(0.004, 0.005, 0.1, 0.105), max_diff=0.01
)
print(f"{reference.num_poses} pairs; reference {words(reference)}; estimate {words(estimate)}")
repeated = len(set(reference.timestamps)) < reference.num_poses
raise SystemExit(0 if repeated else "the behavior has changed")
PYTHON
