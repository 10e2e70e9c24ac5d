"""A lattice over a map, and its log-odds in blocks that are evaluated only where they are needed."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, native_map
from lardhm_torch.native.surfaces import cube_log_odds

BLOCK_CELLS = 8  # along an edge of a block
POINTS = BLOCK_CELLS + 1  # along an edge: neighboring blocks share a plane of points
SLOTS = 3 * POINTS**3  # lattice edges that start at a point of a block
MAX_BLOCKS = (1 << 62) // SLOTS
SLAB_BLOCKS = 1 << 26  # marked at a time


class Lattice:
    """Points at whole multiples of the resolution, in blocks with `BLOCK_CELLS` along each edge.

    Blocks are numbered in row-major order. A lattice edge belongs to the block of its first point;
    the last plane of points along an axis belongs to the last blocks.

    Args:
        first: (3,) int64, first point in multiples of the resolution.
        cells: (3,) int64 number of cells along each axis, at least 1.
        resolution: distance of the points [m].
        keep: keep all log-odds that were computed, for surfaces at other levels.
        core: (2, 3) int64, first and last point, in multiples of the resolution, of the box whose faces
            are wanted, if the map continues outside of it; None: it does not.
    """

    def __init__(
        self,
        first: np.ndarray,
        cells: np.ndarray,
        resolution: float,
        *,
        keep: bool = False,
        core: np.ndarray | None = None,
    ) -> None:
        self.first, self.cells, self.resolution, self.core = first, cells, resolution, core
        self.is_cut = core is not None
        self.shape = -(-cells // BLOCK_CELLS)
        if np.prod(self.shape.astype(np.float64)) > MAX_BLOCKS:
            raise ValueError(
                f"resolution must be larger for a map of {(cells * resolution).round(1)} m; "
                f"got {resolution} m"
            )
        self._axes = [
            torch.from_numpy(resolution * (start + np.arange(count * BLOCK_CELLS + 1)))
            for start, count in zip(first, self.shape, strict=True)
        ]
        self._kept: dict[int, np.ndarray] | None = {} if keep else None

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner (3,), world frame [m]."""
        ends = self.first, self.first + self.cells
        lower, upper = (torch.from_numpy(end * self.resolution) for end in ends)
        return lower, upper

    def in_core(self, points: np.ndarray) -> np.ndarray:
        """(N,) whether (N, 3) world positions [m] lie in the core."""
        assert self.core is not None
        low, high = self.core * self.resolution
        return ((points >= low) & (points <= high)).all(axis=1)

    def place(self, blocks: np.ndarray) -> np.ndarray:
        """(B,) numbers of blocks -> (B, 3) their first points, in cells from the first point."""
        return np.stack(np.unravel_index(blocks, self.shape), axis=1) * BLOCK_CELLS

    def boxes(self, blocks: np.ndarray) -> tuple[Tensor, Tensor]:
        """Lower and upper corners (B, 3) of blocks, world frame [m]."""
        lower = torch.from_numpy((self.first + self.place(blocks)) * self.resolution)
        return lower, lower + BLOCK_CELLS * self.resolution

    def blocks_at(self, points: np.ndarray) -> np.ndarray:
        """(B,) ascending numbers of the blocks that contain some of (N, 3) world positions [m]."""
        cell = np.floor(points / self.resolution) - self.first
        cell = cell[((cell >= 0) & (cell < self.cells)).all(axis=1)].astype(np.int64)
        return np.unique(np.ravel_multi_index((cell // BLOCK_CELLS).T, self.shape))

    def block_places(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world positions [m] -> (N, 3) int64 place of their blocks, also outside the lattice."""
        cell = np.floor(points / self.resolution).astype(np.int64) - self.first
        return cell // BLOCK_CELLS

    def marched_cells(self, blocks: np.ndarray) -> np.ndarray:
        """(B, 3) int64 number of cells of each block; fewer at the far end of the lattice."""
        return np.minimum(BLOCK_CELLS, self.cells - self.place(blocks))

    def owners(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) lattice points -> (N, 3) place of the block, in blocks, that each belongs to."""
        return np.minimum(points // BLOCK_CELLS, self.shape - 1)

    def is_border(self, blocks: np.ndarray) -> np.ndarray:
        """(B, n, n, n) whether points of blocks lie on the border of the lattice or outside."""
        places = self.place(blocks)[..., None] + np.arange(POINTS)  # (B, 3, n)
        x, y, z = ((places <= 0) | (places >= self.cells[:, None])).transpose(1, 0, 2)
        return x[:, :, None, None] | y[:, None, :, None] | z[:, None, None, :]

    def edge_keys(self, points: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """(N,) a number for each lattice edge, ascending with the number of its block.

        Args:
            points: (N, 3) first point of each edge, in cells from the first point of the lattice.
            axes: (N,) axis along which each edge runs.
        """
        owner = self.owners(points)
        local = points - owner * BLOCK_CELLS
        slot = 3 * np.ravel_multi_index(local.T, (POINTS,) * 3) + axes
        return SLOTS * np.ravel_multi_index(owner.T, self.shape) + slot

    def values(self, model: OccupancyMap, blocks: np.ndarray) -> np.ndarray:
        """(B, n, n, n) float32 log-odds at the points of blocks, n = `POINTS`."""
        if self._kept is None:
            return self._evaluate(model, blocks)
        missing = np.array([b for b in blocks.tolist() if b not in self._kept], dtype=np.int64)
        if len(missing):
            self._kept.update(zip(missing.tolist(), self._evaluate(model, missing), strict=True))
        return np.stack([self._kept[block] for block in blocks.tolist()])

    @torch.no_grad()
    def _evaluate(self, model: OccupancyMap, blocks: np.ndarray) -> np.ndarray:
        firsts, tensors = torch.from_numpy(self.place(blocks)), native_map(model)
        if tensors is not None:
            return cube_log_odds(tensors, self._axes, firsts, POINTS).float().numpy()
        steps = torch.arange(POINTS)
        shape = (len(blocks), POINTS, POINTS, POINTS)
        points = torch.empty(*shape, 3, dtype=torch.float64)
        for axis, line in enumerate(self._axes):
            along = [1, 1, 1]
            along[axis] = POINTS
            points[..., axis] = line[firsts[:, axis, None] + steps].reshape(-1, *along)
        return model.log_odds(points.to(model.origin.device)).float().cpu().numpy()


_SLOT = np.arange(SLOTS)
_PLACES: np.ndarray = np.stack(
    np.unravel_index(_SLOT // 3, (POINTS,) * 3), axis=1
)  # (SLOTS, 3) in the block
_AXES = _SLOT % 3
_IS_OWNED = np.asarray((_PLACES < BLOCK_CELLS).all(axis=1))
_IS_ON_BORDER = np.asarray(((_PLACES == 0) | (_PLACES == BLOCK_CELLS)).any(axis=1))


class Edges(NamedTuple):
    """Lattice edges of a batch of blocks that the surface crosses.

    Attributes:
        points: (V, 3) int64 first point of each edge, in cells from the first point of the lattice.
        axes: (V,) axis along which each edge runs.
        shares: (V,) position of the crossing between its ends, 0 to 1.
        is_owned: (V,) whether the edge belongs to the block that found it.
        is_on_border: (V,) whether it lies on the surface of that block.
    """

    points: np.ndarray
    axes: np.ndarray
    shares: np.ndarray
    is_owned: np.ndarray
    is_on_border: np.ndarray

    @staticmethod
    def of(lattice: Lattice, blocks: np.ndarray, edges: np.ndarray, shares: np.ndarray) -> Edges:
        """From what `marching.march_blocks` returns for these blocks."""
        number = edges // SLOTS
        slot = edges - SLOTS * number
        first = lattice.place(blocks)
        points = first[number] + _PLACES[slot]
        is_owned, is_on_border = _IS_OWNED.take(slot), _IS_ON_BORDER.take(slot)
        at_end = np.asarray((first + BLOCK_CELLS >= lattice.cells).any(axis=1))
        rows = np.flatnonzero(at_end[number])  # there are blocks that own more and are smaller
        local, last = _PLACES[slot[rows]], lattice.marched_cells(blocks)[number[rows]]
        is_owned[rows] = ((local < last) | (points[rows] == lattice.cells)).all(axis=1)
        is_on_border[rows] |= (local == last).any(axis=1)
        return Edges(points, _AXES[slot], shares, is_owned, is_on_border)

    def select(self, rows: np.ndarray) -> Edges:
        """The edges of some rows or of a mask."""
        return Edges(*(column[rows] for column in self))

    def crossings(self, lattice: Lattice) -> np.ndarray:
        """(V, 3) float64 positions of the crossings, world frame [m]."""
        along = np.zeros(self.points.shape)
        along[np.arange(len(along)), self.axes] = self.shares
        return (lattice.first + self.points + along) * lattice.resolution

    def touching_blocks(self, lattice: Lattice) -> np.ndarray:
        """Ascending numbers of all blocks that contain one of the edges."""
        owner = lattice.owners(self.points)
        on_border = (self.points == owner * BLOCK_CELLS) & (owner > 0)
        on_border[np.arange(len(owner)), self.axes] = False
        found = []
        for shift in itertools.product((0, 1), repeat=3):
            rows = on_border[:, np.flatnonzero(shift)].all(axis=1)
            found.append(owner[rows] - np.array(shift))
        return np.unique(np.ravel_multi_index(np.concatenate(found).T, lattice.shape))


def blocks_near_boxes(
    lattice: Lattice, lower: Tensor, upper: Tensor, part: tuple[slice, ...] | None = None
) -> np.ndarray:
    """Ascending numbers of the blocks that any of N boxes touches.

    Args:
        lattice: that the blocks belong to.
        lower: (N, 3) lower corners of the boxes, world frame [m].
        upper: (N, 3) upper corners.
        part: ranges of blocks along the axes to which the search is limited; None: all.
    """
    scale = BLOCK_CELLS * lattice.resolution
    corner = lattice.first * lattice.resolution
    first, last = (np.floor((ends.cpu().numpy() - corner) / scale) for ends in (lower, upper))
    ranges = part or (slice(None),) * 3
    low, high = np.array([r.indices(n)[:2] for r, n in zip(ranges, lattice.shape, strict=True)]).T
    inside = ((last >= low) & (first < high)).all(axis=1)
    first, last = (
        first[inside].clip(low).astype(np.int64),
        last[inside].clip(max=high - 1).astype(np.int64),
    )
    thick = max(1, SLAB_BLOCKS // int((high - low)[1:].prod()))
    found = [np.zeros(0, dtype=np.int64)]
    for start in range(int(low[0]), int(high[0]), thick):
        end = min(start + thick, int(high[0]))
        touched = np.zeros((end - start, *(high - low)[1:]), dtype=bool)
        here = (last[:, 0] >= start) & (first[:, 0] < end)
        origin = np.array([start, low[1], low[2]])
        begins = (first[here] - origin).clip(min=0)
        for (i, j, k), (a, b, c) in zip(begins, last[here] - origin + 1, strict=True):
            touched[i:a, j:b, k:c] = True
        places = np.stack(touched.nonzero()) + origin[:, None]
        found.append(np.ravel_multi_index(tuple(places), lattice.shape))
    return np.concatenate(found)


def border_blocks(lattice: Lattice, lower: Tensor, upper: Tensor) -> np.ndarray:
    """Ascending numbers of the outermost blocks of the lattice that any of N boxes touches."""
    found = []
    for axis in range(3):
        for side in (slice(0, 1), slice(-1, None)):
            part = tuple(side if d == axis else slice(None) for d in range(3))
            found.append(blocks_near_boxes(lattice, lower, upper, part))
    return np.unique(np.concatenate(found))
