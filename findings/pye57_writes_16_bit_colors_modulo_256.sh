#!/usr/bin/env bash
# pye57 0.4.19: write_scan_raw stores colors in 8 bits and wraps larger values, without an error. Colors
# of LAS files have 16 bits, so a cloud that goes from laspy to pye57 keeps the low byte of each value,
# which is noise: half gray (32768) becomes black, and a smooth ramp becomes stripes. Reading an E57 file
# with 16-bit colors does raise an error.
# Cure: divide colors by 256 before.
#
# Output seen:
# LAS: [0, 255, 256, 32768, 65535], E57: [0, 255, 0, 0, 255]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pye57==0.4.19 laspy==2.7.0 numpy==2.2.6
cd "$folder"
venv/bin/python - <<'PYTHON'
import laspy
import numpy as np
import pye57

red = np.array([0, 255, 256, 32768, 65535])
las = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
las.x, las.y, las.z = np.arange(5.0), np.zeros(5), np.zeros(5)
las.red = las.green = las.blue = red.astype(np.uint16)
las.write("a.las")

las = laspy.read("a.las")
columns = {f"cartesian{axis}": np.asarray(las[axis.lower()]) for axis in "XYZ"}
columns |= {f"color{name}": np.asarray(las[name.lower()]) for name in ("Red", "Green", "Blue")}
with pye57.E57("a.e57", mode="w") as file:
    file.write_scan_raw(columns)
with pye57.E57("a.e57") as file:
    found = file.read_scan(0, colors=True, ignore_missing_fields=True)["colorRed"]
print(f"LAS: {red.tolist()}, E57: {found.tolist()}")
assert np.asarray(las.red).tolist() == red.tolist(), "changed"
assert found.tolist() == (red % 256).tolist(), "the behavior has changed"
PYTHON
