#!/usr/bin/env bash
# laspy 2.7.0: convert() between the point formats 0 to 5 and 6 to 10 copies only dimensions of equal
# name. The scan angle is called scan_angle_rank (whole degrees) in the old formats and scan_angle
# (steps of 0.006 degrees) in the new ones, so that it becomes 0 in both directions, without a
# warning. Class 12 of the old formats ("overlap") stays a class, although the new ones have a flag
# for it. A ray of an airborne scan that is computed from the angle then points straight down.
# Copy the angle: new.scan_angle = numpy.round(old.scan_angle_rank / 0.006).
#
# Output seen:
#   format 1 -> 6: angles -15 0 20 degrees become 0 0 0, classes 2 12 5, overlap 0 0 0
#   format 6 -> 1: angles -15 0 18 degrees become 0 0 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import laspy
import numpy as np


def cloud(point_format: int, version: str) -> laspy.LasData:
    las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
    las.x = las.y = las.z = np.array([1.0, 2.0, 3.0])
    return las


def words(values) -> str:
    return " ".join(str(int(value)) for value in values)


old = cloud(1, "1.2")
old.scan_angle_rank = np.array([-15, 0, 20], dtype=np.int8)
old.classification = np.array([2, 12, 5], dtype=np.uint8)
new = laspy.convert(old, point_format_id=6)
print(f"format 1 -> 6: angles -15 0 20 degrees become {words(new.scan_angle)},", end=" ")
print(f"classes {words(new.classification)}, overlap {words(new.overlap)}")

modern = cloud(6, "1.4")
modern.scan_angle = np.array([-2500, 0, 3000], dtype=np.int16)
back = laspy.convert(modern, point_format_id=1)
print(f"format 6 -> 1: angles -15 0 18 degrees become {words(back.scan_angle_rank)}")
lost = not np.any(new.scan_angle) and not np.any(back.scan_angle_rank)
raise SystemExit(0 if lost and words(new.overlap) == "0 0 0" else "the behavior has changed")
PYTHON
