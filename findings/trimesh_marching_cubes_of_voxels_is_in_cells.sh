#!/usr/bin/env bash
# trimesh 5.2.0 (scikit-image 0.26): VoxelGrid.points and bounds are in metres, but the mesh of the
# property marching_cubes is in cells, with the corner of the grid at the origin: pitch and place of
# the grid are not applied. Apply VoxelGrid.transform to the mesh, or use
# trimesh.voxel.ops.matrix_to_marching_cubes(matrix, pitch) and shift the result.
#
# Output seen:
#   a cube of 1 m at x = 10 m, cells of 0.1 m: grid 9.45 to 10.55, mesh -0.50 to 10.50,
#   mesh after the transform 9.45 to 10.55
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q trimesh==5.2.0 scikit-image==0.26.0 scipy numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import trimesh

box = trimesh.creation.box((1, 1, 1))
box.apply_translation((10, 0, 0))
grid = box.voxelized(0.1).fill()
mesh = grid.marching_cubes
moved = mesh.copy().apply_transform(grid.transform)


def words(bounds) -> str:
    return f"{bounds[0][0]:.2f} to {bounds[1][0]:.2f}"


print("a cube of 1 m at x = 10 m, cells of 0.1 m:", end=" ")
print(f"grid {words(grid.bounds)}, mesh {words(mesh.bounds)},")
print(f"mesh after the transform {words(moved.bounds)}")
in_cells = mesh.bounds[0][0] < 0 and words(moved.bounds) == words(grid.bounds)
raise SystemExit(0 if in_cells else "the behavior has changed")
PYTHON
