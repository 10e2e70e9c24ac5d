"""Which tiles are needed so that queries in a box give the results of the whole map.

Only the k nearest clusters contribute at a point. Queries in a box give the results of the whole map
if all clusters whose centers are within a radius r of the box are loaded, and one of these is true:

- *r is the largest support radius of the tiles that contribute in the box.* A cluster farther away
  contributes less than `entries.NEGLIGIBLE`. The k nearest of the loaded centers and the k nearest
  of all centers have the same members within r; their other members contribute at most k times that.
- *Every point of the box has at least k centers within r.* Then its k nearest centers are loaded, and
  the results are equal up to rounding.

Both radii follow from the bounds, cluster counts and support radii in the manifest, so that no tile
has to be opened. They are computed for tile-sized cells of the box, and the smaller one is used:
a single cluster with a large support does not require the whole map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.tiles.indexing import Index
from lardhm_torch.tiles.manifest import Manifest

BLOCK_CLUSTERS = 1 << 17  # of a block of tiles that is held as one map, about 20 MB
FLOAT32_RANGE = 512.0  # [m] from a frame's origin; float32 rounds positions there to 30 micrometers
_CELLS = 1 << 12  # in a box at most; larger boxes have larger cells
_PAIRS = 1 << 20  # of cells and tiles that are compared at a time
_SLACK = 1e-4  # [m] added to radii, because centers and points are rounded to float32


class Layout(NamedTuple):
    """Positions of the T tiles of a map; tensors are float64 on the CPU, in the order of indices.

    Args:
        indices: index of each tile.
        lower: (T, D) lower corner of the bounds of each tile's centers, world frame [m].
        upper: (T, D) upper corner [m].
        radius: (T,) largest support radius of each tile's clusters [m].
        counts: (T,) int64 number of clusters of each tile.
        origin: (D,) world position of the corner of the lowest tile [m].
        edge: edge length of a tile [m].
        num_neighbors: k.
        block_tiles: number of tiles along the edge of a block.
    """

    indices: list[Index]
    lower: Tensor
    upper: Tensor
    radius: Tensor
    counts: Tensor
    origin: Tensor
    edge: float
    num_neighbors: int
    block_tiles: int

    @property
    def block_edge(self) -> float:
        """Edge length of a block [m]."""
        return self.edge * self.block_tiles


def layout_of(manifest: Manifest) -> Layout:
    """The layout that a manifest describes."""
    indices = sorted(manifest.tiles)
    tiles = [manifest.tiles[index] for index in indices]
    dim = manifest.dim

    def corner(side: int) -> Tensor:
        rows = [tile.bounds[side] for tile in tiles]
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, dim)

    lowest = torch.tensor(indices or [(0,) * dim], dtype=torch.float64).amin(dim=0)
    counts = torch.tensor([tile.num_clusters for tile in tiles], dtype=torch.long)
    return Layout(
        indices=indices,
        lower=corner(0),
        upper=corner(1),
        radius=torch.tensor([tile.support_radius for tile in tiles], dtype=torch.float64),
        counts=counts,
        origin=torch.tensor(manifest.origin, dtype=torch.float64) + manifest.edge * lowest,
        edge=float(manifest.edge),
        num_neighbors=int(manifest.settings["num_neighbors"]),
        block_tiles=_block_tiles(indices, counts, manifest),
    )


def _block_tiles(indices: list[Index], counts: Tensor, manifest: Manifest) -> int:
    """Largest power of two for which no block exceeds `FLOAT32_RANGE` or `BLOCK_CLUSTERS`; or 1.

    The map of a block has one frame, in which float32 positions must be accurate.
    """
    if not indices:
        return 1
    rows = torch.tensor(indices, dtype=torch.long).reshape(-1, manifest.dim)
    rows = rows - rows.amin(dim=0)
    size = 1 << int(rows.max()).bit_length()

    def fits(size: int) -> bool:
        if size * manifest.edge > FLOAT32_RANGE:
            return False
        _, block = torch.unique(rows.div(size, rounding_mode="floor"), dim=0, return_inverse=True)
        return int(torch.bincount(block, counts.double()).max()) <= BLOCK_CLUSTERS

    while size > 1 and not fits(size):
        size //= 2
    return size


def needed_tiles(layout: Layout, lower: Tensor, upper: Tensor) -> Tensor:
    """(S,) rows of the tiles that suffice for queries in a box (D,) to (D,)."""
    gap = _gap(lower[None], upper[None], layout.lower, layout.upper)[0]
    contributes = gap <= layout.radius + _SLACK
    if not bool(contributes.any()):
        return contributes.nonzero().squeeze(1)
    near = (gap <= layout.radius[contributes].max() + _SLACK).nonzero().squeeze(1)
    needed = torch.zeros(len(near), dtype=torch.bool)
    for low, high in _cells(lower, upper, layout.edge, len(near)):
        needed |= _needed_by_cells(layout, near, low, high)
    return near[needed]


def _needed_by_cells(layout: Layout, near: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """(S,) whether any of (C, D) cells needs each of these tiles; see the top of the file."""
    first, last, support = layout.lower[near], layout.upper[near], layout.radius[near] + _SLACK
    gap = _gap(lower, upper, first, last)
    radius = torch.where(gap <= support, support, -1.0).amax(dim=1)
    sides = torch.maximum(upper[:, None] - first, last - lower[:, None])
    farthest = torch.linalg.vector_norm(sides, dim=2).sort(dim=1)
    known = layout.counts[near][farthest.indices].cumsum(dim=1) >= layout.num_neighbors
    position = known.to(torch.uint8).argmax(dim=1, keepdim=True)
    enough = farthest.values.gather(1, position).squeeze(1) + _SLACK
    radius = torch.where(known.any(dim=1), radius.minimum(enough), radius)
    return (gap <= radius[:, None]).any(dim=0)


def _gap(lower: Tensor, upper: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """(C, T) distance between boxes (C, D) and (T, D), 0 where they touch."""
    outside = torch.maximum(first - upper[:, None], lower[:, None] - last).clamp(min=0)
    return torch.linalg.vector_norm(outside, dim=2)


def _cells(
    lower: Tensor, upper: Tensor, edge: float, num_tiles: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Corners of the cells of a box, (C, D) and (C, D), in chunks."""
    while (
        math.prod(
            counts := [max(1, math.ceil(n - 1e-9)) for n in ((upper - lower) / edge).tolist()]
        )
        > _CELLS
    ):
        edge *= 1.5
    steps = [torch.arange(n, dtype=torch.float64) for n in counts]
    corners = lower + edge * torch.cartesian_prod(*steps).reshape(-1, len(lower))
    for low in corners.split(max(1, _PAIRS // num_tiles)):
        yield low, (low + edge).minimum(upper)


def support_boxes(layout: Layout) -> tuple[Tensor, Tensor]:
    """(T, D) corners of boxes outside of which a tile does not contribute, world frame [m]."""
    radius = (layout.radius + _SLACK)[:, None]
    return layout.lower - radius, layout.upper + radius
