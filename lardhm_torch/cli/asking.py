"""Verbs that ask maps."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from lardhm_torch.cli.scan_files import read_scans

# torch and the rooms are imported inside the verbs: `lardhm --help` must be instant.


def query(arguments: argparse.Namespace) -> None:
    """Points to probabilities, in the order of the points."""
    import numpy as np
    import torch

    from lardhm_torch import LardHilbertMap
    from lardhm_torch.files import replaced_file
    from lardhm_torch.io import load_points

    model = LardHilbertMap.load(arguments.map)
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
    from lardhm_torch import LardHilbertMap, extract_mesh
    from lardhm_torch.mesh_files import save_mesh

    surface = extract_mesh(
        LardHilbertMap.load(arguments.map),
        arguments.resolution,
        arguments.threshold,
        color=arguments.color,
        progress=True,
    )
    save_mesh(surface, arguments.output)
    print(f"{len(surface.vertices)} vertices, {len(surface.faces)} faces -> {arguments.output}")


def grid(arguments: argparse.Namespace) -> None:
    """A map to a grid of probabilities: .npz, or OctoMap's .bt and .ot."""
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.exporting import save_grid

    model = LardHilbertMap.load(arguments.map)
    count = save_grid(model, arguments.output, arguments.resolution)
    print(f"{count} cells of {arguments.resolution} m -> {arguments.output}")


def view(arguments: argparse.Namespace) -> None:
    """A map on a page for the browser, with its scans."""
    import threading

    from lardhm_torch import LardHilbertMap
    from lardhm_torch.viewer import MapViewer, ViewConfig

    model = LardHilbertMap.load(arguments.map)
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
    from lardhm_torch import LardHilbertMap, extract_mesh
    from lardhm_torch.rendering import render_mesh, render_slice

    model = LardHilbertMap.load(arguments.map)
    if arguments.slice is not None or model.dim == 2:
        render_slice(model, arguments.output, arguments.slice, arguments.resolution)
        print(f"slice -> {arguments.output}")
        return
    surface = extract_mesh(
        model, arguments.resolution, arguments.threshold, color=arguments.color, progress=True
    )
    angles = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    render_mesh(surface, arguments.output, cut_above=arguments.cut_above, **angles)
    print(f"{len(surface.faces)} faces -> {arguments.output}")


def evaluate(arguments: argparse.Namespace) -> None:
    """A map against held-out rays."""
    from lardhm_torch import LardHilbertMap, metrics
    from lardhm_torch.calibration import draw_reliability

    model = LardHilbertMap.load(arguments.map)
    scans = read_scans(arguments, model.dim)
    answers = metrics.answer_held_out(model, scans, seed=arguments.seed)
    table = metrics.score_held_out(answers)
    if arguments.reliability:
        draw_reliability(metrics.reliability_held_out(answers), arguments.reliability)
    print(json.dumps(table, indent=2) if arguments.json else metrics.format_metrics(table))


def info(arguments: argparse.Namespace) -> None:
    """What a map file holds."""
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.querying import map_bounds

    model = LardHilbertMap.load(arguments.map)
    occupied = int(model.is_occupied.sum())
    rows: dict[str, Any] = {
        "file size [bytes]": Path(arguments.map).stat().st_size,
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
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    for name, value in rows.items():
        print(f"{name:<22}{value}")
