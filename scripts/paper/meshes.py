"""Fig. 2, 4 and 5: surfaces of four methods, of a large scan, and of a map built scan by scan."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from contenders import rays_of
from matplotlib import colormaps
from timings import GRID_CELL, RESOLUTION, Task, load_task
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import LardHilbertMap, extract_mesh, load_scans, sample_rays
from lardhm_torch.evaluation.baselines.local_gp import LocalGP
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.baselines.original_hilbert_map import OriginalHilbertMap
from lardhm_torch.viewing.rendering import render_mesh

CEILING = 1.7  # [m] faces above it are left out, to look into the room
ROOM_VIEW: dict[str, Any] = {"azimuth": -60, "elevation": 50, "size": (800, 600)}
FIG4_CLUSTERS = 1500  # the paper's m for its RIEGL scan
FIG4_RESOLUTION, FIG5_RESOLUTION = 0.06, 0.03  # [m]
NEW_CLUSTERS = 100  # a keyframe, as in the paper
CAMERA_VIEW: dict[str, Any] = {"up": (0, -1, 0), "azimuth": -105, "elevation": 25}
ENDS = [0.02, 0.98]  # quantiles of the variance between which colors run


def figure_two(data: Path, folder: Path) -> dict[str, Any]:
    """Four methods on the simulated room, and two of them colored by their variance."""
    task, scans = load_task(data), load_scans(data / "paper_virtual" / "scans.npz")
    samples = sample_rays(scans)
    points, labels = samples.points, samples.labels
    lard = LardHilbertMap().fit(points, labels).fit_uncertainty(points, labels)
    gps = LocalGP(100, 2).fit(points, labels)
    grids = {
        "octomap": OctoMapBaseline(0.1).fit(scans),
        "original_hm": OriginalHilbertMap(GRID_CELL, 0.7).fit(points, labels),
        "local_gp": gps,
        "lard_hm": lard,
    }
    faces = {}
    for name, model in tqdm(grids.items(), "Fig. 2", file=sys.stderr):
        mesh = (
            extract_mesh(model, surface="crossing")
            if name == "lard_hm"
            else lattice_mesh(model, task, data)
        )
        faces[name] = len(mesh.faces)
        _draw(mesh, folder / f"figure_2_{name}.png")
    room = (task.grid[0], task.grid[-1])
    mesh = extract_mesh(
        lard, bounds=room, surface="crossing", color="variance", log_odds_margin=None
    )
    _draw(mesh, folder / "figure_2_lard_hm_variance.png")
    mesh = lattice_mesh(gps, task, data)
    variance = ask(gps.variance, torch.as_tensor(np.array(mesh.vertices)))
    low, high = torch.quantile(variance[:100_000], torch.tensor(ENDS).to(variance))
    share = ((variance - low) / (high - low)).clamp(0, 1)
    mesh.visual.vertex_colors = colormaps["plasma"](share.numpy(), bytes=True)
    _draw(mesh, folder / "figure_2_local_gp_variance.png")
    return {"faces": faces}


def _draw(mesh: trimesh.Trimesh, path: Path) -> None:
    render_mesh(mesh, path, cut_above=CEILING, **ROOM_VIEW)


@torch.no_grad()
def ask(model: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """(N, D) -> (N,) answers, a part at a time."""
    return torch.cat([model(few) for few in points.split(1 << 17)]).double()


def lattice_mesh(model: Callable[[Tensor], Tensor], task: Task, data: Path) -> trimesh.Trimesh:
    """Level 1/2 of any probability on the Table II grid; unknown counts as free."""
    from skimage.measure import marching_cubes

    with np.load(data / "paper_virtual" / "scans.npz") as arrays:
        shape, lower = arrays["grid_shape"].tolist(), arrays["grid_lower"]
    values = ask(model, task.grid.double()).reshape(shape).numpy()
    values = np.where(values == 0.5, 0.49, values)
    vertices, faces, _, _ = marching_cubes(values, 0.5, gradient_direction="ascent")
    vertices = vertices * RESOLUTION + lower
    height = vertices[:, 2]
    colors = colormaps["viridis"]((height - height.min()) / np.ptp(height), bytes=True)
    return trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)


def figure_four(data: Path, folder: Path) -> dict[str, Any]:
    """The whole terrestrial scan in one map of 1500 clusters, and one with the default number."""
    samples = sample_rays(load_scans(data / "riegl_vz400i_rtls" / "scans.npz"))
    result: dict[str, Any] = {"points": len(samples)}
    for name, count in tqdm({"m1500": FIG4_CLUSTERS, "default": None}.items(), "Fig. 4"):
        start = time.perf_counter()
        model = LardHilbertMap().fit(samples.points, samples.labels, num_clusters=count)
        trained = time.perf_counter()
        mesh = extract_mesh(model, FIG4_RESOLUTION, surface="crossing")
        result[name] = {
            "clusters": len(model),
            "fit_s": trained - start,
            "mesh_s": time.perf_counter() - trained,
            "faces": len(mesh.faces),
        }
        render_mesh(mesh, folder / f"figure_4_{name}.png", size=(900, 600), elevation=25)
    return result


def figure_five(data: Path, folder: Path) -> dict[str, Any]:
    """The visual-SLAM-like set, keyframe after keyframe, with at most 100 clusters near each."""
    rays = rays_of(data, "sevenscenes_semidense")
    model, seconds, sizes = LardHilbertMap(), [], []
    for scan in tqdm(range(rays.num_scans), "Fig. 5", file=sys.stderr):
        samples = sample_rays(rays.select(rays.scan_id == scan), seed=scan)
        start = time.perf_counter()
        model.update(samples.points, samples.labels, num_clusters=NEW_CLUSTERS, seed=0)
        seconds.append(time.perf_counter() - start)
        sizes.append(len(model))
    mesh = extract_mesh(model, FIG5_RESOLUTION, surface="crossing")
    render_mesh(mesh, folder / "figure_5.png", size=(900, 600), **CAMERA_VIEW)
    return {
        "keyframes": rays.num_scans,
        "rays": len(rays),
        "update_s": float(np.median(seconds)),
        "clusters": sizes,
        "faces": len(mesh.faces),
    }
