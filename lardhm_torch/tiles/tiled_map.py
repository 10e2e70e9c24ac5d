"""A map larger than memory: a folder of tiles that answers as one map would."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import uncertainty
from lardhm_torch.hilbert_map import LardHilbertMap, check_axes, check_points
from lardhm_torch.tiles.grouping import lattice_parts, row_numbers, rows_by_number, shifted
from lardhm_torch.tiles.layout import (
    block_box,
    layout_of,
    needed_tiles,
    speaking_blocks,
)
from lardhm_torch.tiles.manifest import Manifest, read_manifest, tile_indices
from lardhm_torch.tiles.splitting import split_map
from lardhm_torch.tiles.store import Cache, DamagedTileError, TileStore, cluster_bytes, joined

MEMORY_LIMIT = 1 << 30  # bytes of clusters held at a time
WHOLE = ("weights", "centers", "raw_scale_tril", "scale_tril", "is_occupied", "counts")
SAME_FRAME = 512.0  # [m] from the origin; there float32 rounds to 30 micrometers
POINTS_AT_ONCE = 1 << 22  # points sorted by block at a time
NUMBERS_AT_ONCE = 1 << 18  # points whose blocks are looked up at a time


class TiledMap:
    """Answers like a `LardHilbertMap` of all tiles together, and reads only those it needs.

    Points are grouped by blocks of a few tiles. A block is answered by one map of its own tiles and
    of all others near enough to have a say (`layout` says which, and why the answers are those of
    the whole map). Blocks and tiles stay in memory until the limit is reached; those unused longest
    go first. Where no tile speaks nothing is read: probability 1/2.

    A damaged tile raises `DamagedTileError` where its clusters might have a say; elsewhere the map
    answers as before. Opened with ``skip_damaged`` it warns and goes on as if the tile were empty.

    `merge` makes an ordinary map, of all or of a part; `weights`, `centers` and the other tensors
    of a map are those of the whole, if it fits the memory limit.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        manifest: Manifest,
        *,
        memory_limit: int = MEMORY_LIMIT,
        skip_damaged: bool = False,
        device: Any = None,
    ) -> None:
        if not memory_limit > 0:
            raise ValueError(f"memory_limit must be > 0 bytes; got {memory_limit}")
        self.folder = Path(folder)
        self.manifest = manifest
        self.memory_limit = int(memory_limit)
        self.dim = manifest.dim
        self.num_neighbors = int(manifest.settings["num_neighbors"])
        self.covariance_scale = float(manifest.settings["covariance_scale"])
        self.settings = dict(manifest.settings)
        self.origin = torch.tensor(manifest.origin, dtype=torch.float64, device=device)
        self._store = TileStore(folder, manifest, skip_damaged=skip_damaged, device=device)
        self._layout = layout_of(manifest)
        self._blocks = speaking_blocks(self._layout)
        self._block_indices = self._blocks.indices()
        self._cache = Cache(self.memory_limit)
        self._block_rows: dict[int, Tensor] = {}  # tiles by block
        self._missing: dict[Any, dict[int, DamagedTileError]] = {}  # damaged tiles by joined map

    @classmethod
    def open(
        cls,
        folder: str | os.PathLike[str],
        *,
        memory_limit: int = MEMORY_LIMIT,
        skip_damaged: bool = False,
        device: Any = None,
    ) -> TiledMap:
        """Read the manifest; tiles are read when they are needed.

        Args:
            folder: of a tiled map.
            memory_limit: bytes of clusters that are held at a time.
            skip_damaged: warn of damaged tiles and go on without them.
            device: of the answers; left out: the CPU.

        Raises:
            FileNotFoundError: the folder holds no manifest.
            ValueError: the manifest is damaged; the error names the field.
        """
        manifest = read_manifest(folder)
        options = {"memory_limit": memory_limit, "skip_damaged": skip_damaged, "device": device}
        return cls(folder, manifest, **options)

    @staticmethod
    def split(model: LardHilbertMap, folder: str | os.PathLike[str], edge: float) -> TiledMap:
        """Write an ordinary map as a folder of tiles, and open it.

        Clusters go to the tile that their center is in; nothing is rounded, so that `merge` gives
        the map back, in the order of the tiles.

        Args:
            model: a fitted map.
            folder: a new or empty one.
            edge: of a tile [m].

        Raises:
            ValueError: the map is empty, or edge is not > 0.
            FileExistsError: the folder holds a tiled map already.
        """
        split_map(model, folder, edge)
        return TiledMap.open(folder)

    # --- what the map is ---

    def __len__(self) -> int:
        """Number of clusters of all tiles."""
        return int(self._layout.counts.sum())

    def __repr__(self) -> str:
        """What `print(model)` shows."""
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        tiles = len(self._layout.indices)
        return (
            f"TiledMap({str(self.folder)!r}, {tiles} tiles, num_clusters={len(self)}, {settings})"
        )

    def __getattr__(self, name: str) -> Any:
        """Tensors of the whole map: those of `merge()`, if that fits the memory limit."""
        if name not in WHOLE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._whole(), name)

    # --- what the map answers ---

    def __call__(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy."""
        return self._ask(points, lambda model, part: model(part), 0.5)

    def log_odds(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy."""
        return self._ask(points, lambda model, part: model.log_odds(part), 0.0)

    def variance(self, points: Tensor) -> Tensor:
        """As `LardHilbertMap.variance`; the tiles' posteriors must be there."""
        return self._ask(
            points, lambda model, part: model.variance(part), uncertainty.PRIOR_VARIANCE
        )

    def bayesian_probability(self, points: Tensor) -> Tensor:
        """As `LardHilbertMap.bayesian_probability`; the tiles' posteriors must be there."""
        return self._ask(points, lambda model, part: model.bayesian_probability(part), 0.5)

    @torch.no_grad()
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """As `LardHilbertMap.query_lattice`, block by block."""
        check_axes(axes, self.dim)
        shape, silent = [len(axis) for axis in axes], 0.5 if probability else 0.0
        result = torch.full(shape, silent, dtype=self._store.dtype, device=self._store.device)
        for place in lattice_parts(axes, self._layout.origin, self._layout.block_edge):
            part = [axis[rows] for axis, rows in zip(axes, place, strict=True)]
            corner = torch.stack([axis[0].double().cpu() for axis in part])
            number = int(self._number(corner[None])[0])
            if number >= 0:
                ends = torch.stack([torch.stack([a.min(), a.max()]) for a in part]).double().cpu()
                model = self._block(number, ends[:, 0], ends[:, 1])
                result[place] = model.query_lattice(part, probability=probability)
        return result

    def pieces(self) -> Iterator[LardHilbertMap]:
        """The tiles' own maps, one after the other."""
        return (self._tile(row) for row in range(len(self._layout.indices)))

    def merge(self, bounds: tuple[Any, Any] | None = None) -> LardHilbertMap:
        """An ordinary map that answers within ``bounds`` as this one does, in memory as a whole.

        Args:
            bounds: lower and upper corner (D,), world frame [m]; left out: everywhere.

        Raises:
            DamagedTileError: a tile that it needs is damaged.
            ValueError: bounds are not two corners, lower <= upper.
        """
        if bounds is None:
            return self._joined(list(self.pieces()), self.origin)
        lower, upper = (torch.as_tensor(end, dtype=torch.float64).cpu() for end in bounds)
        good = lower.shape == upper.shape == (self.dim,)
        if not good or not bool((lower <= upper).all()):
            raise ValueError(
                f"bounds must be two corners of {self.dim} coordinates, lower <= upper; "
                f"got {lower.tolist()} and {upper.tolist()}"
            )
        rows = needed_tiles(self._layout, lower, upper).tolist()
        return self._joined([self._tile(row) for row in rows])

    @torch.no_grad()
    def local_parts(self, lower: Tensor, upper: Tensor) -> Iterator[tuple[Tensor, LardHilbertMap]]:
        """For N boxes, (N, D) world [m]: rows of those near each other, and a map for inside them.

        Raises:
            ValueError: a part does not fit the memory limit.
        """
        lower, upper = lower.detach().double().cpu(), upper.detach().double().cpu()
        middle = (lower + upper) / 2
        index = ((middle - self._layout.origin) / self._layout.block_edge).floor()
        _, owner, counts = index.unique(dim=0, return_inverse=True, return_counts=True)
        for rows in owner.argsort(stable=True).split(counts.tolist()):
            box = lower[rows].amin(dim=0), upper[rows].amax(dim=0)
            yield rows.to(self.origin.device), self._part(*box)

    # --- how ---

    def _ask(
        self, points: Tensor, answer: Callable[[LardHilbertMap, Tensor], Tensor], silent: float
    ) -> Tensor:
        """Answers of the blocks' maps at (..., D) points; ``silent`` where no tile speaks."""
        points = torch.as_tensor(points, device=self._store.device)
        check_points(points, self.dim)
        flat = points.reshape(-1, self.dim)
        result = torch.full((len(flat),), silent, dtype=self._store.dtype, device=flat.device)
        keeps_graph = torch.is_grad_enabled() and flat.requires_grad
        where, answers = [], []
        for number, rows in self._rows_by_block(flat.detach(), result):
            part = flat[rows]
            corners = part.detach().double()
            model = self._block(number, corners.amin(0).cpu(), corners.amax(0).cpu())
            if len(model) == 0:
                continue
            if keeps_graph:
                where.append(row_numbers(rows, flat.device))
                answers.append(answer(model, part))
            else:
                result[rows] = answer(model, part)
        if keeps_graph:  # one node of the graph, however many blocks
            result = result + 0.0 * torch.nan_to_num(flat, 0.0, 0.0, 0.0).sum(dim=1).to(
                result.dtype
            )
            if where:
                result = result.index_copy(0, torch.cat(where), torch.cat(answers))
        return result.reshape(points.shape[:-1])

    def _rows_by_block(self, flat: Tensor, result: Tensor) -> Iterator[tuple[int, slice | Tensor]]:
        """Number of a block and rows of its points, for all points that any tile has a say in.

        Points that are not finite get NaN in the result.
        """
        for start in range(0, len(flat), POINTS_AT_ONCE):
            part = flat[start : start + POINTS_AT_ONCE]
            numbers = torch.cat([self._number(some) for some in part.split(NUMBERS_AT_ONCE)])
            bad = ~part.isfinite().all(dim=1)
            result[start : start + len(part)][bad] = torch.nan
            for number, rows in rows_by_number(numbers.masked_fill_(bad, -1)):
                yield number, shifted(rows, start)

    def _number(self, points: Tensor) -> Tensor:
        """(N, D) world positions -> (N,) int32 number of the block of each, -1 where none speaks."""
        index = tile_indices(points, self._layout.origin, self._layout.block_edge)
        return self._blocks.find(index)

    def _block(self, number: int, lower: Tensor, upper: Tensor) -> LardHilbertMap:
        """The map that answers in a block; damage matters only to the box asked for, (D,) to (D,)."""
        if number not in self._block_rows:
            box = block_box(self._layout, self._block_indices[number])
            self._block_rows[number] = needed_tiles(self._layout, *box)
        return self._map_of(self._block_rows[number], lower, upper)

    def _part(self, lower: Tensor, upper: Tensor) -> LardHilbertMap:
        """The map that answers in a box (D,) to (D,): that of a block, if the box lies in one."""
        corners = torch.stack([lower, upper])
        first, last = tile_indices(corners, self._layout.origin, self._layout.block_edge)
        number = int(self._blocks.find(first[None])[0])
        if torch.equal(first, last) and number >= 0:
            return self._block(number, lower, upper)
        return self._map_of(needed_tiles(self._layout, lower, upper), lower, upper)

    def _map_of(self, rows: Tensor, lower: Tensor, upper: Tensor) -> LardHilbertMap:
        """One map of tiles (S,), kept; an error if one that the box (D,) to (D,) needs is damaged."""
        key = ("joined", *rows.tolist())
        model = self._cache.get(key)
        if model is None:
            self._make_room(rows, "the tiles that answer here")
            tiles, missing = [], {}
            for row in rows.tolist():
                try:
                    tiles.append(self._tile(row))
                except DamagedTileError as error:
                    missing[row] = error
            model = self._joined(tiles)
            self._cache.put(key, model)
            self._missing[key] = missing
        if self._missing[key]:
            for row in needed_tiles(self._layout, lower, upper).tolist():
                if row in self._missing[key]:
                    raise self._missing[key][row]
        return model

    def _tile(self, row: int) -> LardHilbertMap:
        index = self._layout.indices[row]
        model = self._cache.get(index)
        if model is None:
            model = self._store.load(index)
            self._cache.put(index, model)
        return model

    def _joined(self, tiles: list[LardHilbertMap], origin: Tensor | None = None) -> LardHilbertMap:
        """One map of tiles.

        Near the map's origin it has that frame, like the whole in one piece: in another, float32
        would round points and centers otherwise, and who is the k-th nearest is sometimes a matter
        of the last digit. Farther away that frame would lose what float32 can tell apart in one
        amid the tiles.
        """
        if origin is None:
            origin = self.origin
            if tiles:
                origins = torch.stack([tile.origin for tile in tiles])
                lower, upper = origins.amin(dim=0), origins.amax(dim=0)
                far = torch.maximum(upper - self.origin, self.origin - lower).max()
                if far > SAME_FRAME:
                    origin = ((lower + upper) / 2).round()
        model = joined(tiles, self.settings, origin)
        return model.to(self._store.device, self._store.dtype)

    def _make_room(self, rows: Tensor, what: str) -> None:
        """Forget what is unused longest, so that these tiles and what they make fit the limit."""
        clusters = int(self._layout.counts[rows].sum())
        needed = 2 * clusters * cluster_bytes(self.dim, self._store.dtype)
        if needed > self.memory_limit:
            raise ValueError(
                f"memory_limit must be {needed} bytes or more to hold {what}; "
                f"got {self.memory_limit}"
            )
        there = [self._cache.get(self._layout.indices[row]) for row in rows.tolist()]
        clusters = 2 * clusters - sum(len(tile) for tile in there if tile is not None)
        self._cache.make_room(clusters * cluster_bytes(self.dim, self._store.dtype))

    def _whole(self) -> LardHilbertMap:
        model = self._cache.get("whole")
        if model is None:
            rows = torch.arange(len(self._layout.indices))
            self._make_room(rows, "all clusters, which are asked for")
            model = self.merge()
            self._cache.put("whole", model)
        return model


def open_map(path: str | os.PathLike[str]) -> LardHilbertMap | TiledMap:
    """The map of a file, or the tiled map of a folder.

    Raises:
        FileNotFoundError: there is no such file, or the folder holds no manifest.
        ValueError: the file or the manifest is damaged.
    """
    return TiledMap.open(path) if Path(path).is_dir() else LardHilbertMap.load(path)
