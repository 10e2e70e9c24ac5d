"""Growth of time and memory with a map, and the lower bound of the machine: parts of speed.py."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from scenes import labelled_hills, made_up_map, queries
from table_two import NUM_CLUSTERS, NUM_NEIGHBORS, fit_map, load_task
from timing import Contender, compare
from workers import peak_memory

from lardhm_torch import LardHilbertMap, load_scans, sample_rays

FIXED, DENSE = "500,000 points", "40 points a cluster"
CANDIDATES = 26  # centers per point in the count of operations of the lower bound
Result = dict[str, Any]


# --- growth ---


def growth_clusters(arguments: argparse.Namespace) -> Result:
    """Query time per point as the map grows from 500 to 200,000 clusters, random order.

    Once with as many points for every map, and once with as many points a cluster.
    """
    rows: list[dict[str, Any]] = []
    for num_clusters in (500, 5_000, 50_000, 200_000):
        model = made_up_map(num_clusters)
        first = time_once(partial(model, queries(num_clusters, 1)))
        size = sum(t.numel() * t.element_size() for t in (*model.parameters(), *model.buffers()))
        row: dict[str, Any] = {"clusters": num_clusters}
        for name, count in ((FIXED, 500_000), (DENSE, 40 * num_clusters)):
            ask = Contender("query", partial(model, queries(num_clusters, count)))
            timed = compare("query", [ask], arguments.repeats, count)["rows"][0]
            row[name] = timed["item_ns"]
            row[f"{name}, ratio"] = row[name] / rows[0][name] if rows else 1.0
        rows.append(row | {"first query ms": 1e3 * first, "bytes a cluster": size / num_clusters})
    notes = [f"k = {NUM_NEIGHBORS}; clusters cover more ground, equally dense"]
    return {"title": "Growth with clusters: ns a point", "rows": rows, "notes": notes}


def growth_points(arguments: argparse.Namespace) -> Result:
    """Training time per point as the scene and the number of clusters grow with the points."""
    rows = []
    for count in (10**exponent for exponent in range(4, 8)):
        if count > arguments.max_points:
            break
        points, labels = labelled_hills(count)
        num_clusters = count // 200
        model = LardHilbertMap(dim=3, num_neighbors=NUM_NEIGHBORS)
        run = partial(model.fit, points, labels, num_clusters=num_clusters)
        repeats = arguments.repeats if count <= 10**5 else 3 if count <= 10**6 else 1
        seconds = statistics.median(time_once(run) for _ in range(repeats))
        row = {"points": count, "clusters": num_clusters, "seconds": seconds}
        rows.append(row | {"ns a point": 1e9 * seconds / count, "repeats": repeats})
    notes = ["M = N / 200; the ground grows with the points; 10^7 with --max-points 10000000"]
    return {"title": "Growth with points: fit", "rows": rows, "notes": notes}


def growth_scans(arguments: argparse.Namespace) -> Result:
    """Time of one more scan as a map is built from many scans."""
    model: Any = LardHilbertMap(dim=3, num_neighbors=NUM_NEIGHBORS)
    if not hasattr(model, "update"):
        note = "skipped: this version of LardHilbertMap has no update"
        return {"title": "Growth with scans", "rows": [{"scans": 0}], "notes": [note]}
    rows = []
    points, labels = labelled_hills(2_000 * 1_000)
    strips = points[:, 0].argsort().split(2_000)  # a walk over the hills, one strip per scan
    seconds: list[float] = []
    for number, strip in enumerate(strips, start=1):
        add = partial(model.update, points[strip], labels[strip], num_clusters=20)
        seconds.append(time_once(add))
        if number in (1, 10, 100, 1_000):
            latest = statistics.median(seconds[-10:])
            rows.append({"scans": number, "clusters": len(model), "ms a scan": 1e3 * latest})
    notes = ["2,000 points a scan; median of the last ten scans"]
    return {"title": "Growth with scans: update", "rows": rows, "notes": notes}


def time_once(run: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


# --- memory and floor ---


def query_job(num_points: int) -> Callable[[], Any]:
    """Ten million points, and the map that is queried with them."""
    model, points = made_up_map(NUM_CLUSTERS), queries(NUM_CLUSTERS, num_points)
    model(points[:1])
    return lambda: model(points)


def fit_job(path: Path, num_clusters: int) -> Callable[[], Any]:
    """All samples of a set, and the map that is fitted to them."""
    samples = sample_rays(load_scans(path), seed=0)
    model = LardHilbertMap(dim=3)
    return lambda: model.fit(samples.points, samples.labels, num_clusters=num_clusters)


def memory(arguments: argparse.Namespace) -> Result:
    """Peak memory beyond the input, in new processes."""
    count, path = 10_000_000, arguments.data / "riegl_vz400i_rtls" / "scans.npz"
    jobs: dict[str, tuple[Any, ...]] = {
        f"query of {count:,} points (output of {4 * count / 1e6:.0f} MB included)": (
            query_job,
            count,
        )
    }
    if path.exists():
        jobs["fit of the whole riegl set, 1500 clusters"] = (fit_job, path, 1500)
    rows = [{"job": name, "peak MB": peak_memory(*job) / 1e6} for name, job in jobs.items()]
    return {"title": "Memory on top of the input", "rows": rows}


def floor(arguments: argparse.Namespace) -> Result:
    """Lower bound of the time for the grid of Table II, from the measured rates of the machine."""
    task = load_task(arguments.data)
    model = fit_map(task)
    timed = compare("q", [Contender("q", lambda: model(task.grid))], arguments.repeats, 1)
    ours = timed["rows"][0]["median_ms"]
    bandwidth, rate = measured_bandwidth(arguments.repeats), measured_rate(arguments.repeats)
    moved = len(task.grid) * (3 + 1) * 4
    operations = len(task.grid) * (CANDIDATES * 8 + NUM_NEIGHBORS * 30)
    bounds = {
        f"memory: {moved / 1e6:.1f} MB at {bandwidth / 1e9:.1f} GB/s": 1e3 * moved / bandwidth,
        f"arithmetic: {operations / 1e6:.0f} M at {rate / 1e9:.0f} G/s": 1e3 * operations / rate,
    }
    rows = [{"bound": name, "ms": ms, "ours / bound": ours / ms} for name, ms in bounds.items()]
    notes = [
        f"ours: {ours:.2f} ms. Counted: 12 bytes in, 4 out; {CANDIDATES} squared distances of 8 "
        f"operations and {NUM_NEIGHBORS} kernels of 30. The rate is that of a matrix product, "
        "which selection and gathers never reach."
    ]
    return {"title": "Floor of the query", "rows": rows, "notes": notes}


def measured_bandwidth(repeats: int) -> float:
    """Rate of a copy that is much larger than the caches [bytes/s], read and written."""
    source = torch.ones(64 << 20)
    target = torch.empty_like(source)
    timed = compare("copy", [Contender("copy", lambda: target.copy_(source))], repeats, 1)
    return 2 * source.numel() * 4 / (timed["rows"][0]["median_ms"] / 1e3)


def measured_rate(repeats: int) -> float:
    """Rate of a matrix product [float32 operations/s]."""
    left, right = torch.rand(1024, 1024), torch.rand(1024, 1024)
    timed = compare("product", [Contender("product", lambda: left @ right)], repeats, 1)
    return 2 * 1024**3 / (timed["rows"][0]["median_ms"] / 1e3)
