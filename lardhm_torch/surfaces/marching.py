"""Marching cubes on many small blocks at once.

A lattice corner is inside if its value is greater than the level. Faces separate inside from outside
corners, and their normals point outside. On a side of a cell with two diagonal inside corners, these
are joined; both cells of a side decide alike, so the surface has no cracks.
"""

from __future__ import annotations

import itertools
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from lardhm_torch.native import available
from lardhm_torch.native.surfaces import march_blocks as native_march

# Corner 4 i + 2 j + k of a cell is at (i, j, k). Edge 4 axis + n runs along the axis from its nth base
# corner, in ascending order of the corners.
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
EDGES = np.array(
    [(a, a + (4, 2, 1)[axis], axis) for axis in range(3) for a in range(8) if CORNERS[a][axis] == 0]
)  # (12, 3): first corner, last corner, axis


class Faces(NamedTuple):
    """Triangles of a batch of blocks with n lattice points along each edge.

    Attributes:
        edges: (V,) int64, for each vertex the lattice edge on which it lies:
            3 (n^3 block + n^2 i + n j + k) + axis, from point (i, j, k) of the block; ascending.
        shares: (V,) float32, its position between both ends of the edge, 0 to 1.
        faces: (F, 3) int32 vertices, counterclockwise seen from outside.
    """

    edges: np.ndarray
    shares: np.ndarray
    faces: np.ndarray


def march_blocks(values: np.ndarray, level: float, cells: np.ndarray) -> Faces:
    """Marching cubes on blocks of a lattice. Vertices are shared within a block.

    Args:
        values: (B, n, n, n) float32, finite.
        level: of the surface.
        cells: (B, 3) int64, number of cells to march in each block along each axis, at most n - 1.

    Returns:
        Vertices and faces, block by block.

    Source: Lorensen & Cline 1987.
    """
    if not available():
        return plain_march(values, level, cells)
    arrays = (torch.from_numpy(array) for array in (cells, case_table()))
    found = native_march(torch.from_numpy(values), level, *arrays)
    return Faces(*(tensor.numpy() for tensor in found))


def plain_march(values: np.ndarray, level: float, cells: np.ndarray) -> Faces:
    """`march_blocks` in NumPy."""
    count, n = values.shape[:2]
    inside = values > np.float32(level)
    steps = np.arange(n)
    within = [steps < cells[:, axis, None] for axis in range(3)]  # first corners of marched cells
    used = within[0][:, :, None, None] & within[1][:, None, :, None] & within[2][:, None, None, :]
    codes = np.zeros((count, n - 1, n - 1, n - 1), dtype=np.uint8)
    for bit, (i, j, k) in enumerate(CORNERS):
        part = inside[:, i : n - 1 + i, j : n - 1 + j, k : n - 1 + k]
        codes |= part.astype(np.uint8) << bit
    codes[~used[:, :-1, :-1, :-1]] = 0
    table = case_table()
    rows = np.flatnonzero((codes > 0) & (codes < 255))
    found = table[codes.reshape(-1)[rows]]  # (R, T, 3) edges of the triangles, -1: none
    cell, _ = np.nonzero(found[:, :, 0] >= 0)
    triangles = found[found[:, :, 0] >= 0]  # (F, 3)
    places = np.stack(np.unravel_index(rows[cell], codes.shape), axis=1)  # block, i, j, k
    point = np.asarray(np.ravel_multi_index(tuple(places.T), (count, n, n, n)))
    shift = CORNERS @ np.array([n * n, n, 1])
    keys = 3 * (point[:, None] + shift[EDGES[triangles, 0]]) + EDGES[triangles, 2]
    edges, faces = np.unique(keys, return_inverse=True)
    flat = values.reshape(-1)
    start, stride = edges // 3, np.array([n * n, n, 1])[edges % 3]
    low, high = flat[start], flat[start + stride]
    shares = (np.float32(level) - low) / (high - low)
    return Faces(edges, shares, faces.reshape(-1, 3).astype(np.int32))


@cache
def case_table() -> np.ndarray:
    """(256, T, 3) int8 edges of the triangles of each case; -1 where there are fewer than T.

    Bit c of the case tells whether corner c is inside.
    """
    cases = [_triangles(case) for case in range(256)]
    table = np.full((256, max(map(len, cases)), 3), -1, dtype=np.int8)
    for case, triangles in enumerate(cases):
        if triangles:
            table[case, : len(triangles)] = triangles
    return table


def _triangles(case: int) -> list[tuple[int, int, int]]:
    """Triangles of one case: the loops in which the surface crosses the sides of the cell, as fans."""
    following: dict[int, int] = {}
    for side in _sides():
        # crossed edges around the side, and whether the way around it leaves the inside there
        crossed = []
        for a, b in zip(side, side[1:] + side[:1], strict=True):
            if (case >> a & 1) != (case >> b & 1):
                crossed.append((_edge_between(a, b), bool(case >> a & 1)))
        for place, (edge, leaves) in enumerate(crossed):
            if leaves:  # around the outside corners up to the next edge: those inside are joined
                following[edge] = crossed[(place + 1) % len(crossed)][0]
    triangles = []
    while following:
        loop = [next(iter(following))]
        while (edge := following.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        triangles += _fan(loop)
    return triangles


def _fan(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a polygon; if possible, no diagonal lies in a side of the cell.

    A diagonal in a side could coincide with one of the neighboring cell.
    """

    def diagonals_in_sides(apex: int) -> int:
        others = [loop[(apex + step) % len(loop)] for step in range(2, len(loop) - 1)]
        return sum(_share_a_side(loop[apex], other) for other in others)

    apex = min(range(len(loop)), key=diagonals_in_sides)
    turned = loop[apex:] + loop[:apex]
    return [(turned[0], turned[i + 1], turned[i]) for i in range(1, len(turned) - 1)]


def _sides() -> list[list[int]]:
    """Corners of the six sides of a cell, counterclockwise seen from outside."""
    sides = []
    for axis in range(3):
        u, v = (1 << 2 - (axis + 1) % 3), (1 << 2 - (axis + 2) % 3)
        around = [0, u, u + v, v]  # counterclockwise seen from the positive end of the axis
        sides += [around[::-1], [corner + (1 << 2 - axis) for corner in around]]
    return sides


def _edge_between(a: int, b: int) -> int:
    first, last = min(a, b), max(a, b)
    return next(e for e, (c, d, _) in enumerate(EDGES) if (c, d) == (first, last))


def _share_a_side(first: int, second: int) -> bool:
    corners = {*EDGES[first][:2].tolist(), *EDGES[second][:2].tolist()}
    return any(corners <= set(side) for side in _sides())
