"""Joining two tiled folders, of two robots or of two machines that each tiled half of the scans."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from lardhm_torch.learning.channel_sums import joint_layout
from lardhm_torch.tiles.entries import Tile
from lardhm_torch.tiles.indexing import (
    Folder,
    Index,
    clusters_path,
    samples_path,
    tile_path,
    touching_tiles,
    values_path,
)
from lardhm_torch.tiles.ledger import Counts, Ledger, read_ledger, write_ledger
from lardhm_torch.tiles.manifest import Manifest, read_manifest, write_manifest
from lardhm_torch.tiles.records import record_type


def join_folders(first: Folder, second: Folder, target: Folder) -> Manifest:
    """Copy the training points of two folders, and the tiles that remain valid, to a new folder.

    A fitted tile remains valid if neither it nor a tile that touches it contains points of the other
    folder; `fit_tiles` fits the others. Both folders are left unchanged.

    Args:
        first: a folder, whose seed and settings are used.
        second: a folder with the same world frame, edge, halo, kernel, sampling and fitting settings.
        target: the new folder, which must not exist or be empty.

    Returns:
        The manifest of the new folder.

    Raises:
        FileNotFoundError: a folder holds no tiled map, or no training points.
        ValueError: the folders are incomplete or differ in their settings, or target is not empty.
    """
    manifests = [read_manifest(folder) for folder in (first, second)]
    ledgers = [read_ledger(folder) for folder in (first, second)]
    for folder, ledger in zip((first, second), ledgers, strict=True):
        if not ledger.complete:
            raise ValueError(f"{folder} must be complete; let `lardhm tile` finish")
    shift = _index_shift(*manifests)
    goal = Path(target)
    goal.mkdir(parents=True, exist_ok=True)
    if any(goal.iterdir()):
        raise ValueError(f"target must be a new or empty folder; {goal} is not")
    sources = [
        _Source(Path(first), manifests[0], ledgers[0], (0,) * manifests[0].dim),
        _Source(Path(second), manifests[1], ledgers[1], shift),
    ]
    for name in ("samples", "clusters", "tiles"):
        (goal / name).mkdir()
    tiles = {}
    for source, other in (sources, sources[::-1]):
        source.append_samples(goal)
        tiles.update(source.copy_fitted(goal, other.cores))
    ledger = Ledger(
        tiles=_total(*(source.counts for source in sources)),
        chunks=sum(part.chunks for part in ledgers),
        rays=sum(part.rays for part in ledgers),
        complete=True,
        values=dict(Counter(sources[0].values) + Counter(sources[1].values)),
        channels=joint_layout(ledgers[0].channels, ledgers[1].channels),
    )
    write_ledger(goal, ledger)
    channels = joint_layout(manifests[0].channels, manifests[1].channels)
    joined = replace(manifests[0], tiles=tiles, channels=channels)
    write_manifest(goal, joined)
    return joined


def _index_shift(first: Manifest, second: Manifest) -> Index:
    """What must be added to an index of the second folder to get that of the first."""
    for name in ("edge", "halo", "settings", "dtype", "sampling", "fitting"):
        ours, theirs = getattr(first, name), getattr(second, name)
        if ours != theirs:
            raise ValueError(f"both folders must have the same {name}; got {ours} and {theirs}")
    steps = [(b - a) / first.edge for a, b in zip(first.origin, second.origin, strict=True)]
    if any(abs(step - round(step)) > 1e-6 for step in steps):
        raise ValueError(
            "both folders must have tile borders at the same positions; "
            f"got the origins {first.origin} and {second.origin} with an edge of {first.edge} m"
        )
    return tuple(round(step) for step in steps)


def _total(first: Mapping[Index, Counts], second: Mapping[Index, Counts]) -> dict[Index, Counts]:
    nothing = Counts()
    return {
        index: first.get(index, nothing).plus(second.get(index, nothing))
        for index in {*first, *second}
    }


class _Source:
    """One of the two folders; its indices are those of the new folder."""

    def __init__(self, folder: Path, manifest: Manifest, ledger: Ledger, shift: Index) -> None:
        self.folder, self.manifest, self.shift = folder, manifest, shift
        self.counts = {self._index_there(index): n for index, n in ledger.tiles.items()}
        self.values = {self._index_there(index): n for index, n in ledger.values.items()}
        self.cores = {index for index, counts in self.counts.items() if counts.core}

    def append_samples(self, goal: Path) -> None:
        """Append all records that count to the files of the new folder."""
        size = record_type(self.manifest.dim).itemsize
        for index, counts in self.counts.items():
            self._append(samples_path, index, goal, size * sum(counts))
        for index, num_bytes in self.values.items():
            values_path(goal, index).parent.mkdir(exist_ok=True)
            self._append(values_path, index, goal, num_bytes)

    def _append(
        self, path_of: Callable[[Path, Index], Path], index: Index, goal: Path, left: int
    ) -> None:
        """Append the first bytes of a tile's file to that of the new folder."""
        with (
            open(path_of(self.folder, self._index_here(index)), "rb") as ours,
            open(path_of(goal, index), "ab") as file,
        ):
            while left and (content := ours.read(min(left, 1 << 24))):
                file.write(content)
                left -= len(content)
        if left:
            raise ValueError(f"{ours.name} is {left} bytes too short: tile the scans again")

    def copy_fitted(self, goal: Path, others: set[Index]) -> dict[Index, Tile]:
        """Copy clusters and tiles that points of the other folder do not change.

        Args:
            goal: the new folder.
            others: tiles that contain points of the other folder.

        Returns:
            Entries of the copied tiles for the manifest.
        """
        entries = {}
        for index in sorted(self.cores):
            ours = self._index_here(index)
            if index not in others and clusters_path(self.folder, ours).is_file():
                shutil.copyfile(clusters_path(self.folder, ours), clusters_path(goal, index))
            entry = self.manifest.tiles.get(ours)
            if (
                entry is not None
                and tile_path(self.folder, ours).is_file()
                and others.isdisjoint(touching_tiles(index))
            ):
                shutil.copyfile(tile_path(self.folder, ours), tile_path(goal, index))
                entries[index] = entry
        return entries

    def _index_there(self, index: Index) -> Index:
        return tuple(i + s for i, s in zip(index, self.shift, strict=True))

    def _index_here(self, index: Index) -> Index:
        return tuple(i - s for i, s in zip(index, self.shift, strict=True))
