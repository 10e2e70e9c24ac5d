"""Which tiles answer where: exactly those that hold one of a point's neighbors that speaks.

Of all clusters, only the k nearest of a point answer for it. A box of the world is answered like by
the whole map if all centers within a radius r of it are there, and either holds:

- *r is the largest reach of those that speak.* A center farther away contributes less than
  `reach.NEGLIGIBLE`, and among those within r the order of distances is the same with and without
  the ones beyond: the k nearest of the loaded centers and the k nearest of all have the same members
  within r, and their other members are k times negligible.
- *k centers are known to lie within r of every point of the box.* Then the k nearest are all there,
  and the answer is the same to the last bit but for rounding.

The manifest's bounds, numbers and reaches of the tiles give both radii without opening a tile. They
are taken for each tile-sized cell of a box on its own, and the smaller counts: one cluster of empty
space that reaches across the map does not call for the whole map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.tiles.manifest import Manifest
from lardhm_torch.tiles.places import Index

BLOCK_CLUSTERS = 1 << 17  # of a block of tiles that are held as one map, about 20 MB
BLOCK_EDGE = 512.0  # [m] at most, or one tile: a block has one frame, for float32 positions
_CELLS = 1 << 12  # of a box at most; larger boxes have larger cells
_PAIRS = 1 << 20  # of cells and tiles at a time
_SLACK = 1e-4  # [m] added to radii: centers and points are rounded to float32


class Layout(NamedTuple):
    """Where the T tiles of a map are, all float64 on the CPU, rows in the order of ``indices``.

    ``indices`` (T,) tuples; ``lower``, ``upper`` (T, D) bounds of the centers [m]; ``reach`` (T,)
    [m]; ``counts`` (T,) clusters; ``origin`` (D,) the corner of the lowest tile [m] and ``edge`` of
    a tile [m]; ``num_neighbors`` k; ``block_tiles`` along the edge of a block.
    """

    indices: list[Index]
    lower: Tensor
    upper: Tensor
    reach: Tensor
    counts: Tensor
    origin: Tensor
    edge: float
    num_neighbors: int
    block_tiles: int

    @property
    def block_edge(self) -> float:
        """Edge of a block [m]."""
        return self.edge * self.block_tiles


def layout_of(manifest: Manifest) -> Layout:
    """What the manifest says of where its tiles are."""
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
        reach=torch.tensor([tile.reach for tile in tiles], dtype=torch.float64),
        counts=counts,
        origin=torch.tensor(manifest.origin, dtype=torch.float64) + manifest.edge * lowest,
        edge=float(manifest.edge),
        num_neighbors=int(manifest.settings["num_neighbors"]),
        block_tiles=_block_tiles(indices, counts, manifest),
    )


def _block_tiles(indices: list[Index], counts: Tensor, manifest: Manifest) -> int:
    """Largest power of two with no block wider than `BLOCK_EDGE` or fuller than `BLOCK_CLUSTERS`."""
    if not indices:
        return 1
    places = torch.tensor(indices, dtype=torch.long).reshape(-1, manifest.dim)
    places = places - places.amin(dim=0)
    size = 1 << int(places.max()).bit_length()

    def fits(size: int) -> bool:
        if size * manifest.edge > BLOCK_EDGE:
            return False
        _, block = torch.unique(places.div(size, rounding_mode="floor"), dim=0, return_inverse=True)
        return int(torch.bincount(block, counts.double()).max()) <= BLOCK_CLUSTERS

    while size > 1 and not fits(size):
        size //= 2
    return size


def needed_tiles(layout: Layout, lower: Tensor, upper: Tensor) -> Tensor:
    """(S,) rows of the tiles that together answer in a box (D,) to (D,) as the whole map would."""
    gap = _gap(lower[None], upper[None], layout.lower, layout.upper)[0]
    speaks = gap <= layout.reach + _SLACK
    if not bool(speaks.any()):
        return speaks.nonzero().squeeze(1)
    near = (gap <= layout.reach[speaks].max() + _SLACK).nonzero().squeeze(1)
    needed = torch.zeros(len(near), dtype=torch.bool)
    for low, high in _cells(lower, upper, layout.edge, len(near)):
        needed |= _needed_by_cells(layout, near, low, high)
    return near[needed]


def _needed_by_cells(layout: Layout, near: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """(S,) whether any of (C, D) cells needs each of these tiles; see the top of the file."""
    first, last, reach = layout.lower[near], layout.upper[near], layout.reach[near] + _SLACK
    gap = _gap(lower, upper, first, last)
    radius = torch.where(gap <= reach, reach, -1.0).amax(dim=1)
    sides = torch.maximum(upper[:, None] - first, last - lower[:, None])
    farthest = torch.linalg.vector_norm(sides, dim=2).sort(dim=1)
    known = layout.counts[near][farthest.indices].cumsum(dim=1) >= layout.num_neighbors
    place = known.to(torch.uint8).argmax(dim=1, keepdim=True)
    enough = farthest.values.gather(1, place).squeeze(1) + _SLACK
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


class BlockKeys(NamedTuple):
    """The B blocks in which any tile speaks, as sorted numbers in the lattice over all of them."""

    first: Tensor  # (D,) index of the lowest block
    shape: tuple[int, ...]
    keys: Tensor  # (B,) int64

    def indices(self) -> Tensor:
        """(B, D) index of each block."""
        places = torch.unravel_index(self.keys, self.shape)
        return torch.stack(places, dim=1) + self.first

    def find(self, blocks: Tensor) -> Tensor:
        """(N, D) indices of blocks -> (N,) int32 number of each among the B, or -1."""
        shape = torch.tensor(self.shape, device=blocks.device)
        places = blocks - self.first.to(blocks.device)
        inside = ((places >= 0) & (places < shape)).all(dim=1)
        key = torch.zeros_like(places[:, 0])
        for axis, count in enumerate(self.shape):
            key = key * count + places[:, axis]
        keys = self.keys.to(blocks.device)
        number = torch.searchsorted(keys, key).clamp(max=max(0, len(keys) - 1))
        inside &= (keys[number] == key) if len(keys) else torch.zeros_like(inside)
        return torch.where(inside, number, -1).to(torch.int32)


def speaking_blocks(layout: Layout) -> BlockKeys:
    """The blocks within reach of any tile.

    Raises:
        ValueError: the tiles are so far apart that blocks cannot be numbered.
    """
    dim = len(layout.origin)
    if not layout.indices:
        empty = torch.zeros(0, dtype=torch.long)
        return BlockKeys(torch.zeros(dim, dtype=torch.long), (1,) * dim, empty)
    reach = (layout.reach + _SLACK)[:, None]
    first = ((layout.lower - reach - layout.origin) / layout.block_edge).floor().long()
    last = ((layout.upper + reach - layout.origin) / layout.block_edge).floor().long()
    lowest = first.amin(dim=0)
    shape = tuple(int(n) for n in last.amax(dim=0) - lowest + 1)
    if math.prod(shape) >= 1 << 62:
        raise ValueError(f"tiles must lie closer together; they span {shape} blocks")
    keys = []
    for low, high in zip((first - lowest).tolist(), (last - lowest).tolist(), strict=True):
        axes = [torch.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
        key = torch.zeros(1, dtype=torch.long)
        for axis, count in zip(axes, shape, strict=True):
            key = (key[:, None] * count + axis).reshape(-1)
        keys.append(key)
    return BlockKeys(lowest, shape, torch.cat(keys).unique())


def block_box(layout: Layout, block: Tensor) -> tuple[Tensor, Tensor]:
    """Corners (D,) and (D,) of a block of this index, world frame [m]."""
    lower = layout.origin + layout.block_edge * block.double()
    return lower, lower + layout.block_edge
