"""Updates scan by scan: accuracy compared with all scans at once, time per scan, growth, fading.

python benchmarks/incremental.py                       # all parts
python benchmarks/incremental.py --only speed growth
"""

from __future__ import annotations

import argparse
import copy
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from drive import street_scan
from timing import format_rows
from tqdm import tqdm

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    StreamConfig,
    UpdateConfig,
    load_scans,
    sample_rays,
    split_rays,
    stream_scans,
)
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.io.octrees import new_tree, to_array
from lardhm_torch.streaming import real_time

SETS = (
    "paper_virtual",
    "la3dm_sim_structured",
    "tdtk_dat",
    "balm_realworld",
    "kitti00_mulls",
    "sevenscenes_rgbd",
)
PAPER = UpdateConfig(as_in_paper=True)
Row = dict[str, Any]


def single_scans(scans: Scans) -> list[Scans]:
    """One Scans per scan, with a single origin, as `iter_scans` returns them."""
    return [
        Scans(scans.origins[number : number + 1], part.ends, None, part.is_return)
        for number in scans.scan_id.unique().tolist()
        if len(part := scans.select(scans.scan_id == number))
    ]


def streamed(scans: Iterable[Scans], config: StreamConfig) -> LardHilbertMap:
    model = LardHilbertMap()
    stream_scans(model, scans, config)
    return model


def batch_map(train: Scans, num_clusters: int) -> LardHilbertMap:
    """All scans at once, with a given number of clusters."""
    samples = sample_rays(train)
    return LardHilbertMap().fit(samples.points, samples.labels, num_clusters)


def accuracy(arguments: argparse.Namespace) -> list[Row]:
    """Held-out rays: streams in three orders, and all scans at once with as many clusters."""
    rows = []
    for name in tqdm(arguments.sets, "accuracy", disable=None):
        rays = protocol_rays(load_scans(arguments.data / name / "scans.npz"), 120_000)
        train, test = split_rays(rays, 0.5, seed=arguments.seed)
        scans, rng = single_scans(train), torch.Generator().manual_seed(arguments.seed)
        shuffled = torch.randperm(len(scans), generator=rng).tolist()
        orders = {
            "given": scans,
            "reversed": scans[::-1],
            "random": [scans[number] for number in shuffled],
        }
        for order, stream in orders.items():
            model = streamed(stream, StreamConfig())
            occupied = int(model.is_occupied.sum())
            batch = batch_map(train, len(model))
            ours, theirs = evaluate(model, test), evaluate(batch, test)
            row: Row = {"set": name, "scans": len(scans), "order": order}
            row["clusters"] = f"{occupied} + {len(model) - occupied}"
            for kind in ("unif", "near"):
                score = [table[kind]["balanced_accuracy"] for table in (ours, theirs)]
                row[kind], row[f"{kind} batch"] = score
                row[f"{kind} lost"] = score[1] - score[0]
            rows.append(row)
    return rows


def revisits(arguments: argparse.Namespace) -> list[Row]:
    """Number of clusters after each of eleven visits of one place with other rays and seeds."""
    rows = []
    for name in tqdm(arguments.sets, "revisits", disable=None):
        scans = protocol_rays(load_scans(arguments.data / name / "scans.npz"))
        order = torch.randperm(len(scans), generator=torch.Generator().manual_seed(0))
        visits = [scans.select(rays) for rays in order.chunk(11)]
        for rule, config in {"default": UpdateConfig(), "Algorithm 2": PAPER}.items():
            sizes, model = [], LardHilbertMap()
            for seed, visit in enumerate(visits):
                samples = sample_rays(visit, seed=seed)
                given = (samples.points, samples.labels)
                model.update(*given, seed=seed, rays=visit, config=config)
                sizes.append(len(model))
            row = {"set": name, "rule": rule, "rays a visit": len(visits[0]), "first": sizes[0]}
            rows.append(
                row
                | {
                    "revisit +%": 100 * (sizes[1] / sizes[0] - 1),
                    "ten +%": 100 * (sizes[10] / sizes[0] - 1),
                }
            )
    return rows


def seconds_of(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def learn_job(
    model: LardHilbertMap, scans: list[Scans], config: StreamConfig
) -> Callable[[int], Any]:
    """Update the map with scan ``turn`` of a stream that repeats."""
    return lambda turn: stream_scans(
        model,
        [scans[turn % len(scans)]],
        StreamConfig(**{**vars(config), "seed": turn}),
    )


def octomap_job(scans: list[Scans]) -> Callable[[int], Any]:
    tree = new_tree(0.1)
    arrays = [(to_array(scan.ends), to_array(scan.origins[0])) for scan in scans]
    return lambda turn: tree.insertPointCloud(*arrays[turn % len(arrays)])


def speed(arguments: argparse.Namespace) -> list[Row]:
    """Time from rays in memory to an updated map: default, real time, OctoMap at 0.1 m."""
    # One process per set: OctoMap's tree of the previous set would fragment the heap, which slows
    # down large allocations.
    jobs = [(arguments.data, name) for name in ("kitti00_mulls", "sevenscenes_rgbd")]
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=fresh, max_tasks_per_child=1) as process:
        rows = [row for found in process.map(speed_of, *zip(*jobs, strict=True)) for row in found]
    columns = {column: None for row in rows for column in row}
    return [{column: row.get(column, "") for column in columns} for row in rows]


@torch.no_grad()
def speed_of(data: Path, name: str) -> list[Row]:
    """Times of the scans of one set, per system."""
    rays = protocol_rays(load_scans(data / name / "scans.npz"))
    train, test = split_rays(rays, 0.98)
    scans = single_scans(train)
    settings = {"default": StreamConfig(), "real time": real_time()}
    models = {system: LardHilbertMap() for system in settings}
    jobs = {system: learn_job(models[system], scans, config) for system, config in settings.items()}
    jobs["OctoMap 0.1 m"] = octomap_job(scans)
    seconds: dict[str, list[float]] = {system: [] for system in jobs}
    for turn in range(max(len(scans), 9)):
        for system, job in jobs.items():
            seconds[system].append(seconds_of(partial(job, turn)))
    slowest = statistics.median(seconds["OctoMap 0.1 m"][1:])
    rows = []
    for system, times in seconds.items():
        median = statistics.median(times[1:])
        row: Row = {"set": name, "system": system, "rays": len(scans[0])}
        row |= {"ms a scan": 1e3 * median, "first ms": 1e3 * times[0]}
        row["x faster than OctoMap"] = slowest / median
        if system in models:
            table = evaluate(models[system], test)
            row |= {kind: table[kind]["balanced_accuracy"] for kind in ("unif", "near")}
            row |= {"clusters": len(models[system])}
            scan, sampling = scans[0], settings[system].sampling
            kept = settings[system].max_rays or len(scan)
            part = scan.select(torch.arange(min(kept, len(scan))))
            limit = settings[system].update.max_points
            row["samples"] = len(sample_rays(part, sampling, max_points=limit))
        rows.append(row)
    return rows


def growth(arguments: argparse.Namespace) -> list[Row]:
    """Time per scan along a straight drive; several scans are timed alternately."""
    rows: list[Row] = []
    for meters, radius in ((1.0, None), (1.0, 60.0), (4.0, None)):
        model, kept = LardHilbertMap(), {}
        for number in tqdm(range(999), "drive", disable=None):
            scan = street_scan(meters * number, 20_000, number)
            stream_scans(model, [scan], StreamConfig(radius=radius, seed=number))
            if number + 2 in (10, 40, 100, 1_000):
                kept[number + 2] = copy.deepcopy(model)
        times: dict[int, list[float]] = {scans: [] for scans in kept}
        for turn in range(15):
            for scans, model in kept.items():
                places = [meters * (scans - 2), meters * (scans - 1)]
                times[scans].append(seconds_again(model, places, turn, radius))
        medians = {scans: statistics.median(seconds[1:]) for scans, seconds in times.items()}
        for scans, model in kept.items():
            row: Row = {"m between scans": meters, "forgets beyond m": radius or "never"}
            row["scan"] = scans
            row["ms"] = 1e3 * medians[scans]
            row["ratio to the 10th"] = medians[scans] / medians[10]
            tensors = (*model.parameters(), *model.buffers())
            held = sum(tensor.numel() * tensor.element_size() for tensor in tensors)
            rows.append(row | {"clusters": len(model), "map MB": held / 1e6})
    return rows


def seconds_again(
    model: LardHilbertMap, places: list[float], turn: int, radius: float | None
) -> float:
    """Time of the scan at the second place, for a copy of the map; the one at the first is learned
    before, so that the copy has room as a map that grows has it."""
    model, seeds = copy.deepcopy(model), (10_000 + 2 * turn, 10_001 + 2 * turn)
    before, scan = (
        street_scan(place, 20_000, seed) for place, seed in zip(places, seeds, strict=True)
    )
    stream_scans(model, [before], StreamConfig(radius=radius, seed=seeds[0]))
    config = StreamConfig(radius=radius, seed=seeds[1])
    return seconds_of(lambda: stream_scans(model, [scan], config))


def fading(arguments: argparse.Namespace) -> list[Row]:
    """A box of 1 m is seen for some scans and then removed: scans until its place is free."""
    lower = torch.tensor([10.0, -1.0, 0.2], dtype=torch.float64)
    box = (lower, lower + 1.0)
    rows = []
    for stood in (1, 10, 100):
        model = LardHilbertMap()
        for seed in range(stood):
            stream_scans(
                model, [street_scan(0.1 * (seed % 20), 20_000, seed, box)], StreamConfig(seed=seed)
            )
        seen = street_scan(1.0, 20_000, 999, box)
        on_box = ((seen.ends > box[0] - 0.1) & (seen.ends < box[1] + 0.1)).all(dim=1)
        row: Row = {"stood for scans": stood, "hits on it": int(on_box.sum())}
        row["occupied before"] = float((model(seen.ends[on_box]) > 0.5).double().mean())
        row |= {"scans until 50% left": "> 30", "scans until 10% left": "> 30"}
        for after in range(1, 31):
            scan = street_scan(0.1 * (after % 20), 20_000, 1_000 + after)
            stream_scans(model, [scan], StreamConfig(seed=after))
            left = float((model(seen.ends[on_box]) > 0.5).double().mean())
            for share in (0.5, 0.1):
                name = f"scans until {share:.0%} left"
                if left <= share and row[name] == "> 30":
                    row[name] = after
        row["left after 30"] = left
        rows.append(row)
    return rows


def spacing(arguments: argparse.Namespace) -> list[Row]:
    """Held-out rays at three places of a street of 80 m, for several distances between scans."""
    rows = []
    places = [street_scan(x, 8_000, 90_000 + int(x)) for x in (30.3, 40.1, 50.7)]
    tests = [protocol_rays(scan) for scan in places]
    for meters in (0.2, 0.5, 1.0, 2.0, 4.0):
        model = LardHilbertMap()
        for number in range(int(80 / meters)):
            scan = street_scan(meters * number, 20_000, number)
            stream_scans(model, [scan], StreamConfig(seed=number))
        row: Row = {"meters between scans": meters, "scans": number + 1, "clusters": len(model)}
        tables = [evaluate(model, test) for test in tests]
        for kind in ("unif", "near"):
            for score in ("balanced_accuracy", "log_loss"):
                values = [table[kind][score] for table in tables]
                row[f"{kind} {score}"] = statistics.mean(values)
        rows.append(row)
    return rows


PARTS = (accuracy, revisits, speed, growth, fading, spacing)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--only", nargs="+", choices=[part.__name__ for part in PARTS])
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="random seed of the split of the accuracy part (default: 0)",
    )
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "incremental.json")
    arguments = parser.parse_args()
    missing = [name for name in arguments.sets if not (arguments.data / name).is_dir()]
    if missing:
        sys.exit(f"--sets must be folders in {arguments.data}; missing: {missing}")
    record: dict[str, Any] = {"conditions": conditions()}
    print(describe(record["conditions"]), end="\n\n")
    for part in PARTS:
        if not arguments.only or part.__name__ in arguments.only:
            record[part.__name__] = part(arguments)
            title = (part.__doc__ or "").strip()
            print(format_rows({"title": title, "rows": record[part.__name__]}), flush=True)
            print()
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
