"""A map larger than memory: a folder of tiles that answers as one map would."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap, check_axes, check_points
from lardhm_torch.learning import posterior
from lardhm_torch.tiles.grouping import lattice_parts, row_numbers, rows_by_number
from lardhm_torch.tiles.manifest import Manifest, read_manifest
from lardhm_torch.tiles.parts import Parts
from lardhm_torch.tiles.splitting import split_map
from lardhm_torch.tiles.store import TileStore

MEMORY_LIMIT = 1 << 30  # bytes of clusters held at a time
WHOLE = ("weights", "centers", "raw_scale_tril", "scale_tril", "is_occupied", "counts")
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

    weights: Tensor  # these three by `__getattr__`
    centers: Tensor
    scale_tril: Tensor

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
        store = TileStore(folder, manifest, skip_damaged=skip_damaged, device=device)
        self._parts = Parts(store, self.memory_limit)
        self.origin = self._parts.origin

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
        return int(self._parts.layout.counts.sum())

    def __repr__(self) -> str:
        """What `print(model)` shows."""
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        tiles = len(self.manifest.tiles)
        return (
            f"TiledMap({str(self.folder)!r}, {tiles} tiles, num_clusters={len(self)}, {settings})"
        )

    def __getattr__(self, name: str) -> Any:
        """Tensors of the whole map: those of `merge()`, if that fits the memory limit."""
        if name not in WHOLE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._parts.whole(), name)

    # --- what the map answers ---

    def __call__(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy."""
        return self._ask(points, lambda model, part: model(part), 0.5)

    def log_odds(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy."""
        return self._ask(points, lambda model, part: model.log_odds(part), 0.0)

    def variance(self, points: Tensor) -> Tensor:
        """As `LardHilbertMap.variance`; the tiles' posteriors must be there."""
        return self._ask(points, lambda model, part: model.variance(part), posterior.PRIOR_VARIANCE)

    def bayesian_probability(self, points: Tensor) -> Tensor:
        """As `LardHilbertMap.bayesian_probability`; the tiles' posteriors must be there."""
        return self._ask(points, lambda model, part: model.bayesian_probability(part), 0.5)

    @torch.no_grad()
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """As `LardHilbertMap.query_lattice`, block by block."""
        check_axes(axes, self.dim)
        shape, silent = [len(axis) for axis in axes], 0.5 if probability else 0.0
        result = torch.full(shape, silent, dtype=self._dtype, device=self.origin.device)
        layout = self._parts.layout
        for place in lattice_parts(axes, layout.origin, layout.block_edge):
            part = [axis[rows] for axis, rows in zip(axes, place, strict=True)]
            ends = [torch.stack([axis[0], axis.min(), axis.max()]).double().cpu() for axis in part]
            corner, *box = torch.stack(ends, dim=1)
            number = int(self._parts.number(corner[None])[0])
            if number >= 0:
                model = self._parts.block(number, torch.stack(box))
                result[place] = model.query_lattice(part, probability=probability)
        return result

    def thickness_counts(self) -> Counter[int]:
        """As `surface.thickness_counts` of the merged map, from the manifest alone."""
        total: Counter[int] = Counter()
        for tile in self.manifest.tiles.values():
            total.update(tile.thickness_counts())
        return total

    def pieces(self) -> Iterator[LardHilbertMap]:
        """The tiles' own maps, one after the other."""
        return self._parts.pieces()

    def merge(self, bounds: tuple[Any, Any] | None = None) -> LardHilbertMap:
        """An ordinary map that answers within ``bounds`` as this one does, in memory as a whole.

        Args:
            bounds: lower and upper corner (D,), world frame [m]; left out: everywhere.

        Raises:
            DamagedTileError: a tile that it needs is damaged.
            ValueError: bounds are not two corners, lower <= upper.
        """
        if bounds is None:
            return self._parts.cut(None)
        lower, upper = (torch.as_tensor(end, dtype=torch.float64).cpu() for end in bounds)
        good = lower.shape == upper.shape == (self.dim,)
        if not good or not bool((lower <= upper).all()):
            raise ValueError(
                f"bounds must be two corners of {self.dim} coordinates, lower <= upper; "
                f"got {lower.tolist()} and {upper.tolist()}"
            )
        return self._parts.cut((lower, upper))

    @torch.no_grad()
    def local_parts(self, lower: Tensor, upper: Tensor) -> Iterator[tuple[Tensor, LardHilbertMap]]:
        """For N boxes, (N, D) world [m]: rows of those near each other, and a map for inside them.

        Raises:
            ValueError: a part does not fit the memory limit.
        """
        lower, upper = lower.detach().double().cpu(), upper.detach().double().cpu()
        middle = (lower + upper) / 2
        layout = self._parts.layout
        index = ((middle - layout.origin) / layout.block_edge).floor()
        _, owner, counts = index.unique(dim=0, return_inverse=True, return_counts=True)
        for rows in owner.argsort(stable=True).split(counts.tolist()):
            box = lower[rows].amin(dim=0), upper[rows].amax(dim=0)
            yield rows.to(self.origin.device), self._parts.box(*box)

    # --- how ---

    def _ask(
        self, points: Tensor, answer: Callable[[LardHilbertMap, Tensor], Tensor], silent: float
    ) -> Tensor:
        """Answers of the blocks' maps at (..., D) points; ``silent`` where no tile speaks."""
        points = torch.as_tensor(points, device=self.origin.device)
        check_points(points, self.dim)
        flat = points.reshape(-1, self.dim)
        result = torch.full((len(flat),), silent, dtype=self._dtype, device=flat.device)
        keeps_graph = torch.is_grad_enabled() and flat.requires_grad
        where, answers = [], []
        for number, rows in self._rows_by_block(flat.detach(), result):
            part = flat[rows] if isinstance(rows, slice) else flat.index_select(0, rows)
            model = self._parts.block(number, part)
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
        if len(flat) == 0:
            return
        numbers = torch.cat([self._parts.number(some) for some in flat.split(NUMBERS_AT_ONCE)])
        nowhere = (numbers < 0).nonzero().squeeze(1)  # all that are not finite are among them
        for rows in nowhere.split(NUMBERS_AT_ONCE):
            result[rows[~flat[rows].isfinite().all(dim=1)]] = torch.nan
        groups = rows_by_number(numbers)
        del numbers, nowhere
        yield from groups

    @property
    def _dtype(self) -> torch.dtype:
        return self._parts.store.dtype


def open_map(path: str | os.PathLike[str]) -> LardHilbertMap | TiledMap:
    """The map of a file, or the tiled map of a folder.

    Raises:
        FileNotFoundError: there is no such file, or the folder holds no manifest.
        ValueError: the file or the manifest is damaged.
    """
    return TiledMap.open(path) if Path(path).is_dir() else LardHilbertMap.load(path)
