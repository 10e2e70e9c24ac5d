#!/usr/bin/env bash
# pypatchworkpp 1.4.1: points nearer than min_range (2.7 m by default, the roof of the car of KITTI) or
# farther than max_range (80 m) are not classified, but getNonground() returns them. A perfectly flat
# floor, all of it ground, has "nonground" all around the robot, where a planner looks first: a small
# robot sees itself enclosed by obstacles. getGround() and getNonground() together are the whole cloud,
# so that nothing shows which points were never looked at. Cure: drop these ranges, or set min_range.
#
# Output seen, for a flat floor of 100 m around the sensor:
#   nearer than 2.7 m: 100 % nonground; 3 to 79 m: 0 %; beyond 80 m: 100 %
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pypatchworkpp==1.4.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON' | grep -v PatchWorkpp::
import numpy as np
import pypatchworkpp

rng = np.random.default_rng(0)
angle, distance = rng.uniform(0, 2 * np.pi, 40_000), rng.uniform(0.5, 100, 40_000)
height = rng.normal(-1.723, 0.01, 40_000)
floor = np.column_stack(
    [distance * np.cos(angle), distance * np.sin(angle), height, np.ones(40_000)]
)
method = pypatchworkpp.patchworkpp(pypatchworkpp.Parameters())
method.estimateGround(floor)
ground, other = (np.hypot(*found[:, :2].T) for found in (method.getGround(), method.getNonground()))
assert len(ground) + len(other) == len(floor), "the behavior has changed"


def percent(low: float, high: float) -> float:
    counts = [((found > low) & (found < high)).sum() for found in (ground, other)]
    return 100 * counts[1] / sum(counts)


near, between, far = percent(0, 2.69), percent(3, 79), percent(80.1, 101)
print(f"nearer than 2.7 m: {near:.0f} % nonground; 3 to 79 m: {between:.0f} %;", end=" ")
print(f"beyond 80 m: {far:.0f} %")
assert near == far == 100 and between < 1, "the behavior has changed"
PYTHON
