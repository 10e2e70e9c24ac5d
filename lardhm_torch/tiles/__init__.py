"""Maps too large for memory: a folder of tiles, each an ordinary map file, and a manifest."""
