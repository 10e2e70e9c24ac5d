"""Tile and fit a simulated city of any size: time per point, memory, disk.

A scanner drives along the streets of a grid of blocks; houses and parked cars follow from the number
of the block, so that no more of the city is held than is in sight. The scans go straight into the
tiles. What a tile costs is held against a fit of single tiles' points as maps of their own.

    python benchmarks/city.py --scans 40                 # a million points or so, seconds
    python benchmarks/city.py --scans 4000 --ranks 2     # 10^8 points, under torchrun
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.ledger import Ledger
from lardhm_torch.tiles.manifest import read_manifest
from lardhm_torch.tiles.ranks import one_thread
from lardhm_torch.tiles.records import read_records, unpack
from lardhm_torch.tiles.routing import TilingConfig, tile_scans

PITCH = 60.0  # [m] from street to street
STREET = 7.0  # [m] from the middle of a street to the houses
HEIGHT = 1.8  # [m] of the sensor above the ground
MAX_RANGE = 60.0  # [m] of the sensor
RINGS, COLUMNS = 64, 500  # rays of a scan
LOWEST, HIGHEST = -25.0, 15.0  # [degrees] of its rings
NOISE = 0.02  # [m] standard deviation of a range
SINGLE_TILES = 9  # fitted on their own, to compare


def block_boxes(block: tuple[int, int]) -> Tensor:
    """(B, 5) houses and cars of a block: x, y of the lower corner, x, y of the upper, height [m]."""
    rng = torch.Generator().manual_seed((block[0] * 100_003 + block[1]) % 2**31)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng)

    corner = PITCH * torch.tensor(block) + STREET
    side = (PITCH - 2 * STREET) / 2  # edge of the lot of one of four houses
    lots = corner + side * torch.cartesian_prod(torch.arange(2), torch.arange(2))
    houses = torch.cat([lots + draw(0, 4, 4, 2), lots + side - draw(0, 4, 4, 2)], dim=1)
    along = corner[0] + torch.arange(4) * side / 2 + draw(0, 4, 4)
    curb = torch.full((4,), float(corner[1]) - 3.2)
    cars = torch.stack([along, curb, along + 4.4, curb + 1.8], dim=1)
    heights = torch.cat([draw(5, 18, 4), draw(1.4, 2.2, 4)])
    return torch.cat([torch.cat([houses, cars]), heights[:, None]], dim=1)


def boxes_in_sight(place: Tensor) -> Tensor:
    """(B, 5) of all blocks around a position (2,)."""
    reach = int(MAX_RANGE // PITCH) + 1
    x, y = (int(c // PITCH) for c in place)
    near = torch.cat(
        [
            block_boxes((i, j))
            for i in range(x - reach, x + reach + 1)
            for j in range(y - reach, y + reach + 1)
        ]
    )
    gap = torch.maximum(near[:, :2] - place, place - near[:, 2:4]).clamp(min=0)
    return near[torch.linalg.vector_norm(gap, dim=1) < MAX_RANGE]


def scan_at(place: Tensor, seed: int) -> Scans:
    """Scan of a rotating scanner at (2,) in a street."""
    rng = torch.Generator().manual_seed(seed)
    turn = 2 * torch.pi * (torch.arange(COLUMNS) + torch.rand((), generator=rng)) / COLUMNS
    tilt = torch.deg2rad(torch.linspace(LOWEST, HIGHEST, RINGS))
    heading = torch.stack([turn.cos(), turn.sin()], dim=1)  # (A, 2)
    boxes = boxes_in_sight(place)
    first = (boxes[None, :, :2] - place) / heading[:, None]  # (A, B, 2)
    second = (boxes[None, :, 2:4] - place) / heading[:, None]
    enter = torch.minimum(first, second).amax(dim=2)
    leave = torch.maximum(first, second).amin(dim=2)
    missed = (enter > leave) | (enter < 0)
    slope = tilt.tan()[:, None, None]  # (E, 1, 1)
    top = boxes[:, 4] - HEIGHT
    level = torch.where((slope * enter < top) & ~missed, enter, torch.inf)
    on_roof = top / slope
    roof = (on_roof > enter) & (on_roof < leave) & ~missed & (slope < 0)
    level = torch.minimum(level, torch.where(roof, on_roof, torch.inf)).amin(dim=2)
    ground = torch.where(slope < 0, -HEIGHT / slope, torch.inf)[..., 0]
    ranges = torch.minimum(level, ground).double() / tilt.cos()[:, None]
    is_return = ranges < MAX_RANGE
    ranges = ranges + NOISE * torch.randn(RINGS, COLUMNS, generator=rng, dtype=torch.float64)
    flat = tilt.cos()[:, None, None] * heading[None]  # (E, A, 2)
    up = tilt.sin()[:, None, None].expand(RINGS, COLUMNS, 1)
    directions = torch.cat([flat, up], dim=2).double().reshape(-1, 3)
    origin = torch.cat([place.double(), torch.tensor([HEIGHT], dtype=torch.float64)])
    ends = origin + ranges.clamp(max=MAX_RANGE).reshape(-1, 1) * directions
    return Scans(origin[None], ends, is_return=is_return.reshape(-1))


def city_scans(count: int, spacing: float, seed: int = 0) -> Iterator[Scans]:
    """Scanner positions of a drive through a square city with room for so many scans."""
    streets = max(1, round((count * spacing / PITCH) ** 0.5))
    length = count * spacing / streets
    for number in range(count):
        street, along = divmod(number * spacing, length)
        along = along if street % 2 == 0 else length - along
        yield scan_at(torch.tensor([along, street * PITCH]), seed + number)


class Stopwatch:
    """Measure the time that it takes to produce a stream."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def watch(self, stream: Iterator[Scans]) -> Iterator[Scans]:
        """The same stream."""
        while True:
            start = time.perf_counter()
            item = next(stream, None)
            self.seconds += time.perf_counter() - start
            if item is None:
                return
            yield item


def single_fits(folder: Path, ledger: Ledger) -> tuple[float, float]:
    """Processor time per point [s] of some tiles fitted as single maps, median of the tiles.

    Returns:
        From the file of points to the map's file, as a tile of the folder is made; and of that the
        fit alone, points in memory.
    """
    manifest = read_manifest(folder)
    ranked = sorted(ledger.cores, key=lambda index: ledger.tiles[index].core)
    whole, alone = [], []
    for place in range(SINGLE_TILES):  # spread over all points, not over all tiles
        chosen = _at_share(ledger, ranked, (place + 0.5) / SINGLE_TILES)
        start = time.process_time()
        records = read_records(folder, chosen, sum(ledger.tiles[chosen]), manifest.dim, 1 << 23)
        tile = unpack(records, torch.device("cpu"), torch.float32)
        points, labels = tile.points[tile.in_core], tile.labels[tile.in_core]
        read = time.process_time()
        model = LardHilbertMap(**manifest.settings).fit(points, labels)
        fitted = time.process_time()
        model.save(folder.with_suffix(".pt"))
        whole.append((time.process_time() - start) / len(points))
        alone.append((fitted - read) / len(points))
    return statistics.median(whole), statistics.median(alone)


def _at_share(ledger: Ledger, ranked: list[Any], share: float) -> Any:
    left = share * sum(ledger.tiles[index].core for index in ranked)
    for index in ranked:
        left -= ledger.tiles[index].core
        if left <= 0:
            return index
    return ranked[-1]


def fit_city(folder: Path, ranks: int) -> tuple[float, float]:
    """Time and processor time [s] to fit all tiles, including the start of torchrun if it is used."""
    start, begin = time.perf_counter(), sum(os.times()[:4])
    if ranks == 0:
        fit_tiles(folder, progress=True)
    else:
        command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
        job = ["-m", "lardhm_torch.cli", "fit-tiles", str(folder)]
        subprocess.run([sys.executable, *command, *job], check=True)
    return time.perf_counter() - start, sum(os.times()[:4]) - begin


def peak_gib() -> float:
    """Peak memory of this process, or of the largest of its children [GiB]."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(w).ru_maxrss for w in who) / 2**20


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Tile, fit, compare."""
    watch, start = Stopwatch(), time.perf_counter()
    config = TilingConfig(edge=arguments.edge)
    stream = watch.watch(city_scans(arguments.scans, arguments.spacing))
    ledger = tile_scans(stream, arguments.folder, config, progress=True)
    tiling = time.perf_counter() - start - watch.seconds
    points = sum(counts.core for counts in ledger.tiles.values())
    before = single_fits(arguments.folder, ledger)
    fitting, processor = fit_city(arguments.folder, arguments.ranks)
    after = single_fits(arguments.folder, ledger)
    whole, alone = (statistics.mean(pair) for pair in zip(before, after, strict=True))
    each = processor / points  # others may use the machine, too
    manifest = read_manifest(arguments.folder)
    disk = {
        name: sum(f.stat().st_size for f in (arguments.folder / name).iterdir())
        for name in ("samples", "clusters", "tiles")
    }
    return {
        "rays": ledger.rays,
        "points": points,
        "tiles": len(manifest.tiles),
        "clusters": sum(tile.num_clusters for tile in manifest.tiles.values()),
        "halo share": sum(c.halo for c in ledger.tiles.values()) / points,
        "ranks": arguments.ranks,
        "simulating [s]": watch.seconds,
        "tiling [s]": tiling,
        "fitting [s]": fitting,
        "tiling [us a point]": 1e6 * tiling / points,
        "fitting [processor s]": processor,
        "fitting [processor us a point]": 1e6 * each,
        "single tile, file to file [us a point]": 1e6 * whole,
        "single tile, in memory [us a point]": 1e6 * alone,
        "ratio to file to file": each / whole,
        "ratio to in memory": each / alone,
        "peak memory of a process [GiB]": peak_gib(),
        **{f"{name} [bytes]": size for name, size in disk.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--scans", type=int, default=40, help="scans of 32,000 rays each (default: 40)"
    )
    parser.add_argument(
        "--spacing", type=float, default=5.0, help="distance between scans [m] (default: 5)"
    )
    parser.add_argument("--edge", type=float, default=20.0, help="edge of a tile [m] (default: 20)")
    parser.add_argument(
        "--ranks", type=int, default=0, help="ranks under torchrun; 0: in this process (default: 0)"
    )
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "city")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "city.json")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.folder, ignore_errors=True)
    record = {"conditions": conditions()}
    print(describe(record["conditions"]), end="\n\n")
    with one_thread():
        record["city"] = measure(arguments)
    for name, value in record["city"].items():
        print(f"{name:<40}{value:,.3f}" if isinstance(value, float) else f"{name:<40}{value:,}")
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
