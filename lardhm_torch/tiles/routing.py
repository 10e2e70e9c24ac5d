"""Write the training points of scans of any length to tiles on disk, one piece at a time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.learning.channel_sums import hits_with_channels, joint_layout, layout_of
from lardhm_torch.learning.fitting import FitConfig
from lardhm_torch.sampling import SamplingConfig, sample_rays, usable_rays
from lardhm_torch.scans import Scans
from lardhm_torch.tiles.indexing import Folder, Index, grid_origin
from lardhm_torch.tiles.ledger import (
    LEDGER_NAME,
    Counts,
    Ledger,
    appending,
    count_records,
    read_ledger,
    write_ledger,
)
from lardhm_torch.tiles.manifest import MANIFEST_NAME, Manifest, read_manifest, write_manifest
from lardhm_torch.tiles.records import Grid, Records, append_records, route
from lardhm_torch.tiles.values import append_values, route_values

BUFFER_BYTES = 1 << 28  # of records in memory, before they are appended to their files
HALO = 0.5  # [m] by default


@dataclass(frozen=True, kw_only=True)
class TilingConfig:
    """Size of the tiles, and how scans become training points.

    Args:
        edge: edge length of a tile [m].
        halo: distance around a tile within which points of its neighbors help to train it [m].
            None: 0.5 m, or half an edge if that is less.
        seed: random seed; piece n of the scans is sampled with seed + n.
        num_neighbors: k of the maps; None: the default of `LardHilbertMap`.
        sampling: how rays are sampled.
        fitting: how weights are trained. With ``batch_size=None``, a batch has 1 / 128 of the
            points of a tile, at least 64.

    Raises:
        ValueError: edge is not > 0, or halo is more than half an edge.
    """

    edge: float = 20.0
    halo: float | None = None
    seed: int = 0
    num_neighbors: int | None = None
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    fitting: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        if not 0 < self.edge < float("inf"):
            raise ValueError(f"edge must be > 0 m and finite; got {self.edge}")
        if self.halo is not None and not 0 <= self.halo <= self.edge / 2:
            raise ValueError(f"halo must be 0 to half an edge, {self.edge / 2}; got {self.halo}")


def tile_scans(
    pieces: Iterable[Scans],
    folder: Folder,
    config: TilingConfig | None = None,
    *,
    progress: bool = False,
) -> Ledger:
    """Sample scans and append the training points to the tiles of a new folder.

    Needs memory for one piece and `BUFFER_BYTES`. After a kill, a call with the same pieces
    continues where points were last written, and ends with the same files.

    Args:
        pieces: scans in pieces that fit in memory (`lardhm_torch.io.scan_files.iter_pieces`).
        folder: created if missing; must not contain a complete tiled map.
        config: edge, halo, seed, sampling.
        progress: show a progress bar on a terminal.

    Returns:
        Number of training points of each tile.

    Raises:
        ValueError: the folder holds other files, the pieces differ from those of the run that is
            continued or from each other in dimension, or no ray is usable.
    """
    config, path = config or TilingConfig(), Path(folder)
    pieces = iter(pieces)
    first = next(pieces, None)
    if first is None:
        raise ValueError("pieces must hold at least one Scans; got none")
    manifest = _begin(path, first, config)
    with appending(path, manifest.dim) as ledger:
        router = _Router(path, manifest, config.sampling, ledger)
        for piece in _with_progress(itertools.chain([first], pieces), progress):
            router.take(piece)
        return router.finish()


def add_scans(
    pieces: Iterable[Scans], folder: Folder, *, progress: bool = False
) -> tuple[Ledger, list[Index]]:
    """Append the training points of more scans to a folder; if anything fails, none are added.

    Args:
        pieces: as for `tile_scans`.
        folder: a folder that `tile_scans` completed.
        progress: show a progress bar on a terminal.

    Returns:
        Number of training points of each tile now, and the tiles that contain new points, in order.

    Raises:
        FileNotFoundError, ValueError: the folder is not a complete tiled map, or see `tile_scans`.
    """
    manifest = read_manifest(folder)
    with appending(folder, manifest.dim) as before:
        if not before.complete:
            raise ValueError(
                f"{folder} must be complete before scans are added; let `lardhm tile` finish"
            )
        router = _Router(Path(folder), manifest, SamplingConfig(**manifest.sampling), before)
        for piece in _with_progress(pieces, progress):
            router.take(piece)
        after = router.finish()
    nothing = Counts()
    return after, [
        i for i in after.cores if after.tiles[i].core > before.tiles.get(i, nothing).core
    ]


def _with_progress(pieces: Iterable[Scans], progress: bool) -> Iterator[Scans]:
    with tqdm(desc="rays", unit="ray", unit_scale=True, disable=None if progress else True) as bar:
        for piece in pieces:
            yield piece
            bar.update(len(piece))


def _begin(path: Path, first: Scans, config: TilingConfig) -> Manifest:
    """Write and return the manifest of a new folder, or of one whose run is continued."""
    empty = LardHilbertMap(first.dim)
    if config.num_neighbors is not None:
        empty = LardHilbertMap(first.dim, config.num_neighbors)
    manifest = Manifest(
        edge=config.edge,
        halo=min(HALO, config.edge / 2) if config.halo is None else config.halo,
        origin=grid_origin(first.origins[0], config.edge),
        settings=empty.settings,
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
    """Appends the training points of scans, piece by piece, to the sample files of a folder.

    In a new folder, pieces are counted from 0, and those that an interrupted run finished are
    skipped. When scans are added, counting continues, so that no random seed is used twice, and
    records count only after the last piece.
    """

    def __init__(
        self, folder: Path, manifest: Manifest, sampling: SamplingConfig, done: Ledger
    ) -> None:
        self.folder, self.manifest, self.sampling = folder, manifest, sampling
        self.grid = Grid(manifest.origin, manifest.edge, manifest.halo)
        self.done, self.adds, self.tiles = done, done.complete, dict(done.tiles)
        self.chunks, self.rays = (done.chunks, done.rays) if self.adds else (0, 0)
        self.values, self.channels = dict(done.values), done.channels
        self.buffers: dict[Index, list[Records]] = {}
        self.value_buffers: dict[Index, list[bytes]] = {}
        self.buffered = 0

    def take(self, piece: Scans) -> None:
        """Sample one piece; its records stay in memory until the buffer is full."""
        if piece.dim != self.manifest.dim:
            raise ValueError(
                f"scans must have {self.manifest.dim} coordinates as the first; got {piece.dim}"
            )
        seed = self.manifest.seed + self.chunks
        self.chunks, self.rays = self.chunks + 1, self.rays + len(piece)
        if self.chunks <= self.done.chunks:
            self._check_same_scans(self.chunks < self.done.chunks or self.rays == self.done.rays)
            return
        if not bool(usable_rays(piece, self.sampling)[0].any()):
            return
        known = replace(self.sampling, behind_samples=0)  # a tile's file has two kinds of points
        samples = sample_rays(piece, known, seed=seed)
        for index, records in route(samples.points, samples.labels, self.grid):
            self.buffers.setdefault(index, []).append(records)
            self.buffered += records.nbytes
        hits = hits_with_channels(samples.points, samples.labels, samples.channels)
        if len(hits.points):
            self.channels = joint_layout(self.channels, layout_of(hits.channels))
            for index, block in route_values(hits, self.grid):
                self.value_buffers.setdefault(index, []).append(block)
                self.buffered += len(block)
        if self.buffered >= BUFFER_BYTES:
            self._flush()
            if not self.adds:
                self._commit(complete=False)

    def finish(self) -> Ledger:
        """Write all records and the ledger that counts them."""
        self._check_same_scans(self.chunks >= self.done.chunks)
        self._flush()
        if not self.tiles:
            raise ValueError("scans must hold at least one usable ray; got none")
        return self._commit(complete=True)

    def _check_same_scans(self, is_same: bool) -> None:
        if not is_same:
            raise ValueError(
                f"scans must be those that {self.folder} was begun with, {self.done.rays} rays in "
                f"the first {self.done.chunks} pieces; got {self.rays} in {self.chunks}"
            )

    def _flush(self) -> None:
        for index, parts in self.buffers.items():
            records = np.concatenate(parts)
            append_records(self.folder, index, records)
            self.tiles[index] = self.tiles.get(index, Counts()).plus(count_records(records))
        for index, blocks in self.value_buffers.items():
            content = b"".join(blocks)
            append_values(self.folder, index, content)
            self.values[index] = self.values.get(index, 0) + len(content)
        self.buffers, self.value_buffers, self.buffered = {}, {}, 0

    def _commit(self, complete: bool) -> Ledger:
        ledger = Ledger(
            tiles=self.tiles,
            chunks=self.chunks,
            rays=self.rays,
            complete=complete,
            values=self.values,
            channels=self.channels if self.values else {},
        )
        write_ledger(self.folder, ledger)
        return ledger
