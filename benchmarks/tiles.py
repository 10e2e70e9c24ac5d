"""Queries of a map of many tiles: rate and memory, compared with one map in memory.

    python benchmarks/tiles.py            # a map of 1000 tiles, 10^7 points

Each setting runs in a process of its own, whose largest resident set is reported. The tiled map is
asked cold (tiles are read from disk, checked and joined on the way) and again with what it holds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from conditions import conditions

from lardhm_torch import LardHilbertMap, TiledMap
from lardhm_torch.features import raw_factors
from lardhm_torch.learning.clustering import Clusters
from lardhm_torch.learning.map_state import new_rows
from lardhm_torch.learning.parameters import assign_state

EDGE = 20.0  # [m] of a tile
SIDE = (32, 32)  # tiles of ground, the first 1000 of them
CLUSTERS = 1000  # a tile: 20 m of KITTI street take about 800


def city(num_tiles: int, seed: int = 0) -> LardHilbertMap:
    """A flat world of tiles, 4 m high, with clusters as large and dense as those of a street."""
    rng = torch.Generator().manual_seed(seed)
    count = num_tiles * CLUSTERS
    tile = torch.arange(count) // CLUSTERS
    corner = torch.stack([tile // SIDE[1], tile % SIDE[1], torch.zeros_like(tile)], dim=1) * EDGE
    size = torch.tensor([EDGE, EDGE, 4.0])
    centers = corner + size * torch.rand(count, 3, generator=rng)
    factors = torch.diag_embed(0.05 + 0.4 * torch.rand(count, 3, generator=rng))
    weights = 4 * torch.randn(count, generator=rng)
    counts = torch.full((count,), 100)
    model = LardHilbertMap()
    rows = new_rows(Clusters(counts, centers, factors @ factors.mT), weights > 0, 0.01)
    raw = raw_factors(factors)
    assign_state(model, replace(rows, weights=weights, raw_scale_tril=raw))
    return model.requires_grad_(False)


def questions(num_points: int, num_tiles: int, order: str, seed: int = 1) -> torch.Tensor:
    """(N, 3) float32 points spread over all tiles, 4 m high; grouped by tile, or in random order."""
    rng = torch.Generator().manual_seed(seed)
    tile = torch.arange(num_points) * num_tiles // num_points
    points = torch.rand(num_points, 3, generator=rng)
    points[:, 0].add_(tile // SIDE[1]).mul_(EDGE)
    points[:, 1].add_(tile % SIDE[1]).mul_(EDGE)
    points[:, 2].mul_(4.0)
    del tile
    return points if order == "grouped" else points[torch.randperm(num_points, generator=rng)]


def peak_megabytes() -> float:
    """Peak resident memory of this process (not of its parent)."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def seconds(ask: object, points: torch.Tensor) -> tuple[float, torch.Tensor]:
    start = time.perf_counter()
    with torch.no_grad():
        answer = ask(points)  # type: ignore[operator]
    return time.perf_counter() - start, answer


def measure(arguments: argparse.Namespace) -> None:
    """Measure one setting and print time and memory as JSON."""
    points = questions(arguments.points, arguments.tiles, arguments.order)
    folder, row = Path(arguments.folder), {"points_mb": points.nbytes / 2**20}
    start = time.perf_counter()
    if arguments.measure == "single":
        model = LardHilbertMap.load(folder / "map.pt").requires_grad_(False)
        model(points[:1])
    else:
        model = TiledMap.open(folder / "tiles", memory_limit=arguments.limit << 20)
    row["open_s"] = time.perf_counter() - start
    row["before_mb"] = peak_megabytes()
    row["first_s"], answer = seconds(model, points)
    row["again_s"] = min(seconds(model, points)[0] for _ in range(arguments.repeats))
    row["peak_mb"] = peak_megabytes()
    some = torch.arange(0, len(points), max(1, len(points) // 10_000))
    torch.save(answer[some], folder / f"{arguments.measure}.answers")
    print(json.dumps(row))


def main() -> None:
    """Build the map once, then measure each setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiles", type=int, default=1000)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--limit", type=int, default=384, help="memory limit of the map [MiB]")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--folder", help="folder of the map; it is created if it does not exist")
    parser.add_argument("--orders", nargs="*", default=("grouped", "random"))
    parser.add_argument("--order", choices=("grouped", "random"), default="grouped")
    parser.add_argument("--measure", choices=("single", "tiled"))
    arguments = parser.parse_args()
    if arguments.measure:
        measure(arguments)
        return
    print(conditions())
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(arguments.folder or scratch)
        if not (folder / "tiles").exists():
            folder.mkdir(exist_ok=True)
            model = city(arguments.tiles)
            model.save(folder / "map.pt")
            TiledMap.split(model, folder / "tiles", EDGE)
        for order in arguments.orders:
            rows = {}
            for name in ("single", "tiled"):
                words = [
                    *sys.argv[1:],
                    "--folder",
                    str(folder),
                    "--measure",
                    name,
                    "--order",
                    order,
                ]
                done = subprocess.run(
                    [sys.executable, __file__, *words], check=True, capture_output=True, text=True
                )
                rows[name] = json.loads(done.stdout)
                print(order, name, {key: round(value, 2) for key, value in rows[name].items()})
            ours, theirs = (torch.load(folder / f"{name}.answers") for name in ("tiled", "single"))
            for key in ("first_s", "again_s"):
                print(f"{order}: {key} {rows['tiled'][key] / rows['single'][key]:.2f} times")
            print(f"{order}: answers differ by at most {float((ours - theirs).abs().max()):.1e}")


if __name__ == "__main__":
    main()
