#!/usr/bin/env bash
# laspy 2.7.0: a new header has a scale of 0.01 in each axis, so laspy.create() and LasHeader() store
# coordinates in whole centimeters. They are rounded at the assignment, before anything is written, and
# nothing says so: a wall scanned with a noise of 2 mm becomes three layers, 1 cm apart.
# Cure: set header.scales = [0.001] * 3 (and offsets) before the
# first coordinate is assigned.
#
# Output seen:
#   10.0004 10.0049 10.0051 m become 10.00 10.00 10.01; layers of a wall with 2 mm noise: 3, at 1 mm 15
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import laspy
import numpy as np

warnings.simplefilter("error")


def stored(x: np.ndarray, **settings: list[float]) -> np.ndarray:
    las = laspy.create()
    for name, values in settings.items():
        setattr(las.header, name, values)
    las.x, las.y, las.z = x, np.zeros(len(x)), np.zeros(len(x))
    return np.array(las.x)


given = np.array([10.0004, 10.0049, 10.0051])
wall = np.random.default_rng(0).normal(10.0, 0.002, 5000)
layers = [len(np.unique(np.round(x, 6))) for x in (stored(wall), stored(wall, scales=[0.001] * 3))]
print(*given, "m become", *(f"{value:.2f}" for value in stored(given)), end="; ")
print(f"layers of a wall with 2 mm noise: {layers[0]}, at 1 mm {layers[1]}")
assert np.allclose(stored(given), [10.0, 10.0, 10.01], atol=1e-9), "the behavior has changed"
assert layers[0] <= 3 and layers[1] > 10, "the behavior has changed"
PYTHON
