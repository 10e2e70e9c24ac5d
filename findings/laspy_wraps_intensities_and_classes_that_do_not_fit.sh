#!/usr/bin/env bash
# laspy 2.7.0: intensities, colors and classes are cast to the integers of the format without a check and
# without a warning. A reflectance of 0 to 1, as many lidar drivers give it, becomes 0 everywhere; an
# intensity above 65535 starts again at 0, so that the brightest targets are dark; class 300 is class 44,
# and -1 ("no label") is 255. Fields of fewer bits, such as return_number, do raise an error.
# Cure: scale to the range of the format, and clip.
#
# Output seen:
#   intensity 0.2 0.9 1.0 -> 0 0 1; 65535 65536 70000 -> 65535 0 4464; class 2 300 -1 -> 2 44 255;
#   return_number 16: OverflowError; 0 warnings
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import laspy
import numpy as np

las = laspy.create(point_format=6, file_version="1.4")
las.x = las.y = las.z = np.zeros(3)


def stored(name: str, *values: float) -> list[int]:
    setattr(las, name, np.array(values))
    return np.array(getattr(las, name)).tolist()


with warnings.catch_warnings(record=True) as found:
    warnings.simplefilter("always")
    small = stored("intensity", 0.2, 0.9, 1.0)
    large = stored("intensity", 65535, 65536, 70000)
    classes = stored("classification", 2, 300, -1)
    try:
        checked = str(stored("return_number", 1, 16, 2))
    except OverflowError as error:
        checked = type(error).__name__
print("intensity 0.2 0.9 1.0 ->", *small, end="; ")
print("65535 65536 70000 ->", *large, end="; ")
print("class 2 300 -1 ->", *classes, end=";\n")
print(f"return_number 16: {checked}; {len(found)} warnings")
assert (small, large, classes) == ([0, 0, 1], [65535, 0, 4464], [2, 44, 255]), "the behavior has changed"
assert checked == "OverflowError" and not found, "the behavior has changed"
PYTHON
