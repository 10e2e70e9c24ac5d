"""GPOM and GPIS, exact and of cubic cost, and Hilbert maps of global features, on few points."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from contenders import accuracy, rays_of
from drawing import draw_curves, new_figure, save
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import LardHilbertMap, sample_rays, split_rays
from lardhm_torch.evaluation.baselines.gaussian_process import condition
from lardhm_torch.evaluation.baselines.gp_implicit_surface import GPImplicitSurface
from lardhm_torch.evaluation.baselines.gp_occupancy_map import GPOccupancyMap
from lardhm_torch.evaluation.baselines.local_gp import LocalGP
from lardhm_torch.evaluation.baselines.original_hilbert_map import KernelApproximationMap

SIZES = (250, 500, 1000, 2000, 4000)
TEST_RAYS = 2000


def references(data: Path, folder: Path) -> dict[str, Any]:
    """All methods on the same random points of paper_virtual: accuracy and seconds to train."""
    train, test = split_rays(rays_of(data, "paper_virtual"), 0.5)
    samples = sample_rays(train)
    test = test.select(
        torch.randperm(len(test), generator=torch.Generator().manual_seed(0))[:TEST_RAYS]
    )
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(0))
    methods = {
        "LARD-HM": lambda p, y: LardHilbertMap().fit(p, y),
        "Local GP": lambda p, y: LocalGP(100, 2).fit(p, y),
        "Fourier": lambda p, y: KernelApproximationMap("fourier").fit(p, y),
        "Nystroem": lambda p, y: KernelApproximationMap("nystroem").fit(p, y),
        "GPOM": lambda p, y: GPOccupancyMap().fit(p, y),
        "GPIS": lambda p, y: GPImplicitSurface().fit(p, y),
    }
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    right: dict[str, list[float]] = {name: [] for name in methods}
    solving: dict[str, list[float]] = {}
    for size in tqdm(SIZES, "exact GPs", file=sys.stderr):
        points, labels = samples.points[order[:size]], samples.labels[order[:size]]
        for name, fit in methods.items():
            start = time.perf_counter()
            model = fit(points, labels)
            seconds[name].append(time.perf_counter() - start)
            right[name].append(accuracy(model, test)["paper"])
            if isinstance(model, GPOccupancyMap):
                solving.setdefault(name, []).append(time_to_solve(model, labels))
    figure, axes = new_figure(11, 4.2, 2)
    draw_curves(axes[0], SIZES, right)
    axes[0].set(xlabel="training points", ylabel="accuracy (paper's test)", xscale="log")
    draw_curves(axes[1], SIZES, seconds)
    axes[1].set(xlabel="training points", ylabel="training [s]", xscale="log", yscale="log")
    for panel in axes:
        panel.set_xticks(SIZES, [str(size) for size in SIZES], minor=False)
        panel.minorticks_off()
    save(figure, folder / "exact_gps.png")
    growth = {
        name: float(np.polyfit(np.log(SIZES[-3:]), np.log(times[-3:]), 1)[0])
        for name, times in solving.items()
    }
    return {
        "sizes": SIZES, "seconds": seconds, "accuracy": right, "solving": solving, "growth": growth
    }  # fmt: skip


def time_to_solve(model: GPOccupancyMap, labels: Tensor) -> float:
    """Seconds of the exact solution alone, hyperparameters given: the cubic part."""
    points = model.posterior.points
    present = torch.ones(points.shape[:2], dtype=torch.bool)
    start = time.perf_counter()
    condition(points, 2 * labels.to(points.dtype)[None] - 1, present, model.kernel, model.scale)
    return time.perf_counter() - start
