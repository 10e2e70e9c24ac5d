"""Queries of a map: grids, ray casting, collision probabilities and exploration."""
