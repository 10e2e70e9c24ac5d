#!/usr/bin/env bash
# pyproj 3.7.2 (PROJ, as in its wheel): heights above the ellipsoid, as GNSS receivers give them, are to
# become heights above sea level (EGM2008, EGM96). This needs a grid of the geoid, which the wheel does
# not contain, and the network is off by default. Transformer.from_crs then returns the same heights,
# without an error or a warning, also with only_best=True; accuracy is -1 and the description says
# "ballpark". The geoid lies up to 100 m from the ellipsoid, so clouds of GNSS scans and terrain
# models end up on different floors. It is intended (PROJ issue 1743). allow_ballpark=False raises an error:
# use it, and install the grid.
#
# Output seen:
#   EGM2008: 100.0 m -> 100.0 m, only_best 100.0 m, accuracy -1.0, 0 warnings
#   EGM96: 100.0 m -> 100.0 m, only_best 100.0 m, accuracy -1.0, 0 warnings
#   allow_ballpark=False: ProjError, ProjError
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pyproj==3.7.2
PROJ_NETWORK=OFF "$folder/venv/bin/python" - <<'PYTHON'
import warnings

from pyproj import Transformer
from pyproj.exceptions import ProjError

refused = []
for name, target in {"EGM2008": "EPSG:9518", "EGM96": "EPSG:4326+5773"}.items():
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        plain = Transformer.from_crs("EPSG:4979", target, always_xy=True)
        best = Transformer.from_crs("EPSG:4979", target, always_xy=True, only_best=True)
        heights = [chosen.transform(8.0, 50.0, 100.0)[2] for chosen in (plain, best)]
    print(f"{name}: 100.0 m -> {heights[0]:.1f} m, only_best {heights[1]:.1f} m,", end=" ")
    print(f"accuracy {plain.accuracy}, {len(found)} warnings")
    assert heights == [100.0, 100.0] and not found, "the behavior has changed"
    try:
        Transformer.from_crs("EPSG:4979", target, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        refused.append(type(error).__name__)
print("allow_ballpark=False:", ", ".join(refused))
assert len(refused) == 2, "the behavior has changed"
PYTHON
