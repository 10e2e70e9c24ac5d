"""All tiles of a folder, by one process or many: first the clusters of all, then the weights.

Between the two phases everyone waits, because the weights of a tile are trained among the clusters
of its neighbors. Nothing else is shared, and all random numbers follow from the seed and the tile's
index: the result is the same for any number of processes and any order. Finished tiles wait in
``fitted/`` and are taken over together at the end, so that a folder that was whole stays whole if
the job is killed; called again, it goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io.atomic_files import remove_partials, replaced_file
from lardhm_torch.learning.fitting import FitConfig
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.parameters import write_state
from lardhm_torch.tiles.cluster_files import (
    clustered_points,
    clusters_path,
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
from lardhm_torch.tiles.manifest import Manifest, read_manifest, write_manifest
from lardhm_torch.tiles.places import Index, tile_name, tile_path, touching_tiles
from lardhm_torch.tiles.ranks import Ranks, join_ranks, one_thread
from lardhm_torch.tiles.samples import Counts, TilePoints, read_ledger, read_records, unpack
from lardhm_torch.tiles.training import (
    TileClusters,
    TrainingTask,
    cluster_tile,
    make_budget,
    train_tile,
)

MOST_POINTS = 1 << 23  # of a tile that are held at a time; a tile of more is fitted to so many
CLUSTER_SHARE = (
    0.45  # of the time that the clusters of a tile take, for the estimate of what is left
)


@torch.no_grad()
def fit_tiles(folder: str | os.PathLike[str], *, progress: bool = False) -> Manifest:
    """Fit the tiles of a folder that are not fitted, are damaged, or whose points have changed since.

    One thread, in this process; under `torchrun` the processes share the tiles. A killed job is
    continued by calling it again: at most the tiles in work are lost.

    Args:
        folder: that `tile_scans` completed, on a disk that all processes see.
        progress: show a bar with an estimate of the time left on a terminal.

    Returns:
        The manifest of the folder, now with all tiles.

    Raises:
        FileNotFoundError, ValueError: the folder is not a tiled map, is not complete, or a file in
            it is damaged.
    """
    with join_ranks() as ranks, one_thread():
        job = _Job(Path(folder), ranks)
        wanted = [tuple(index) for index in ranks.agree("wanted", job.wanted)]
        unclustered = [
            tuple(i) for i in ranks.agree("unclustered", lambda: job.unclustered(wanted))
        ]
        unfitted = [tuple(index) for index in ranks.agree("left", lambda: job.unfitted(wanted))]
        phases = (
            ("clusters", unclustered, job.cluster, CLUSTER_SHARE),
            ("weights", unfitted, job.train, 1 - CLUSTER_SHARE),
        )
        total = sum(share * job.num_points(tiles) for _, tiles, _, share in phases)
        hidden = None if progress and ranks.rank == 0 else True  # None: on a terminal alone
        with tqdm(total=round(total), unit="point", unit_scale=True, disable=hidden) as bar:
            for name, tiles, do, share in phases:
                for index in ranks.take(name, tiles):
                    do(index)
                    done = ranks.count("points", round(share * job.num_points([index])))
                    bar.update(done - bar.n)
                ranks.wait()
        if ranks.rank == 0:
            job.take_over(wanted)
        ranks.wait()
    return read_manifest(folder)


class _Job:
    """The tiles of one folder, each step on its own."""

    def __init__(self, folder: Path, ranks: Ranks) -> None:
        self.folder, self.device = folder, ranks.device
        self.manifest, self.ledger = read_manifest(folder), read_ledger(folder)
        if not self.ledger.complete:
            raise ValueError(f"{folder} must be complete; run `lardhm tile` to its end")
        self.config = FitConfig(**self.manifest.fitting)
        self.first_corner = np.array(self.manifest.origin)
        self.budget = make_budget(self.ledger.tiles, self.config)
        self.empty = LardHilbertMap(**self.manifest.settings).to(
            self.device, getattr(torch, self.manifest.dtype)
        )
        for name in ("clusters", "fitted", "tiles"):
            (folder / name).mkdir(exist_ok=True)

    # --- what is to do; decided by rank 0, largest first so that the ranks end together ---

    def wanted(self) -> list[Index]:
        """Tiles that the manifest does not know as their points are now, or whose file is damaged."""
        known = self.manifest.tiles
        return self._largest_first(
            index
            for index in self.ledger.cores
            if index not in known
            or known[index].num_points != self.ledger.tiles[index].core
            or not _is_whole(tile_path(self.folder, index), known[index])
        )

    def unclustered(self, wanted: list[Index]) -> list[Index]:
        """Of the wanted tiles and their neighbors, those without clusters of all their points."""
        needed = {near for index in wanted for near in (index, *self._neighbors(index))}
        return self._largest_first(
            index
            for index in needed
            if clustered_points(clusters_path(self.folder, index), self.empty.centers)
            != self.ledger.tiles[index].core
        )

    def unfitted(self, wanted: list[Index]) -> list[Index]:
        """Of the wanted tiles, those that do not wait in ``fitted/``."""
        return [index for index in wanted if self._fitted(index) is None]

    def num_points(self, tiles: list[Index]) -> int:
        """Of the cores of some tiles."""
        return sum(self.ledger.tiles[index].core for index in tiles)

    def _largest_first(self, tiles: Iterable[Index]) -> list[Index]:
        return sorted(tiles, key=lambda index: (-self.ledger.tiles[index].core, index))

    # --- one tile ---

    def cluster(self, index: Index) -> None:
        """Phase one: the clusters of a tile's core to their file."""
        found = cluster_tile(
            self._points(index),
            self.budget.num_clusters(self.ledger.tiles[index]),
            self._rng(index, "clusters"),
        )
        save_clusters(clusters_path(self.folder, index), found, self.ledger.tiles[index].core)

    def train(self, index: Index) -> None:
        """Phase two: a tile's map, and its entry of the manifest, to ``fitted/``."""
        own = load_clusters(clusters_path(self.folder, index), self.empty.centers)
        kernel, tile = self.empty.kernel, self._points(index)
        task = TrainingTask(kernel, self.config, self._rng(index, "weights"))
        weights, raw = train_tile(tile, own, self._around(index), self.budget, task)
        clusters = own.clusters
        model = LardHilbertMap(**self.manifest.settings).to(weights)
        origin = torch.tensor(self._origin(index), device=self.device)
        moments = (clusters.counts, clusters.means, clusters.scatters)
        write_state(
            model, MapState(weights, clusters.means, raw, own.is_occupied, *moments), origin
        )
        path = self._fitted_path(index, ".pt")
        model.cpu().save(path)
        record = tile_record(model, path, self.ledger.tiles[index].core)
        with replaced_file(self._fitted_path(index, ".json"), durable=False) as partial:
            partial.write_text(json.dumps({"chunks": self.ledger.chunks, **tile_to_json(record)}))

    def _points(self, index: Index) -> TilePoints:
        """A tile's points in the frame of its map."""
        counts = self.ledger.tiles[index]
        records = read_records(self.folder, index, counts, self.manifest.dim, MOST_POINTS)
        shift = self._corner(index) - self._origin(index)
        return unpack(records, self.device, self.empty.centers.dtype, shift)

    def _around(self, index: Index) -> TileClusters:
        """The neighbors' clusters within two halos, in the frame of a tile."""
        origin, margin = self._origin(index), 2 * self.manifest.halo
        lower = self._corner(index) - origin - margin
        box = (lower, lower + self.manifest.edge + 2 * margin)
        sources = (
            (clusters_path(self.folder, near), self._origin(near) - origin)
            for near in self._neighbors(index)
        )
        return load_clusters_near(sources, box, self.empty.centers)

    def _neighbors(self, index: Index) -> Iterator[Index]:
        """The tiles that touch one, in order."""
        for near in touching_tiles(index):
            if near != index and self.ledger.tiles.get(near, Counts()).core:
                yield near

    def _corner(self, index: Index) -> NDArray[np.float64]:
        """(D,) lower corner of a tile, world frame [m]."""
        return self.first_corner + self.manifest.edge * np.array(index)

    def _origin(self, index: Index) -> NDArray[np.float64]:
        """(D,) origin of a tile's map: whole meters, as in `LardHilbertMap.fit`."""
        return self._corner(index).round()

    def _rng(self, index: Index, phase: str) -> torch.Generator:
        text = f"{self.manifest.seed} {tile_name(index)} {phase}"
        seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
        return torch.Generator(device=self.device).manual_seed(seed)

    # --- files ---

    def _fitted_path(self, index: Index, suffix: str) -> Path:
        return self.folder / "fitted" / f"{tile_name(index)}{suffix}"

    def _fitted(self, index: Index) -> Tile | None:
        """The entry of a tile that was fitted to the points there are now."""
        path = self._fitted_path(index, ".json")
        if not path.is_file():
            return None
        fields = json.loads(path.read_text())
        if fields.pop("chunks") != self.ledger.chunks:
            return None
        return tile_from_json(fields)

    def take_over(self, wanted: list[Index]) -> None:
        """Fitted tiles into the map; if killed within, the next call ends it."""
        found = {}
        for index in wanted:
            tile = self._fitted(index)
            if tile is None:
                raise AssertionError(f"tile {tile_name(index)} was not fitted")
            found[index] = tile
        for index in wanted:
            path = self._fitted_path(index, ".pt")
            if path.is_file():
                os.replace(path, tile_path(self.folder, index))
        write_manifest(self.folder, replace(self.manifest, tiles={**self.manifest.tiles, **found}))
        shutil.rmtree(self.folder / "fitted")
        for folder in (self.folder, self.folder / "clusters"):
            remove_partials(folder)


def _is_whole(path: Path, entry: Tile) -> bool:
    return path.is_file() and file_checksum(path) == entry.checksum
