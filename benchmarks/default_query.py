"""Query time of default maps beside the Table II task: a part of speed.py."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import torch
from table_two import NUM_NEIGHBORS, fit_map, load_octomap, load_task
from timing import Contender, compare
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans, load_scans, sample_rays, split_rays
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import held_out_points, protocol_rays

SETS = (
    "paper_virtual",
    "riegl_vz400i_rtls",
    "balm_realworld",
    "kitti00_mulls",
    "sevenscenes_rgbd",
)
VOXEL = 0.1  # [m] of OctoMap
Result = dict[str, Any]


def default_query(arguments: argparse.Namespace) -> Result:
    """Time per point and thread of default maps (k = 16, chosen m), beside the Table II task.

    The maps are those of the accuracy benchmark: half of at most ``--rays`` rays train. The points
    are the held-out hits and free points (unif and near) in random order.
    """
    task = load_task(arguments.data)
    table_two = fit_map(task)
    rows = [{"map": "Table II", "clusters": len(table_two), "k": NUM_NEIGHBORS}]
    points = [task.shuffled]
    contenders = [Contender("Table II", partial(table_two, task.shuffled))]
    for name in SETS:
        train, test = held_out_rays(arguments.data / name / "scans.npz", arguments.rays)
        model, ask = default_map(train), shuffled_test_points(test)
        rows.append({"map": name, "clusters": len(model), "k": model.num_neighbors})
        points.append(ask)
        contenders.append(Contender(name, partial(model, ask)))
        if load_octomap("octomap") is not None:
            octomap = OctoMapBaseline(VOXEL).fit(train)
            look_up = partial(octomap.tree.getLabels, (ask - octomap.origin).numpy())
            rows.append({"map": f"{name}, OctoMap {VOXEL} m getLabels", "clusters": 0, "k": 0})
            points.append(ask)
            contenders.append(Contender(rows[-1]["map"], look_up))
    timed = compare("default maps", contenders, arguments.repeats, 1)["rows"]
    for row, ask, time in zip(rows, points, timed, strict=True):
        is_octomap = row["k"] == 0
        threads = 1 if is_octomap else arguments.threads
        row["points"] = len(ask)
        row["median ms"] = time["median_ms"]
        row["ns a point and thread"] = threads * 1e6 * time["median_ms"] / len(ask)
    notes = [
        "random order; OctoMap's getLabels is its Python binding on one thread, its native look-up "
        "is faster"
    ]
    return {"title": "Query of default maps, beside Table II", "rows": rows, "notes": notes}


def held_out_rays(path: Path, max_rays: int) -> tuple[Scans, Scans]:
    """Training and test rays of the accuracy benchmark, seed 0."""
    return split_rays(protocol_rays(load_scans(path), max_rays), 0.5, seed=0)


def default_map(train: Scans) -> LardHilbertMap:
    """A map with default settings."""
    samples = sample_rays(train)
    return LardHilbertMap(dim=train.dim).fit(samples.points, samples.labels)


def shuffled_test_points(test: Scans) -> Tensor:
    """(N, 3) hits and free points of held-out rays in random order, float64 [m]."""
    held_out = held_out_points(test)
    points = torch.cat([held_out.hits, held_out.unif, held_out.near])
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
