#!/usr/bin/env bash
# A text file .xyz does not name its columns. trimesh 5.2.0 reads six columns as positions and
# colors, pymeshlab 2025.7.post1 as positions and normals, and neither looks at the values or warns:
# normals become 8-bit colors in trimesh (a component of -1 becomes 255, others 0, so that the cloud
# looks black), and colors become normals of length 255 in MeshLab. With four columns, positions and
# intensity, MeshLab returns an empty mesh without an error; trimesh leaves the intensity out.
#
# Output seen:
#   normals 0.0 0.6 0.8 and 0.0 0.0 -1.0: colors 0 0 0 and 0 0 255 in trimesh
#   colors 255 0 128 and 0 255 0: normals 255 0 128 and 0 255 0 in MeshLab
#   four columns, 2 points: trimesh 2, MeshLab 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q trimesh==5.2.0 pymeshlab==2025.7.post1 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import pymeshlab
import trimesh


def write(name: str, *columns: str) -> str:
    with open(name, "w") as file:
        file.writelines(f"{i} {i + 1} {i + 2} {text}\n" for i, text in enumerate(columns))
    return name


def meshlab_normals(name: str):
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(name)
    mesh = meshes.current_mesh()  # valid only as long as `meshes`
    return mesh.vertex_normal_matrix().copy() if mesh.vertex_number() else []


def words(rows) -> str:
    return " and ".join(" ".join(str(int(value)) for value in row) for row in rows)


normals = write("normals.xyz", "0.0 0.6 0.8", "0.0 0.0 -1.0")
colors = write("colors.xyz", "255 0 128", "0 255 0")
four = write("intensity.xyz", "100", "200")
black = words(trimesh.load(normals).colors[:, :3])
long = words(meshlab_normals(colors))
counts = len(trimesh.load(four).vertices), len(meshlab_normals(four))
print(f"normals 0.0 0.6 0.8 and 0.0 0.0 -1.0: colors {black} in trimesh")
print(f"colors 255 0 128 and 0 255 0: normals {long} in MeshLab")
print(f"four columns, 2 points: trimesh {counts[0]}, MeshLab {counts[1]}")
seen = (black, long, counts) == ("0 0 0 and 0 0 255", "255 0 128 and 0 255 0", (2, 0))
raise SystemExit(0 if seen else "the behavior has changed")
PYTHON
