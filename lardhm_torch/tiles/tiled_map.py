"""A map too large for memory: a folder of tiles that is queried like one map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch.channels import CLASS
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io.packed_files import is_packed
from lardhm_torch.learning import channel_queries, posterior
from lardhm_torch.learning.channel_queries import ChannelSums
from lardhm_torch.learning.channel_sums import Layout
from lardhm_torch.learning.points import check_axes, check_points
from lardhm_torch.tiles.blocks import lattice_parts, row_numbers, rows_by_number
from lardhm_torch.tiles.indexing import Folder
from lardhm_torch.tiles.local_maps import LocalMaps
from lardhm_torch.tiles.manifest import Manifest, read_manifest
from lardhm_torch.tiles.splitting import split_map
from lardhm_torch.tiles.store import TileStore

MEMORY_LIMIT = 1 << 30  # bytes of clusters in memory at a time
WHOLE = ("weights", "centers", "raw_scale_tril", "scale_tril", "is_occupied", "counts")
NUMBERS_AT_ONCE = 1 << 18  # points whose blocks are looked up at a time
Corner = Tensor | Sequence[float]


class TiledMap:
    """A map stored as a folder of tiles. Queries give the same results as one map of all tiles.

    Query points are grouped by blocks of a few tiles. For each block, a map of its own tiles and of
    all others that contribute there is loaded (`layout` explains why the results are those of the
    whole map). Tiles and maps stay in memory up to a limit; the least recently used are dropped.
    Where no tile contributes, nothing is read and the probability is 1/2.

    A damaged tile raises `DamagedTileError` in queries where its clusters may contribute; other
    queries work as before. With ``skip_damaged``, a warning is issued and the tile is treated as empty.

    `merge` returns an ordinary map of all tiles or of a box. The attributes `weights`, `centers`,
    `raw_scale_tril`, `scale_tril`, `is_occupied` and `counts` are those of the whole map, which
    must then fit the memory limit.

    Args:
        folder: folder of the tiled map.
        manifest: its manifest.
        memory_limit: bytes of clusters in memory at a time.
        skip_damaged: issue a warning for damaged tiles and continue without them.
        device: device of the results; None: the CPU.

    Raises:
        ValueError: memory_limit is not > 0.
    """

    weights: Tensor
    centers: Tensor
    raw_scale_tril: Tensor
    scale_tril: Tensor
    is_occupied: Tensor
    counts: Tensor

    def __init__(
        self,
        folder: Folder,
        manifest: Manifest,
        *,
        memory_limit: int = MEMORY_LIMIT,
        skip_damaged: bool = False,
        device: torch.device | str | None = None,
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
        self._local = LocalMaps(store, self.memory_limit)
        self.origin = self._local.origin

    @classmethod
    def open(
        cls,
        folder: Folder,
        *,
        memory_limit: int = MEMORY_LIMIT,
        skip_damaged: bool = False,
        device: torch.device | str | None = None,
    ) -> TiledMap:
        """Open a folder. Only the manifest is read; tiles are read when they are needed.

        Args:
            folder: folder of the tiled map.
            memory_limit: bytes of clusters in memory at a time.
            skip_damaged: issue a warning for damaged tiles and continue without them.
            device: device of the results; None: the CPU.

        Raises:
            FileNotFoundError: the folder has no manifest.
            ValueError: the manifest is damaged or has another format version.
        """
        manifest = read_manifest(folder)
        return cls(
            folder, manifest, memory_limit=memory_limit, skip_damaged=skip_damaged, device=device
        )

    @staticmethod
    def split(model: LardHilbertMap, folder: Folder, edge: float) -> TiledMap:
        """Write an ordinary map as a folder of tiles, and open it.

        A cluster belongs to the tile that contains its center. Nothing is rounded: `merge` returns
        the same map, with its clusters in the order of the tiles.

        Args:
            model: a fitted map.
            folder: a new or empty folder.
            edge: edge length of a tile [m].

        Raises:
            ValueError: the map is empty, or edge is not > 0.
            FileExistsError: the folder already contains a tiled map.
        """
        split_map(model, folder, edge)
        return TiledMap.open(folder)

    def __len__(self) -> int:
        """Number of clusters of all tiles."""
        return int(self._local.layout.counts.sum())

    def __repr__(self) -> str:
        """What `print(model)` shows."""
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        tiles = len(self.manifest.tiles)
        return (
            f"TiledMap({str(self.folder)!r}, {tiles} tiles, num_clusters={len(self)}, {settings})"
        )

    def __bool__(self) -> bool:
        """True, also for a map without clusters."""
        return True

    def __getattr__(self, name: str) -> Tensor:
        """A tensor of the whole map, if that fits the memory limit."""
        if name not in WHOLE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        tensor: Tensor = getattr(self._local.whole(), name)
        return tensor

    def __call__(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy."""
        return self._ask(points, lambda model, part: model(part), 0.5)

    def log_odds(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy."""
        return self._ask(points, lambda model, part: model.log_odds(part), 0.0)

    def variance(self, points: Tensor) -> Tensor:
        """`LardHilbertMap.variance`, if the map that was split has a posterior."""
        return self._ask(points, lambda model, part: model.variance(part), posterior.PRIOR_VARIANCE)

    def bayesian_probability(self, points: Tensor) -> Tensor:
        """`LardHilbertMap.bayesian_probability`, if the map that was split has a posterior."""
        return self._ask(points, lambda model, part: model.bayesian_probability(part), 0.5)

    @property
    def channel_layout(self) -> Layout:
        """Names of the channels, with the layout of each (`channel_sums`)."""
        return dict(self.manifest.channels)

    @property
    def channels(self) -> dict[str, ChannelSums]:
        """`LardHilbertMap.channels` of the whole map, if that fits the memory limit."""
        return self._local.whole().channels

    @property
    def classes(self) -> list[int]:
        """`LardHilbertMap.classes`."""
        return list(self.channel_layout.get(CLASS, ()))

    def channel(self, points: Tensor, name: str) -> Tensor:
        """`LardHilbertMap.channel`."""
        if name == CLASS:
            return self.class_probability(points)
        size = channel_queries.layout_entry(self.channel_layout, name)
        unknown = torch.full((size,) if size else (), torch.nan)
        return self._ask(points, lambda model, part: model.channel(part, name), unknown)

    def class_log_odds(self, points: Tensor) -> Tensor:
        """`LardHilbertMap.class_log_odds`."""
        classes = channel_queries.layout_entry(self.channel_layout, CLASS)
        unknown = channel_queries.prior_log_odds(len(classes), self.manifest.class_scale)
        return self._ask(points, lambda model, part: model.class_log_odds(part), unknown)

    def class_probability(self, points: Tensor) -> Tensor:
        """`LardHilbertMap.class_probability`."""
        return torch.softmax(self.class_log_odds(points), dim=-1)

    def class_posterior(self, points: Tensor) -> Tensor:
        """`LardHilbertMap.class_posterior`."""
        return channel_queries.joint_posterior(self(points), self.class_probability(points))

    @torch.no_grad()
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """`LardHilbertMap.query_lattice`, evaluated block by block."""
        check_axes(axes, self.dim)
        shape, unknown = [len(axis) for axis in axes], 0.5 if probability else 0.0
        result = torch.full(shape, unknown, dtype=self._dtype, device=self.origin.device)
        for slices in lattice_parts(axes, self._local.layout):
            part = [axis[rows] for axis, rows in zip(axes, slices, strict=True)]
            ends = [torch.stack([axis[0], axis.min(), axis.max()]).double().cpu() for axis in part]
            corner, *box = torch.stack(ends, dim=1)
            number = int(self._local.block_numbers(corner[None])[0])
            if number >= 0:
                model = self._local.of_block(number, torch.stack(box))
                result[slices] = model.query_lattice(part, probability=probability)
        return result

    def thickness_counts(self) -> Counter[int]:
        """`raycasting.thickness_counts` of the merged map; no tile is read."""
        total: Counter[int] = Counter()
        for tile in self.manifest.tiles.values():
            total.update(tile.thickness_counts())
        return total

    def pieces(self, bounds: tuple[Tensor, Tensor] | None = None) -> Iterator[LardHilbertMap]:
        """Maps of groups of tiles, one at a time; with the corners of a box only of those it needs."""
        return self._local.pieces(bounds)

    def merge(self, bounds: tuple[Corner, Corner] | None = None) -> LardHilbertMap:
        """An ordinary map, in memory, that equals this map in a box.

        Args:
            bounds: lower and upper corner (D,) of the box, world frame [m]; None: everywhere.

        Raises:
            DamagedTileError: a needed tile is damaged.
            ValueError: bounds are not two corners, lower <= upper.
        """
        if bounds is None:
            return self._local.merged(None)
        lower, upper = (torch.as_tensor(end, dtype=torch.float64).cpu() for end in bounds)
        good = lower.shape == upper.shape == (self.dim,)
        if not good or not bool((lower <= upper).all()):
            raise ValueError(
                f"bounds must be two corners of {self.dim} coordinates, lower <= upper; "
                f"got {lower.tolist()} and {upper.tolist()}"
            )
        return self._local.merged((lower, upper))

    def in_memory(self) -> LardHilbertMap:
        """The map of all tiles, kept in memory; a `ValueError` if it exceeds the memory limit."""
        return self._local.whole()

    @torch.no_grad()
    def local_parts(self, lower: Tensor, upper: Tensor) -> Iterator[tuple[Tensor, LardHilbertMap]]:
        """Groups of boxes that are near each other, and a map that is valid in each group.

        Args:
            lower: (N, D) lower corners of the boxes, world frame [m].
            upper: (N, D) upper corners [m].

        Yields:
            Rows of the boxes of a group, and a map.

        Raises:
            ValueError: the map of a group does not fit the memory limit.
        """
        lower, upper = lower.detach().double().cpu(), upper.detach().double().cpu()
        middle = (lower + upper) / 2
        layout = self._local.layout
        index = ((middle - layout.origin) / layout.block_edge).floor()
        _, owner, counts = index.unique(dim=0, return_inverse=True, return_counts=True)
        for rows in owner.argsort(stable=True).split(counts.tolist()):
            box = lower[rows].amin(dim=0), upper[rows].amax(dim=0)
            yield rows.to(self.origin.device), self._local.of_box(*box)

    def _ask(
        self,
        points: Tensor,
        answer: Callable[[LardHilbertMap, Tensor], Tensor],
        unknown: float | Tensor,
    ) -> Tensor:
        """Results of the blocks' maps at (..., D) points; ``unknown`` where no tile contributes."""
        unknown = torch.as_tensor(unknown, dtype=self._dtype, device=self.origin.device)
        points = torch.as_tensor(points, device=self.origin.device)
        check_points(points, self.dim)
        flat = points.reshape(-1, self.dim)
        result = unknown.expand(len(flat), *unknown.shape).clone()
        keeps_graph = torch.is_grad_enabled() and flat.requires_grad
        groups, answers = [], []
        for number, rows in self._rows_by_block(flat.detach(), result):
            part = flat[rows] if isinstance(rows, slice) else flat.index_select(0, rows)
            model = self._local.of_block(number, part)
            if len(model) == 0:
                continue
            if keeps_graph:
                groups.append(row_numbers(rows, flat.device))
                answers.append(answer(model, part))
            else:
                result[rows] = answer(model, part)
        if keeps_graph:  # a single node of the graph, independent of the number of blocks
            zero = 0.0 * torch.nan_to_num(flat, 0.0, 0.0, 0.0).sum(dim=1).to(result.dtype)
            result = result + zero.reshape(-1, *[1] * unknown.ndim)
            if groups:
                result = result.index_copy(0, torch.cat(groups), torch.cat(answers))
        return result.reshape((*points.shape[:-1], *unknown.shape))

    def _rows_by_block(self, flat: Tensor, result: Tensor) -> Iterator[tuple[int, slice | Tensor]]:
        """Number of each block in which a tile contributes, and the rows of its points.

        Sets the result to NaN for points that are not finite.
        """
        if len(flat) == 0:
            return
        numbers = torch.cat([self._local.block_numbers(p) for p in flat.split(NUMBERS_AT_ONCE)])
        outside = (numbers < 0).nonzero().squeeze(1)  # contains all points that are not finite
        for rows in outside.split(NUMBERS_AT_ONCE):
            result[rows[~flat[rows].isfinite().all(dim=1)]] = torch.nan
        groups = rows_by_number(numbers)
        del numbers, outside
        yield from groups

    @property
    def _dtype(self) -> torch.dtype:
        return self._local.store.dtype


def open_map(path: Folder) -> LardHilbertMap | TiledMap:
    """The map of a file or of a folder of packets, or the tiled map of a folder.

    Raises:
        FileNotFoundError: there is no such file, or the folder has no manifest.
        ValueError: the file or the manifest is damaged.
    """
    is_one_map = is_packed(path) or not Path(path).is_dir()
    return LardHilbertMap.load(path) if is_one_map else TiledMap.open(path)
