#!/usr/bin/env bash
# trimesh 5.2.0: a text file .xyz with six columns is read as positions and colors, whatever the
# columns are. Normals, the usual second triple of MeshLab and CloudCompare exports, become 8-bit
# colors: components between -1 and 1 are cut to 0 or 1, and -1 becomes 255, so that the cloud looks
# black and the normals are lost without a warning.
#
# Output seen:
#   normals 0.0 0.6 0.8 and 0.0 0.0 -1.0 become the colors 0 0 0 and 0 0 255
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q trimesh==5.2.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import trimesh

with open("cloud.xyz", "w") as file:
    file.write("1 2 3 0.0 0.6 0.8\n4 5 6 0.0 0.0 -1.0\n")
colors = trimesh.load("cloud.xyz").colors[:, :3]
words = " and ".join(" ".join(str(int(value)) for value in row) for row in colors)
print(f"normals 0.0 0.6 0.8 and 0.0 0.0 -1.0 become the colors {words}")
raise SystemExit(0 if words == "0 0 0 and 0 0 255" else "the behavior has changed")
PYTHON
