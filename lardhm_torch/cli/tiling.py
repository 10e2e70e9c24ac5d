"""Subcommands for tiled maps, and for merging maps."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from lardhm_torch.cli.outputs import MAP_SUFFIXES, check_folder, check_output
from lardhm_torch.cli.scan_files import far_hits, iter_pieces_of, sampling_of

# Imports of torch are inside the functions: `lardhm --help` must be fast.


def tile(arguments: argparse.Namespace) -> None:
    """Sample scans, which may be too large for memory, and write the training points of each tile."""
    from lardhm_torch.tiles.routing import TilingConfig, tile_scans

    config = TilingConfig(
        edge=arguments.edge,
        halo=arguments.halo,
        seed=arguments.seed,
        num_neighbors=arguments.neighbors,
        sampling=sampling_of(arguments),
    )
    check_folder(arguments.output, arguments.scans)
    ledger = tile_scans(iter_pieces_of(arguments), arguments.output, config, progress=True)
    points = sum(counts.core for counts in ledger.tiles.values())
    print(
        f"{ledger.rays} rays, {points} points -> {len(ledger.cores)} tiles -> {arguments.output}; "
        f"next: lardhm fit-tiles {arguments.output}{far_hits(arguments)}"
    )


def fit_tiles(arguments: argparse.Namespace) -> None:
    """Fit the tiles of a folder. Resumes after an interruption and can be run by torchrun."""
    from lardhm_torch.tiles import fitting

    manifest = fitting.fit_tiles(arguments.folder, progress=True)
    if os.environ.get("RANK", "0") == "0":
        clusters = sum(entry.num_clusters for entry in manifest.tiles.values())
        print(f"{len(manifest.tiles)} tiles, {clusters} clusters -> {arguments.folder}")


def update_folder(arguments: argparse.Namespace) -> None:
    """Update a tiled map in place; only the tiles that contain new points are fitted again."""
    from lardhm_torch.tiles.fitting import fit_tiles
    from lardhm_torch.tiles.manifest import read_manifest
    from lardhm_torch.tiles.routing import add_scans

    if arguments.output is not None and Path(arguments.output) != Path(arguments.map):
        raise ValueError(f"--output must be omitted: {arguments.map} is updated in place")
    if arguments.min_range is not None or arguments.max_range is not None:
        raise ValueError("--min-range and --max-range were fixed by `lardhm tile`; omit them")
    if any(v is not None for v in (arguments.clusters, arguments.radius, arguments.max_age)):
        raise ValueError("--clusters, --radius and --max-age do not apply to tiled maps")
    dim = read_manifest(arguments.map).dim
    _, touched = add_scans(iter_pieces_of(arguments, dim), arguments.map, progress=True)
    manifest = fit_tiles(arguments.map, progress=True)
    print(f"{len(touched)} of {len(manifest.tiles)} tiles were updated -> {arguments.map}")


def join(arguments: argparse.Namespace) -> None:
    """Merge two maps in the same world frame."""
    from lardhm_torch import LardHilbertMap, merge_maps
    from lardhm_torch.tiles import fitting
    from lardhm_torch.tiles.folders import join_folders

    first, second = arguments.maps
    if Path(first).is_dir() != Path(second).is_dir():
        raise ValueError(f"MAPs must be two map files or two tiled maps; got {first} and {second}")
    if not Path(first).is_dir():
        check_output(arguments.output, MAP_SUFFIXES, arguments.maps)
        model = merge_maps(
            LardHilbertMap.load(first), LardHilbertMap.load(second), seed=arguments.seed
        )
        model.save(arguments.output)
        print(f"{len(model)} clusters -> {arguments.output}")
        return
    check_folder(arguments.output, arguments.maps)
    kept = join_folders(first, second, arguments.output)
    manifest = fitting.fit_tiles(arguments.output, progress=True)
    print(f"{len(manifest.tiles)} tiles, {len(kept.tiles)} of them unchanged -> {arguments.output}")
