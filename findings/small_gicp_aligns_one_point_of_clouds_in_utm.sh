#!/usr/bin/env bash
# small_gicp 1.0.1: align downsamples to voxels whose numbers have 21 bits an axis. With coordinates
# beyond 2^20 voxels (262 km at 0.25 m, as in UTM) all points share one voxel, so that clouds of
# 4,000 points become one point each. Python sees no error and no warning, and the result has
# converged = True and no rotation; the C++ library prints to standard error. Near the origin the same
# clouds align to within a millimeter. voxelgrid_sampling and preprocess_points do the same.
# Cure: subtract an offset from both clouds before.
#
# Output seen:
# at the origin: converged True, 2423 inliers, turned by 0.050, 0.0002 m
# in UTM: converged True, 1 inliers, turned by -0.000, 0.1460 m
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q small_gicp==1.0.1 numpy==2.2.6
"$folder/venv/bin/python" - 2>"$folder/errors" <<'PYTHON'
import numpy as np
import small_gicp

rng = np.random.default_rng(0)
size = np.array([10.0, 8.0, 3.0])
room = rng.random((4000, 3)) * size
axis = rng.integers(0, 3, len(room))
rows = np.arange(len(room))
room[rows, axis] = np.where(rng.random(len(room)) < 0.5, 0.0, size[axis])
angle = 0.05
turn = np.array(
    [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
)
turned = (room - room.mean(axis=0) - [0.3, 0.2, 0.05]) @ turn + room.mean(axis=0)


def aligned(offset):
    found = small_gicp.align(room + offset, turned + offset, downsampling_resolution=0.25)
    motion = found.T_target_source
    moved = (turned + offset) @ motion[:3, :3].T + motion[:3, 3]
    distance = np.abs(moved - room - offset).mean()
    return found.converged, found.num_inliers, np.arctan2(motion[1, 0], motion[0, 0]), distance


near, far = aligned(np.zeros(3)), aligned(np.array([450_000.0, 5_400_000.0, 0.0]))
for place, (converged, inliers, radians, distance) in {"at the origin": near, "in UTM": far}.items():
    print(f"{place}: converged {converged}, {inliers} inliers, turned by {radians:.3f}, {distance:.4f} m")
assert near[0] and near[1] > 500 and abs(near[2] - angle) < 2e-3 and near[3] < 0.01, "changed"
assert far[0] and far[1] == 1 and abs(far[2]) < 1e-3 and far[3] > 0.1, "the behavior has changed"
PYTHON
grep -q "out of range" "$folder/errors"
