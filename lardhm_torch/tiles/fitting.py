"""Fitting the tiles of a folder, by one process or several: first clusters, then weights.

All processes wait between the two phases, because the weights of a tile are trained together with
the clusters of its neighbors. Random seeds are derived from the folder's seed and the index of the
tile, so that the result does not depend on the number of processes or on the order of the tiles.
Finished tiles are kept in ``fitted/`` and moved to ``tiles/`` together at the end: if the job is
killed, the previous map stays valid, and the next call continues.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io.atomic_files import remove_partials
from lardhm_torch.io.map_files import SAFETENSORS
from lardhm_torch.learning.channel_sums import Hits, Layout, joint_layout, with_hits, with_layout
from lardhm_torch.learning.fitting import FitConfig
from lardhm_torch.learning.map_state import MapState, new_rows
from lardhm_torch.learning.parameters import write_state
from lardhm_torch.tiles.cluster_files import (
    clustered_points,
    load_clusters,
    load_clusters_near,
    save_clusters,
)
from lardhm_torch.tiles.entries import (
    Tile,
    file_checksum,
    tile_from_json,
    tile_record,
    tile_to_json,
)
from lardhm_torch.tiles.indexing import (
    Folder,
    Index,
    clusters_path,
    tile_name,
    tile_path,
    touching_tiles,
)
from lardhm_torch.tiles.ledger import Counts, read_ledger
from lardhm_torch.tiles.manifest import (
    Manifest,
    read_manifest,
    read_page,
    write_manifest,
    write_page,
)
from lardhm_torch.tiles.ranks import Ranks, join_ranks, one_thread
from lardhm_torch.tiles.records import TilePoints, read_records, unpack
from lardhm_torch.tiles.training import (
    TileClusters,
    TrainingTask,
    cluster_tile,
    make_budget,
    train_tile,
)
from lardhm_torch.tiles.values import read_values

MOST_POINTS = 1 << 23  # a tile with more is fitted to so many of its points
CLUSTERING_RATIO = 0.45  # of the time of a fit, for the progress bar


@torch.no_grad()
def fit_tiles(folder: Folder, *, progress: bool = False) -> Manifest:
    """Fit all tiles that are new or damaged, or whose training points have changed.

    Uses one thread of this process; under `torchrun`, the processes share the tiles. After a kill,
    call it again to continue: only the tiles that were being fitted are lost.

    Args:
        folder: a folder that `tile_scans` completed, on a disk that all processes can access.
        progress: show a progress bar on a terminal.

    Returns:
        The manifest of the folder, which now lists all tiles.

    Raises:
        FileNotFoundError, ValueError: the folder is not a complete tiled map, or a file in it is
            damaged.
    """
    with join_ranks() as ranks, one_thread():
        job = _Job(Path(folder), ranks)
        wanted = _agreed(ranks, "wanted", job.wanted)
        unclustered = _agreed(ranks, "unclustered", lambda: job.unclustered(wanted))
        unfitted = _agreed(ranks, "unfitted", lambda: job.unfitted(wanted))
        phases = (
            ("clusters", unclustered, job.cluster, CLUSTERING_RATIO),
            ("weights", unfitted, job.train, 1 - CLUSTERING_RATIO),
        )
        total = sum(ratio * job.num_points(tiles) for _, tiles, _, ratio in phases)
        hidden = None if progress and ranks.rank == 0 else True  # None: shown on a terminal only
        with tqdm(total=round(total), unit="point", unit_scale=True, disable=hidden) as bar:
            for name, tiles, do, ratio in phases:
                for index in ranks.take(name, tiles):
                    do(index)
                    done = ranks.count("points", round(ratio * job.num_points([index])))
                    bar.update(done - bar.n)
                ranks.wait()
        if ranks.rank == 0:
            job.publish(wanted)
        ranks.wait()
    return read_manifest(folder)


def _agreed(ranks: Ranks, name: str, decide: Callable[[], list[Index]]) -> list[Index]:
    """The list of tiles that rank 0 makes, on all ranks."""
    return [tuple(index) for index in ranks.agree(name, decide)]


class _Job:
    """The steps of fitting the tiles of a folder."""

    def __init__(self, folder: Path, ranks: Ranks) -> None:
        self.folder, self.device = folder, ranks.device
        self.manifest, self.ledger = read_manifest(folder), read_ledger(folder)
        if not self.ledger.complete:
            raise ValueError(f"{folder} must be complete; let `lardhm tile` finish")
        self.config = FitConfig(**self.manifest.fitting)
        self.first_corner = np.array(self.manifest.origin)
        self.budget = make_budget(self.ledger.tiles, self.config)
        self.empty = LardHilbertMap(**self.manifest.settings).to(
            self.device, getattr(torch, self.manifest.dtype)
        )
        for name in ("clusters", "fitted", "tiles"):
            (folder / name).mkdir(exist_ok=True)

    # --- the work; largest tiles first, so that all ranks end at about the same time ---

    def wanted(self) -> list[Index]:
        """Tiles without a valid map of their current training points."""
        known = self.manifest.tiles
        return self._largest_first(
            index
            for index in self.ledger.cores
            if index not in known
            or known[index].num_points != self.ledger.tiles[index].core
            or not _is_whole(tile_path(self.folder, index), known[index])
        )

    def unclustered(self, wanted: list[Index]) -> list[Index]:
        """Those of the wanted tiles and their neighbors that are not clustered yet."""
        needed = {near for index in wanted for near in (index, *self._neighbors(index))}
        return self._largest_first(
            index
            for index in needed
            if clustered_points(clusters_path(self.folder, index), self.empty.centers)
            != self.ledger.tiles[index].core
        )

    def unfitted(self, wanted: list[Index]) -> list[Index]:
        """Those of the wanted tiles that are not in ``fitted/`` yet."""
        return [index for index in wanted if self._fitted(index) is None]

    def num_points(self, tiles: list[Index]) -> int:
        """Number of training points inside some tiles."""
        return sum(self.ledger.tiles[index].core for index in tiles)

    def _largest_first(self, tiles: Iterable[Index]) -> list[Index]:
        return sorted(tiles, key=lambda index: (-self.ledger.tiles[index].core, index))

    # --- one tile ---

    def cluster(self, index: Index) -> None:
        """Phase one: cluster the points inside a tile."""
        found = cluster_tile(
            self._points(index),
            self.budget.num_clusters(self.ledger.tiles[index]),
            self._rng(index, "clusters"),
        )
        save_clusters(clusters_path(self.folder, index), found, self.ledger.tiles[index].core)

    def train(self, index: Index) -> None:
        """Phase two: train a tile; its map and its entry for the manifest go to ``fitted/``."""
        own = load_clusters(clusters_path(self.folder, index), self.empty.centers)
        kernel, tile = self.empty.kernel, self._points(index)
        task = TrainingTask(kernel, self.config, self._rng(index, "weights"))
        weights, raw = train_tile(tile, own, self._around(index), self.budget, task)
        clusters = own.clusters
        model = LardHilbertMap(**self.manifest.settings).to(weights)
        origin = torch.tensor(self._origin(index), device=self.device)
        rows = new_rows(clusters, own.is_occupied, kernel.min_lengthscale)
        state = replace(rows, weights=weights, raw_scale_tril=raw)
        write_state(model, *self._with_channels(index, state, origin))
        path = self._fitted_path(index, SAFETENSORS)
        model.cpu().save(path, evidence=False)
        record = tile_record(model, path, self.ledger.tiles[index].core)
        body = {"chunks": self.ledger.chunks, "tile": tile_to_json(record)}
        write_page(self._fitted_path(index, ".json"), body, durable=False)

    def _with_channels(
        self, index: Index, state: MapState, origin: Tensor
    ) -> tuple[MapState, Tensor, Layout]:
        """The clusters with the channels of the tile's hits, origin and layout."""
        num_bytes = self.ledger.values.get(index, 0)
        if not num_bytes:
            return state, origin, {}
        layout = self.ledger.channels
        state = with_layout(state, {}, layout)
        shift = torch.from_numpy(self._corner(index) - self._origin(index)).to(state.means)
        for points, channels in read_values(self.folder, index, num_bytes):
            moved = points.to(state.means) + shift
            there = {name: values.to(self.device) for name, values in channels.items()}
            state = with_hits(state, layout, Hits(moved, there))
        return state, origin, layout

    def _points(self, index: Index) -> TilePoints:
        """The training points of a tile in the frame of its map."""
        total = sum(self.ledger.tiles[index])
        records = read_records(self.folder, index, total, self.manifest.dim, MOST_POINTS)
        shift = self._corner(index) - self._origin(index)
        return unpack(records, self.device, self.empty.centers.dtype, shift)

    def _around(self, index: Index) -> TileClusters:
        """Clusters of the neighbors within two halos of a tile, in the frame of its map."""
        origin, margin = self._origin(index), 2 * self.manifest.halo
        lower = self._corner(index) - origin - margin
        box = (lower, lower + self.manifest.edge + 2 * margin)
        sources = (
            (clusters_path(self.folder, near), self._origin(near) - origin)
            for near in self._neighbors(index)
        )
        return load_clusters_near(sources, box, self.empty.centers)

    def _neighbors(self, index: Index) -> Iterator[Index]:
        """Tiles with points that touch a tile, in order."""
        for near in touching_tiles(index):
            if near != index and self.ledger.tiles.get(near, Counts()).core:
                yield near

    def _corner(self, index: Index) -> NDArray[np.float64]:
        """(D,) lower corner of a tile, world frame [m]."""
        return self.first_corner + self.manifest.edge * np.array(index)

    def _origin(self, index: Index) -> NDArray[np.float64]:
        """(D,) origin of a tile's map, in whole meters as in `LardHilbertMap.fit`."""
        return self._corner(index).round()

    def _rng(self, index: Index, phase: str) -> torch.Generator:
        text = f"{self.manifest.seed} {tile_name(index)} {phase}"
        seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
        return torch.Generator(device=self.device).manual_seed(seed)

    # --- files ---

    def _fitted_path(self, index: Index, suffix: str) -> Path:
        return self.folder / "fitted" / f"{tile_name(index)}{suffix}"

    def _fitted(self, index: Index) -> Tile | None:
        """Entry of a tile that is fitted to its current points; None if it is not, or is damaged."""
        path = self._fitted_path(index, ".json")
        if not path.is_file():
            return None
        try:
            body = read_page(path)
        except ValueError:
            return None
        return tile_from_json(body["tile"]) if body["chunks"] == self.ledger.chunks else None

    def publish(self, wanted: list[Index]) -> None:
        """Move fitted tiles into the map. If it is interrupted, the next call finishes it."""
        found = {}
        for index in wanted:
            tile = self._fitted(index)
            if tile is None:
                raise AssertionError(f"tile {tile_name(index)} was not fitted")
            found[index] = tile
        for index in wanted:
            path = self._fitted_path(index, SAFETENSORS)
            if path.is_file():
                os.replace(path, tile_path(self.folder, index))
        tiles = {**self.manifest.tiles, **found}
        channels = joint_layout(self.manifest.channels, self.ledger.channels)
        write_manifest(self.folder, replace(self.manifest, tiles=tiles, channels=channels))
        shutil.rmtree(self.folder / "fitted")
        for folder in (self.folder, self.folder / "clusters"):
            remove_partials(folder)


def _is_whole(path: Path, entry: Tile) -> bool:
    return path.is_file() and file_checksum(path) == entry.checksum
