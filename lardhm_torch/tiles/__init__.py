"""Maps larger than memory: a folder of tiles, each an ordinary map file, and one manifest."""
