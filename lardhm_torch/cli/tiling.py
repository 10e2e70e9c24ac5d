"""Verbs that make tiled maps: folders of tiles, for maps larger than memory."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from lardhm_torch.cli.scan_files import far_hits, iter_pieces_of, sampling_of

# torch and the rooms are imported inside the verbs: `lardhm --help` must be instant.


def tile(arguments: argparse.Namespace) -> None:
    """Scans, larger than memory if need be, to the training points of tiles."""
    from lardhm_torch.tiles.routing import TilingConfig, tile_scans

    config = TilingConfig(
        edge=arguments.edge,
        halo=arguments.halo,
        seed=arguments.seed,
        num_neighbors=arguments.neighbors,
        sampling=sampling_of(arguments),
    )
    ledger = tile_scans(iter_pieces_of(arguments), arguments.output, config, progress=True)
    points = sum(counts.core for counts in ledger.tiles.values())
    print(
        f"{ledger.rays} rays, {points} points -> {len(ledger.cores)} tiles -> {arguments.output}; "
        f"next: lardhm fit-tiles {arguments.output}{far_hits(arguments)}"
    )


def fit_tiles(arguments: argparse.Namespace) -> None:
    """The tiles of a folder to maps; also under torchrun, and again after a kill."""
    from lardhm_torch.tiles import fitting

    manifest = fitting.fit_tiles(arguments.folder, progress=True)
    if os.environ.get("RANK", "0") == "0":
        clusters = sum(entry.num_clusters for entry in manifest.tiles.values())
        print(f"{len(manifest.tiles)} tiles, {clusters} clusters -> {arguments.folder}")


def update_folder(arguments: argparse.Namespace) -> None:
    """More scans into a tiled map, in place: only the tiles that they touch are fitted anew."""
    from lardhm_torch.tiles.fitting import fit_tiles
    from lardhm_torch.tiles.manifest import read_manifest
    from lardhm_torch.tiles.routing import add_scans

    if arguments.output is not None and Path(arguments.output) != Path(arguments.map):
        raise ValueError(f"--output must be left out: {arguments.map} is updated in place")
    if arguments.min_range is not None or arguments.max_range is not None:
        raise ValueError("--min-range and --max-range of a tiled map are those of its tile run")
    if arguments.clusters is not None or arguments.radius is not None:
        raise ValueError("--clusters and --radius belong to map files, not to tiled maps")
    dim = read_manifest(arguments.map).dim
    _, touched = add_scans(iter_pieces_of(arguments, dim), arguments.map, progress=True)
    manifest = fit_tiles(arguments.map, progress=True)
    print(f"{len(touched)} of {len(manifest.tiles)} tiles were touched -> {arguments.map}")


def join(arguments: argparse.Namespace) -> None:
    """Two maps of one world frame to one: two map files, or two tiled folders."""
    from lardhm_torch import LardHilbertMap, merge_maps
    from lardhm_torch.tiles import fitting
    from lardhm_torch.tiles.folders import join_folders

    first, second = arguments.maps
    if Path(first).is_dir() != Path(second).is_dir():
        raise ValueError(f"both must be map files or both tiled folders; got {first} and {second}")
    if not Path(first).is_dir():
        model = merge_maps(
            LardHilbertMap.load(first), LardHilbertMap.load(second), seed=arguments.seed
        )
        model.save(arguments.output)
        print(f"{len(model)} clusters -> {arguments.output}")
        return
    kept = join_folders(first, second, arguments.output)
    manifest = fitting.fit_tiles(arguments.output, progress=True)
    print(
        f"{len(manifest.tiles)} tiles, {len(kept.tiles)} of them as they were -> {arguments.output}"
    )
