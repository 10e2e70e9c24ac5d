"""Files: scans in every format, maps, meshes and grids."""
