"""Verbs that ask maps."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from lardhm_torch.cli.scan_files import describe_scans, read_scans

# torch and the rooms are imported inside the verbs: `lardhm --help` must be instant.


def query(arguments: argparse.Namespace) -> None:
    """Points to probabilities, in the order of the points."""
    import numpy as np
    import torch

    from lardhm_torch.io.atomic_files import replaced_file
    from lardhm_torch.io.scan_files import load_points
    from lardhm_torch.tiles.tiled_map import open_map

    model = open_map(arguments.map)
    points = load_points(arguments.points)
    if points.shape[1] == model.dim + 1 and bool((points[:, -1] == points[:1, -1]).all()):
        points = points[:, :-1]  # flat scans, as `fit --dim 2` takes them
    with torch.no_grad():
        probability = model(points).float().numpy()
    with replaced_file(arguments.output) as partial, open(partial, "wb") as file:
        np.save(file, probability)
    print(f"{len(probability)} probabilities -> {arguments.output}")


def mesh(arguments: argparse.Namespace) -> None:
    """A map to a surface."""
    from lardhm_torch import extract_mesh
    from lardhm_torch.io.mesh_files import save_mesh
    from lardhm_torch.tiles.tiled_map import open_map

    surface = extract_mesh(
        open_map(arguments.map),
        arguments.resolution,
        arguments.threshold,
        surface=arguments.surface,
        color=arguments.color,
        progress=True,
    )
    save_mesh(surface, arguments.output)
    print(f"{len(surface.vertices)} vertices, {len(surface.faces)} faces -> {arguments.output}")


def grid(arguments: argparse.Namespace) -> None:
    """A map to a grid of probabilities: .npz, or OctoMap's .bt and .ot."""
    from lardhm_torch.io.grid_files import save_grid
    from lardhm_torch.tiles.tiled_map import open_map

    model = open_map(arguments.map)
    count = save_grid(model, arguments.output, arguments.resolution)
    print(f"{count} cells of {arguments.resolution} m -> {arguments.output}")


def view(arguments: argparse.Namespace) -> None:
    """A map on a page for the browser, with its scans."""
    import threading

    from lardhm_torch.tiles.tiled_map import open_map
    from lardhm_torch.viewing.viewer import MapViewer, ViewConfig

    model = open_map(arguments.map)
    scans = read_scans(arguments, model.dim) if arguments.scans else None
    config = ViewConfig(host=arguments.host, port=arguments.port, resolution=arguments.resolution)
    viewer = MapViewer(model, scans, config)
    try:
        if arguments.export is not None:
            viewer.export(arguments.export)
            print(f"{len(model)} clusters -> {arguments.export}")
            return
        print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("ended")
    finally:
        viewer.close()


def render(arguments: argparse.Namespace) -> None:
    """A map to a picture, without a screen."""
    from lardhm_torch import extract_mesh
    from lardhm_torch.tiles.tiled_map import open_map
    from lardhm_torch.viewing.rendering import render_mesh, render_slice

    model = open_map(arguments.map)
    if arguments.slice is not None or model.dim == 2:
        render_slice(model, arguments.output, arguments.slice, arguments.resolution)
        print(f"slice -> {arguments.output}")
        return
    surface = extract_mesh(
        model,
        arguments.resolution,
        arguments.threshold,
        surface=arguments.surface,
        color=arguments.color,
        progress=True,
    )
    angles = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    render_mesh(surface, arguments.output, cut_above=arguments.cut_above, **angles)
    print(f"{len(surface.faces)} faces -> {arguments.output}")


def evaluate(arguments: argparse.Namespace) -> None:
    """A map against held-out rays."""
    from lardhm_torch.evaluation import held_out, scores
    from lardhm_torch.evaluation.calibration import draw_reliability
    from lardhm_torch.tiles.tiled_map import open_map

    model = open_map(arguments.map)
    scans = read_scans(arguments, model.dim)
    answers = held_out.answer_held_out(model, scans, seed=arguments.seed)
    table = held_out.score_held_out(answers)
    if arguments.reliability:
        draw_reliability(held_out.reliability_held_out(answers), arguments.reliability)
    print(json.dumps(table, indent=2) if arguments.json else scores.format_metrics(table))


def info(arguments: argparse.Namespace) -> None:
    """What a map file, a tiled folder or scan files hold, and how scan files are read."""
    if any(map(_is_scans, arguments.paths)):
        _info_of_scans(arguments)
        return
    if len(arguments.paths) > 1:
        raise ValueError(f"one map at a time can be described; got {len(arguments.paths)} paths")
    (path,) = arguments.paths
    rows = (_info_of_folder if Path(path).is_dir() else _info_of_file)(path)
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    for name, value in rows.items():
        print(f"{name:<22}{value}")


def _is_scans(name: str) -> bool:
    """Whether a path names scans and not a map."""
    from lardhm_torch.io.scan_files import SCAN_SUFFIXES
    from lardhm_torch.tiles.manifest import MANIFEST_NAME

    path = Path(name)
    if path.is_dir():
        return not (path / MANIFEST_NAME).is_file()
    return path.suffix.lower() in SCAN_SUFFIXES


def _info_of_scans(arguments: argparse.Namespace) -> None:
    """What readers find in scan files and what they assume, in one line."""
    arguments.scans = arguments.paths
    report = describe_scans(arguments)
    print(json.dumps(report.as_dict(), indent=2) if arguments.json else report)


def _info_of_file(path: str) -> dict[str, Any]:
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.queries.grids import map_bounds

    model = LardHilbertMap.load(path)
    occupied = int(model.is_occupied.sum())
    rows: dict[str, Any] = {
        "file size [bytes]": Path(path).stat().st_size,
        **model.settings,
        "dtype": str(model.centers.dtype).removeprefix("torch."),
        "clusters": len(model),
        "occupied clusters": occupied,
        "free clusters": len(model) - occupied,
        "training points": int(model.counts.sum()),
        "origin [m]": model.origin.tolist(),
    }
    if len(model):
        lower, upper = map_bounds(model)
        rows["bounds [m]"] = [[round(float(v), 3) for v in corner] for corner in (lower, upper)]
    return rows


def _info_of_folder(path: str) -> dict[str, Any]:
    """From the manifest alone: the tiles stay closed."""
    from lardhm_torch.tiles.manifest import read_manifest

    manifest = read_manifest(path)
    tiles = list(manifest.tiles.values())
    rows: dict[str, Any] = {
        "tiles": len(tiles),
        "tile edge [m]": manifest.edge,
        "halo [m]": manifest.halo,
        **manifest.settings,
        "dtype": manifest.dtype,
        "clusters": sum(tile.num_clusters for tile in tiles),
        "training points": sum(tile.num_points for tile in tiles),
        "origin [m]": list(manifest.origin),
    }
    if tiles:
        corners = [
            [pick(axis) for axis in zip(*(tile.bounds[side] for tile in tiles), strict=True)]
            for side, pick in enumerate((min, max))
        ]
        rows["centers [m]"] = [[round(value, 3) for value in corner] for corner in corners]
    return rows
