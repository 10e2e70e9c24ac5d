"""Time of the native kernel alone: ns per point and thread, by point order and map size.

    python benchmarks/kernel.py [--threads 1] [--repeats 7]

The grid is that of the paper's Table II where `../shared/data` is there, else a room like it.
The floor is what any method pays: reading the points and writing the answers once.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import format_rows
from torch import Tensor

from lardhm_torch import native

SCANS = Path(__file__).parents[2] / "shared/data/paper_virtual/scans.npz"
NUM_NEIGHBORS = 5
SIZES = (500, 5_000, 50_000, 200_000)
BATCH = 65_536  # points of a training step
ROOM = (6.0, 5.0, 2.0)  # [m]


def seconds(run: Callable[[], Any], repeats: int) -> float:
    """Median time of so many runs after a warm-up run."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def table_two() -> tuple[Tensor, Tensor]:
    """(638683, 3) points of the grid in lattice order, (500, 3) centers among hits and free space."""
    if not SCANS.is_file():
        return lattice(torch.zeros(3), torch.tensor(ROOM)), torch.rand(500, 3) * torch.tensor(ROOM)
    scans = np.load(SCANS)
    axes = [
        torch.from_numpy(low + scans["grid_step"] * np.arange(size)).float()
        for low, size in zip(scans["grid_lower"], scans["grid_shape"], strict=True)
    ]
    chosen = torch.randperm(len(scans["points"]))[:500]
    centers = torch.from_numpy(scans["points"])[chosen]
    origins = torch.from_numpy(scans["origins"]).float()[scans["scan_id"][chosen]]
    share = torch.rand(250, 1)
    centers[:250] = origins[:250] + share * (centers[:250] - origins[:250])
    return torch.cartesian_prod(*axes), centers


def lattice(low: Tensor, high: Tensor, shape: tuple[int, ...] = (127, 107, 47)) -> Tensor:
    """(N, 3) points of a regular grid between two corners, last axis fastest."""
    axes = [torch.linspace(a, b, n) for a, b, n in zip(low, high, shape, strict=True)]
    return torch.cartesian_prod(*axes)


def measure(points: Tensor, centers: Tensor, repeats: int, threads: int) -> dict[str, Any]:
    """Time per point and thread [ns]: query in lattice and random order, training step."""
    ops = torch.ops.lardhm
    count = len(centers)
    spacing = (float(np.prod(ROOM)) / count) ** (1 / 3)
    raw = (math.log(0.4 * spacing) * torch.eye(3)).expand(count, 3, 3).contiguous()
    kernel = native.Kernel(NUM_NEIGHBORS)
    parameters = (centers, raw, torch.randn(count), *kernel)
    index = ops.build_index(centers, NUM_NEIGHBORS)
    mixed = points[torch.randperm(len(points))]
    batch, grad = mixed[:BATCH], torch.randn(BATCH)

    def each(run: Callable[[], Any], items: int) -> float:
        return 1e9 * seconds(run, repeats) * threads / items

    return {
        "clusters": count,
        "lattice": each(lambda: ops.occupancy(points, *parameters, index, True), len(points)),
        "random": each(lambda: ops.occupancy(mixed, *parameters, index, True), len(points)),
        "features": each(
            lambda: ops.nearest_features(mixed, centers, raw, index, *kernel), len(points)
        ),
        "nearest": each(lambda: ops.nearest(batch, centers, NUM_NEIGHBORS, index), BATCH),
        "assign": each(lambda: ops.assign(batch, centers, index, True), BATCH),
        "backward": each(
            lambda: ops.occupancy_backward(grad, batch, *parameters, index, True, 15), BATCH
        ),
        "index ms": 1e3 * seconds(lambda: ops.build_index(centers, NUM_NEIGHBORS), repeats),
        "index bytes a cluster": len(index) / count,
    }


def floor_note(points: Tensor, threads: int, repeats: int) -> str:
    """Lower bound: one pass over the points that writes one number per point."""
    out = torch.empty(len(points))
    each = 1e9 * seconds(lambda: torch.sum(points, dim=1, out=out), repeats) * threads / len(points)
    return f"floor: {each:.1f} ns a point and thread to read a point and write a number"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=7)
    asked = parser.parse_args()
    if not native.available():
        raise SystemExit("the native kernel is not available")
    torch.set_num_threads(asked.threads)
    torch.manual_seed(0)
    points, centers = table_two()
    rows = [{"points": "Table II", **measure(points, centers, asked.repeats, asked.threads)}]
    room = torch.tensor(ROOM)
    inside = lattice(0.01 * room, 0.99 * room)
    for size in SIZES:
        centers = torch.rand(size, 3) * room
        rows.append({"points": "room", **measure(inside, centers, asked.repeats, asked.threads)})
    title = f"ns a point and thread, k = {NUM_NEIGHBORS}, {len(points):,} points, float32"
    notes = [floor_note(points, asked.threads, asked.repeats)]
    print(format_rows({"title": title, "rows": rows, "notes": notes}))


if __name__ == "__main__":
    main()
