"""Subcommands that query maps."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lardhm_torch.cli.outputs import check_output
from lardhm_torch.cli.scan_files import describe_scans, read_scans

if TYPE_CHECKING:
    import trimesh

    from lardhm_torch import LardHilbertMap, TiledMap

# Imports of torch are inside the functions: `lardhm --help` must be fast.


def query(arguments: argparse.Namespace) -> None:
    """Compute the probability of occupancy at points."""
    import numpy as np
    import torch

    from lardhm_torch.io.atomic_files import replaced_file
    from lardhm_torch.io.scan_files import load_points
    from lardhm_torch.queries.channels import channel
    from lardhm_torch.tiles.tiled_map import open_map

    check_output(arguments.output, (".npy",), [arguments.map, arguments.points])
    model = open_map(arguments.map)
    points = load_points(arguments.points)
    if points.shape[1] == model.dim + 1 and bool((points[:, -1] == points[:1, -1]).all()):
        points = points[:, :-1]  # flat scans, as `fit --dim 2` takes them
    with torch.no_grad():
        if arguments.channel is None:
            probability = model(points).float().numpy()
        else:
            probability = channel(model, points, arguments.channel).float().numpy()
    with replaced_file(arguments.output) as partial, open(partial, "wb") as file:
        np.save(file, probability)
    print(f"{len(probability)} {arguments.channel or 'probabilities'} -> {arguments.output}")


def mesh(arguments: argparse.Namespace) -> None:
    """Extract the surface of a map as a mesh."""
    from lardhm_torch.io.mesh_files import MESH_SUFFIXES, save_mesh
    from lardhm_torch.surfaces.simplification import simplify_mesh
    from lardhm_torch.tiles.tiled_map import open_map

    check_output(arguments.output, MESH_SUFFIXES, [arguments.map])
    model = open_map(arguments.map)
    _check_resolution(arguments.resolution)
    if arguments.faces is not None and arguments.faces < 1:
        raise ValueError(f"--faces must be at least 1; got {arguments.faces}")
    surface = _surface(model, arguments, watertight=arguments.watertight)
    if arguments.faces is not None:
        surface = simplify_mesh(surface, arguments.faces)
    if arguments.watertight and not surface.is_watertight:
        raise ValueError("the map has no closed surface at this --resolution and number of --faces")
    save_mesh(surface, arguments.output)
    print(f"{len(surface.vertices)} vertices, {len(surface.faces)} faces -> {arguments.output}")


def grid(arguments: argparse.Namespace) -> None:
    """Write the probabilities of a map, or distances to its surface, on a grid."""
    from lardhm_torch.io.grid_files import GRID_SUFFIXES, save_grid
    from lardhm_torch.io.nav2_files import save_nav2
    from lardhm_torch.tiles.tiled_map import open_map

    if arguments.output is None and arguments.nav2 is None:
        raise ValueError("give --output or --nav2, or both")
    if arguments.nav2 is None and arguments.heights is not None:
        raise ValueError("--heights needs --nav2; a grid written to --output has all heights")
    for option in ("sparse", "distance", "channel"):
        if getattr(arguments, option) and arguments.output is None:
            raise ValueError(f"--{option} needs --output")
    if arguments.output is not None:
        check_output(arguments.output, GRID_SUFFIXES, [arguments.map])
        for option in ("distance", "channel"):
            if getattr(arguments, option) and Path(arguments.output).suffix.lower() != ".npz":
                message = f"--output must end in .npz with --{option}; got {arguments.output}"
                raise ValueError(message)
    if arguments.nav2 is not None:
        check_output(arguments.nav2, (".yaml", ".yml"), [arguments.map], option="--nav2")
    model = open_map(arguments.map)
    _check_resolution(arguments.resolution)
    if arguments.nav2 is not None:
        columns, rows = save_nav2(
            model,
            arguments.nav2,
            arguments.resolution,
            heights=arguments.heights and tuple(arguments.heights),
            mode=arguments.mode,
        )
        print(f"{columns} x {rows} cells of {arguments.resolution} m -> {arguments.nav2}")
    if arguments.output is not None:
        count = save_grid(
            model,
            arguments.output,
            arguments.resolution,
            distance=arguments.distance,
            sparse=arguments.sparse,
            channel=arguments.channel,
        )
        print(f"{count} cells of {arguments.resolution} m -> {arguments.output}")


def pack(arguments: argparse.Namespace) -> None:
    """Write a map as a compact file for transfer. It supports all queries, but no training."""
    from lardhm_torch.tiles.tiled_map import TiledMap, open_map

    check_output(arguments.output, (".lhm",), [arguments.map])
    opened = open_map(arguments.map)
    model = opened.merge() if isinstance(opened, TiledMap) else opened
    settings = {} if arguments.precision is None else {"precision": arguments.precision}
    model.pack(arguments.output, **settings)
    size = Path(arguments.output).stat().st_size
    print(f"{len(model)} clusters, {size} bytes -> {arguments.output}")


def view(arguments: argparse.Namespace) -> None:
    """Show a map, and optionally its scans, in the browser."""
    import threading

    from lardhm_torch.tiles.tiled_map import open_map
    from lardhm_torch.viewing.viewer import EXPORT_SUFFIXES, MapViewer, ViewConfig

    if arguments.export is not None:
        inputs = [arguments.map, *arguments.scans]
        check_output(arguments.export, EXPORT_SUFFIXES, inputs, option="--export")
    _check_address(arguments.host, arguments.port)
    model = open_map(arguments.map)
    if arguments.resolution is not None:
        _check_resolution(arguments.resolution)
    scans = read_scans(arguments, model.dim) if arguments.scans else None
    config = ViewConfig(host=arguments.host, port=arguments.port, resolution=arguments.resolution)
    viewer = MapViewer(model, scans, config)
    try:
        if arguments.export is not None:
            viewer.export(arguments.export)
            print(f"{len(model)} clusters -> {arguments.export}")
            return
        print(f"{viewer.url}  (Ctrl-C stops it)", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("stopped", flush=True)
        os._exit(0)  # the interpreter would wait for the drawing thread, or abort in it
    finally:
        viewer.close()


def _check_address(host: str, port: int) -> None:
    """Raise an error if no server can listen there; the server's own thread would report none."""
    import socket

    if not 0 < port < 1 << 16:
        raise ValueError(f"--port must be 1 to 65535; got {port}")
    try:
        family, kind, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise OSError(f"--host must be an address of this machine; got {host}: {error}") from error


def render(arguments: argparse.Namespace) -> None:
    """Draw a map as a picture. No display is required."""
    import numpy as np

    from lardhm_torch.tiles.tiled_map import open_map
    from lardhm_torch.viewing.legends import class_legend
    from lardhm_torch.viewing.rendering import render_mesh, render_slice

    check_output(arguments.output, (".png",), [arguments.map])
    model = open_map(arguments.map)
    _check_resolution(arguments.resolution)
    if arguments.slice is not None or model.dim == 2:
        render_slice(model, arguments.output, arguments.slice, arguments.resolution)
        print(f"slice -> {arguments.output}")
        return
    surface = _surface(model, arguments)
    angles = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    legend = None
    if arguments.color == "class":
        labels = np.unique(np.asarray(surface.vertex_attributes["label"]))
        legend = class_legend(labels[labels >= 0].tolist())
    render_mesh(surface, arguments.output, cut_above=arguments.cut_above, legend=legend, **angles)
    print(f"{len(surface.faces)} faces -> {arguments.output}")


def evaluate(arguments: argparse.Namespace) -> None:
    """Evaluate a map on held-out rays."""
    from lardhm_torch.evaluation import held_out, scores
    from lardhm_torch.evaluation.calibration import draw_reliability
    from lardhm_torch.tiles.tiled_map import open_map

    if arguments.reliability is not None:
        inputs = [arguments.map, *arguments.scans]
        check_output(arguments.reliability, (".png",), inputs, option="--reliability")
    model = open_map(arguments.map)
    scans = read_scans(arguments, model.dim)
    answers = held_out.answer_held_out(model, scans, seed=arguments.seed)
    table = held_out.score_held_out(answers)
    if arguments.reliability:
        draw_reliability(held_out.reliability_held_out(answers), arguments.reliability)
    print(json.dumps(table, indent=2) if arguments.json else scores.format_metrics(table))


def info(arguments: argparse.Namespace) -> None:
    """Print the settings and contents of a map, or the contents of scan files and how they are read."""
    from lardhm_torch.io.packed_files import is_packed

    if any(map(_is_scans, arguments.paths)):
        _info_of_scans(arguments)
        return
    if len(arguments.paths) > 1:
        raise ValueError(f"PATH must be one map or scan files; got {len(arguments.paths)} paths")
    (path,) = arguments.paths
    is_tiled = Path(path).is_dir() and not is_packed(path)
    rows = (_info_of_folder if is_tiled else _info_of_file)(path)
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    for name, value in rows.items():
        print(f"{name:<22}{value}")


def _surface(
    model: LardHilbertMap | TiledMap, arguments: argparse.Namespace, *, watertight: bool = False
) -> trimesh.Trimesh:
    from lardhm_torch import extract_mesh

    return extract_mesh(
        model,
        arguments.resolution,
        arguments.threshold,
        surface=arguments.surface,
        color=arguments.color,
        watertight=watertight,
        progress=True,
    )


def _check_resolution(resolution: float) -> None:
    """Raise a ValueError for a cell size that is not positive."""
    if not 0 < resolution < float("inf"):
        raise ValueError(f"--resolution must be > 0 m and finite; got {resolution}")


def _is_scans(name: str) -> bool:
    """Whether a path names scans and not a map."""
    from lardhm_torch.io.packed_files import is_packed
    from lardhm_torch.io.scan_files import SCAN_SUFFIXES
    from lardhm_torch.tiles.manifest import MANIFEST_NAME

    path = Path(name)
    if path.is_dir():
        return not (path / MANIFEST_NAME).is_file() and not is_packed(path)
    return path.suffix.lower() in SCAN_SUFFIXES


def _info_of_scans(arguments: argparse.Namespace) -> None:
    """What readers find in scan files and what they assume, in one line."""
    arguments.scans = arguments.paths
    report = describe_scans(arguments)
    print(json.dumps(report.as_dict(), indent=2) if arguments.json else report)


def _info_of_file(path: str) -> dict[str, Any]:
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.io.packed_files import packet_files
    from lardhm_torch.queries.grids import map_bounds

    model = LardHilbertMap.load(path)
    files = packet_files(path) if Path(path).is_dir() else [Path(path)]
    occupied = int(model.is_occupied.sum())
    rows: dict[str, Any] = {
        "file size [bytes]": sum(file.stat().st_size for file in files),
        **model.settings,
        "dtype": str(model.centers.dtype).removeprefix("torch."),
        "clusters": len(model),
        "occupied clusters": occupied,
        "free clusters": len(model) - occupied,
        "training points": "unknown" if model.is_packed else int(model.counts.sum()),
        "origin [m]": model.origin.tolist(),
    }
    if model.channel_layout:
        rows["channels"] = list(model.channel_layout)
    if model.classes:
        rows["classes"] = model.classes
    if len(model):
        lower, upper = map_bounds(model)
        rows["bounds [m]"] = [[round(float(v), 3) for v in corner] for corner in (lower, upper)]
    return rows


def _info_of_folder(path: str) -> dict[str, Any]:
    """Rows from the manifest alone; no tile is read."""
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
    if manifest.channels:
        rows["channels"] = list(manifest.channels)
    if tiles:
        corners = [
            [pick(axis) for axis in zip(*(tile.bounds[side] for tile in tiles), strict=True)]
            for side, pick in enumerate((min, max))
        ]
        rows["centers [m]"] = [[round(value, 3) for value in corner] for corner in corners]
    return rows
