"""Scans of any length to training points per tile, on disk, read and sampled a piece at a time."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lardhm_torch.fitting import FitConfig
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.sampling import SamplingConfig, sample_rays, usable_rays
from lardhm_torch.scans import Scans
from lardhm_torch.tiles.cutting import Grid, grid_origin, route
from lardhm_torch.tiles.manifest import MANIFEST_NAME, Manifest, read_manifest, write_manifest
from lardhm_torch.tiles.places import Index
from lardhm_torch.tiles.samples import (
    LEDGER_NAME,
    Counts,
    Ledger,
    Records,
    append_records,
    appending,
    count_records,
    read_ledger,
    write_ledger,
)

BUFFER_BYTES = 1 << 28  # records held before they are appended to their files


@dataclass(frozen=True, kw_only=True)
class TilingConfig:
    """How the world is cut into tiles, and how scans become training points."""

    edge: float = 20.0  # [m] of a tile
    halo: float | None = (
        None  # [m] around a tile, trained with it; None: 0.5 m, half an edge at most
    )
    seed: int = 0  # of everything random; piece n of the scans is sampled with seed + n
    num_neighbors: int | None = None  # k of the maps; None: the default
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    fitting: FitConfig = field(default_factory=FitConfig)  # batch_size None: N / 128, at least 64

    def __post_init__(self) -> None:
        if not 0 < self.edge < float("inf"):
            raise ValueError(f"edge must be > 0 m and finite; got {self.edge}")
        if self.halo is not None and not 0 <= self.halo <= self.edge / 2:
            raise ValueError(f"halo must be 0 to half an edge, {self.edge / 2}; got {self.halo}")


def tile_scans(
    pieces: Iterable[Scans],
    folder: str | os.PathLike[str],
    config: TilingConfig | None = None,
    *,
    progress: bool = False,
) -> Ledger:
    """Sample scans and route the training points to the tiles of a new folder.

    Memory is that of one piece and of `BUFFER_BYTES`. A run that was killed goes on where its last
    points were written if it is called again with the same pieces, and ends with the same files.
    Tiles begin at odd multiples of half an edge, so that the ground of a map near height 0 is not
    cut, and so that any two folders with one edge and one world frame can be joined.

    Args:
        pieces: scans in pieces that fit in memory (`lardhm_torch.io.iter_pieces`).
        folder: is made; must not hold a tiled map that is complete.
        config: edge, halo, seed, sampling.
        progress: show a bar with the rate on a terminal.

    Returns:
        What is in each tile.

    Raises:
        ValueError: the folder holds something else, the pieces are not those that it was begun
            with, they differ in dimension, or no ray of all is usable.
    """
    config, path = config or TilingConfig(), Path(folder)
    pieces = iter(pieces)
    first = next(pieces, None)
    if first is None:
        raise ValueError("pieces must hold at least one Scans; got none")
    manifest = _begin(path, first, config)
    with appending(path, manifest.dim) as ledger:
        router = _Router(path, manifest, config.sampling, ledger)
        for piece in _watched(itertools.chain([first], pieces), progress):
            router.take(piece)
        return router.finish()


def add_scans(
    pieces: Iterable[Scans], folder: str | os.PathLike[str], *, progress: bool = False
) -> tuple[Ledger, list[Index]]:
    """Route more scans to the tiles of a folder: all of them or, if anything fails, none.

    Returns:
        What is in each tile now, and the tiles whose cores got new points, in order.

    Raises:
        FileNotFoundError, ValueError: the folder is not one that `tile_scans` completed, or as
            `tile_scans`.
    """
    manifest = read_manifest(folder)
    with appending(folder, manifest.dim) as before:
        if not before.complete:
            raise ValueError(
                f"{folder} must be complete before scans are added; run `lardhm tile` to its end"
            )
        router = _Router(Path(folder), manifest, SamplingConfig(**manifest.sampling), before)
        for piece in _watched(pieces, progress):
            router.take(piece)
        after = router.finish()
    nothing = Counts()
    return after, [
        i for i in after.cores if after.tiles[i].core > before.tiles.get(i, nothing).core
    ]


def _watched(pieces: Iterable[Scans], progress: bool) -> Iterator[Scans]:
    """The pieces, with a bar of their rays."""
    with tqdm(desc="rays", unit="ray", unit_scale=True, disable=None if progress else True) as bar:
        for piece in pieces:
            yield piece
            bar.update(len(piece))


def _begin(path: Path, first: Scans, config: TilingConfig) -> Manifest:
    """The manifest of a new folder, or of one that was begun with the same settings."""
    neighbors = {} if config.num_neighbors is None else {"num_neighbors": config.num_neighbors}
    manifest = Manifest(
        edge=config.edge,
        halo=min(0.5, config.edge / 2) if config.halo is None else config.halo,
        origin=grid_origin(first.origins[0], config.edge),
        settings=LardHilbertMap(first.dim, **neighbors).settings,
        sampling=asdict(config.sampling),
        fitting=asdict(config.fitting),
        seed=config.seed,
    )
    if (path / MANIFEST_NAME).is_file():
        begun = read_ledger(path)
        if begun.complete:
            raise ValueError(
                f"folder must be new; {path} holds a tiled map. `lardhm update` adds scans to it"
            )
        if begun.chunks and read_manifest(path) != manifest:
            raise ValueError(
                f"folder must be new, or begun with the same scans and settings; {path} was not"
            )
        write_manifest(path, manifest)
        return manifest
    path.mkdir(parents=True, exist_ok=True)
    others = [entry.name for entry in path.iterdir() if entry.name != LEDGER_NAME]
    if others:
        raise ValueError(f"folder must be new or empty; {path} holds {others[0]}")
    write_ledger(path, Ledger())
    write_manifest(path, manifest)
    return manifest


class _Router:
    """Pieces of scans into the sample files of a folder.

    The pieces of a new folder are counted from 0, and those that a killed run has routed already are
    passed over. Those of an addition are counted on, so that no random number is drawn twice, and
    count only once all are routed.
    """

    def __init__(
        self, folder: Path, manifest: Manifest, sampling: SamplingConfig, done: Ledger
    ) -> None:
        self.folder, self.manifest, self.sampling = folder, manifest, sampling
        self.grid = Grid(manifest.origin, manifest.edge, manifest.halo)
        self.done, self.adds, self.tiles = done, done.complete, dict(done.tiles)
        self.chunks, self.rays = (done.chunks, done.rays) if self.adds else (0, 0)
        self.buffers: dict[Index, list[Records]] = {}
        self.buffered = 0

    def take(self, piece: Scans) -> None:
        """Sample one piece and keep its points, in memory or on disk."""
        if piece.dim != self.manifest.dim:
            raise ValueError(
                f"scans must have {self.manifest.dim} coordinates as the first; got {piece.dim}"
            )
        seed = self.manifest.seed + self.chunks
        self.chunks, self.rays = self.chunks + 1, self.rays + len(piece)
        if self.chunks <= self.done.chunks:
            self._check_place(self.chunks == self.done.chunks and self.rays != self.done.rays)
            return
        if not bool(usable_rays(piece, self.sampling)[0].any()):
            return
        known = replace(self.sampling, behind_samples=0)  # a tile's file has two kinds of points
        samples = sample_rays(piece, known, seed=seed)
        for index, records in route(samples.points, samples.labels, self.grid):
            self.buffers.setdefault(index, []).append(records)
            self.buffered += records.nbytes
        if self.buffered >= BUFFER_BYTES:
            self._flush()
            if not self.adds:
                self._commit(complete=False)

    def finish(self) -> Ledger:
        """All records to disk, and from now on they count."""
        self._check_place(self.chunks < self.done.chunks)
        self._flush()
        if not self.tiles:
            raise ValueError("scans must hold at least one usable ray; got none")
        return self._commit(complete=True)

    def _check_place(self, is_wrong: bool) -> None:
        if is_wrong:
            raise ValueError(
                f"scans must be those that {self.folder} was begun with, {self.done.rays} rays in "
                f"the first {self.done.chunks} pieces; got {self.rays} in {self.chunks}"
            )

    def _flush(self) -> None:
        for index, parts in self.buffers.items():
            records = np.concatenate(parts)
            append_records(self.folder, index, records)
            self.tiles[index] = self.tiles.get(index, Counts()).plus(count_records(records))
        self.buffers, self.buffered = {}, 0

    def _commit(self, complete: bool) -> Ledger:
        ledger = Ledger(tiles=self.tiles, chunks=self.chunks, rays=self.rays, complete=complete)
        write_ledger(self.folder, ledger)
        return ledger
