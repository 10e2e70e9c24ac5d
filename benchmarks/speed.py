"""Time and memory: the paper's tables against the others, growth, and the machine's floor.

Each comparison is one function and can run alone:

    python benchmarks/speed.py --only query train

Contenders run in turn after a warm-up; medians and ratios are printed, all runs on the threads of
``--threads``. Keep the machine quiet.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from scenes import labelled_hills, made_up_map, queries
from table_two import (
    NUM_CLUSTERS,
    NUM_NEIGHBORS,
    PlainLibraries,
    Task,
    fit_map,
    inertia,
    insert,
    load_octomap,
    load_task,
    scan_arrays,
    sklearn_kmeans,
)
from timing import Contender, compare, format_comparison, format_rows
from workers import peak_memory, plain_path

from lardhm_torch import FitConfig, LardHilbertMap, load_scans, sample_rays
from lardhm_torch.clustering import cluster_moments, factor_covariances, mini_batch_kmeans
from lardhm_torch.fitting import fit_weights
from lardhm_torch.native import nearest_centers

# Table I and II of the paper [ms]: 8 cores of 2.5 GHz, 500 clusters.
PAPER_STAGES = {
    "k-means": 471,
    "length-scales": 23,
    "training features": 116,
    "weights": 4,
    "grid features": 873,
    "grid query": 17,
}
PAPER_TOTALS = {
    "query": {"LARD-HM": 849, "OctoMap": 11, "Original HM": 25473, "Local GP": 72121},
    "train": {"LARD-HM": 216, "OctoMap": 130, "Original HM": 3440, "Local GP": 7241},
}
CANDIDATES = 26  # centers a point is compared with, of the floor's count of operations
Result = dict[str, Any]


def plain_jobs(data: Path) -> dict[str, Callable[[], Any]]:
    """What the process without the native kernel can be asked to do."""
    task = load_task(data)
    model = fit_map(task)
    return {
        "fit": lambda: fit_map(task),
        "lattice": lambda: model(task.grid),
        "random": lambda: model(task.shuffled),
    }


def octomaps() -> dict[str, Any]:
    """The installed OctoMap libraries by the name of their distribution."""
    names = {"octomap-python": "octomap", "pyoctomap": "pyoctomap"}
    found = {name: load_octomap(module) for name, module in names.items()}
    return {name: library for name, library in found.items() if library is not None}


# --- Table II ---


def query(arguments: argparse.Namespace) -> Result:
    """Points to probabilities, on the grid of Table II."""
    task = load_task(arguments.data)
    model = fit_map(task)
    libraries = PlainLibraries().fit(task.points, task.labels, *sgd_schedule(len(task.points)))
    with plain_path(plain_jobs, arguments.data) as plain:
        contenders = [
            Contender("LARD-HM, lattice order", lambda: model(task.grid)),
            Contender("LARD-HM, random order", lambda: model(task.shuffled)),
            Contender("plain torch path, lattice order", partial(plain, "lattice")),
            Contender("plain torch path, random order", partial(plain, "random")),
            Contender("SciPy k-d tree + torch, lattice", lambda: libraries.query(task.grid)),
        ]
        for name, library in octomaps().items():
            tree = insert(library, scan_arrays(task.scans), discretize=False)
            for order, points in (("lattice", task.grid), ("random", task.shuffled)):
                look_up = partial(tree.getLabels, points.double().numpy())
                contenders.append(Contender(f"{name} getLabels 0.05 m, {order}", look_up))
        result = compare("Query, Table II", contenders, arguments.repeats, len(task.grid))
    return result | {"notes": [paper_note("query")]}


def train(arguments: argparse.Namespace) -> Result:
    """Points (or rays) in memory to a map that can be asked, clustering included."""
    task = load_task(arguments.data)
    schedule = sgd_schedule(len(task.points))
    rays = scan_arrays(task.scans)
    with plain_path(plain_jobs, arguments.data) as plain:
        contenders = [
            Contender("LARD-HM fit", lambda: fit_map(task)),
            Contender("plain torch path", partial(plain, "fit")),
            Contender(
                "MiniBatchKMeans + k-d tree + SGD",
                lambda: PlainLibraries().fit(task.points, task.labels, *schedule),
            ),
        ]
        for name, library in octomaps().items():
            for discretize in (False, True):
                label = f"{name} insert 0.05 m" + (", discretized" if discretize else "")
                contenders.append(Contender(label, partial(insert, library, rays, discretize)))
        result = compare("Training, Table II", contenders, arguments.repeats, len(task.points))
    return result | {"notes": [paper_note("train")]}


def sgd_schedule(num_points: int) -> tuple[int, int]:
    """Passes and batch size of our defaults, for the contender that trains in plain torch."""
    config = FitConfig()
    return config.passes, config.batch_size or max(256, num_points // 128)


def paper_note(kind: str) -> str:
    """The paper's own figures, for a look across machines and years."""
    figures = ", ".join(f"{name} {ms:,} ms" for name, ms in PAPER_TOTALS[kind].items())
    return f"paper, Table II (8 cores of 2.5 GHz, 2016): {figures}"


# --- Table I ---


def stages(arguments: argparse.Namespace) -> Result:
    """The steps of Table I one by one, ours and the paper's."""
    task = load_task(arguments.data)
    model = fit_map(task)
    rows = []
    for name, run in stage_calls(task, model).items():
        timed = compare(name, [Contender(name, run)], arguments.repeats, len(task.points))
        ms = timed["rows"][0]["median_ms"]
        paper = PAPER_STAGES[name]
        rows.append({"stage": name, "ours ms": ms, "paper ms": paper, "ratio": paper / ms})
    notes = [
        "grid query is one fused pass that holds no features: it stands for the paper's last two "
        "rows together. The paper's times are from 8 cores of 2.5 GHz; its SGD is one pass, ours "
        f"{FitConfig().passes}."
    ]
    return {"title": "Stages, Table I", "rows": rows, "notes": notes}


def stage_calls(task: Task, model: LardHilbertMap) -> dict[str, Callable[[], Any]]:
    """One call for each row of Table I."""
    classes = [task.points[task.labels == value] for value in (1, 0)]
    half = NUM_CLUSTERS // 2

    def kmeans() -> list[torch.Tensor]:
        rng = torch.Generator().manual_seed(0)
        return [mini_batch_kmeans(points, half, rng) for points in classes]

    centers = kmeans()

    def lengthscales() -> None:
        for points, means in zip(classes, centers, strict=True):
            nearest = nearest_centers(points, means, 1).squeeze(1)
            clusters = cluster_moments(points, nearest, half)
            factor_covariances(clusters.covariances, model.min_lengthscale)

    features = model.features(task.points)
    indices = features.indices()[1].reshape(len(task.points), -1)
    values = features.values().reshape(len(task.points), -1)

    def weights() -> torch.Tensor:
        rng = torch.Generator().manual_seed(0)
        start = torch.zeros(len(model))
        kept = lambda rows: (indices[rows], values[rows])  # noqa: E731
        return fit_weights(kept, task.labels, start, FitConfig(), rng)

    return {
        "k-means": kmeans,
        "length-scales": lengthscales,
        "training features": lambda: model.features(task.points),
        "weights": weights,
        "grid features": lambda: model.features(task.grid),
        "grid query": lambda: model(task.grid),
    }


def kmeans(arguments: argparse.Namespace) -> Result:
    """k-means of one class against scikit-learn's, with the inertia each reached."""
    task = load_task(arguments.data)
    points = task.points[task.labels == 1]
    half = NUM_CLUSTERS // 2

    def ours() -> torch.Tensor:
        return mini_batch_kmeans(points, half, torch.Generator().manual_seed(0))

    def theirs() -> Any:
        return sklearn_kmeans(points.numpy(), half)

    contenders = [Contender("LARD-HM", ours), Contender("scikit-learn, one thread", theirs)]
    result = compare("k-means, 250 clusters", contenders, arguments.repeats, len(points))
    centers = torch.as_tensor(theirs().cluster_centers_)
    ratio = inertia(points, ours()) / inertia(points, centers)
    result["inertia_ratio"] = ratio
    return result | {"notes": [f"inertia: ours / scikit-learn's = {ratio:.4f}"]}


# --- growth ---


def growth_clusters(arguments: argparse.Namespace) -> Result:
    """Query time a point as the map grows from 500 to 200,000 clusters, random order."""
    count = 500_000
    rows: list[dict[str, Any]] = []
    for num_clusters in (500, 5_000, 50_000, 200_000):
        model, points = made_up_map(num_clusters), queries(num_clusters, count)
        first = time_once(partial(model, points[:1]))
        ask = Contender("query", partial(model, points))
        timed = compare("query", [ask], arguments.repeats, count)["rows"][0]
        size = sum(t.numel() * t.element_size() for t in (*model.parameters(), *model.buffers()))
        rows.append(
            {
                "clusters": num_clusters,
                "ns a point": timed["item_ns"],
                "ratio to smallest": timed["item_ns"] / rows[0]["ns a point"] if rows else 1.0,
                "first query ms (index)": 1e3 * first,
                "bytes a cluster": size / num_clusters,
            }
        )
    notes = [f"{count:,} points, k = {NUM_NEIGHBORS}; clusters cover more ground, equally dense"]
    return {"title": "Growth with clusters", "rows": rows, "notes": notes}


def growth_points(arguments: argparse.Namespace) -> Result:
    """Training time a point as scene and number of clusters grow with the points."""
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
    """Time of one more scan as a map is built from many (needs `LardHilbertMap.update`)."""
    model: Any = LardHilbertMap(dim=3, num_neighbors=NUM_NEIGHBORS)
    if not hasattr(model, "update"):
        note = "skipped: this version of LardHilbertMap has no update"
        return {"title": "Growth with scans", "rows": [{"scans": 0}], "notes": [note]}
    rows = []
    points, labels = labelled_hills(2_000 * 1_000)
    strips = points[:, 0].argsort().split(2_000)  # a walk over the hills, one strip a scan
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
    """Ten million points and the map they are put to."""
    model, points = made_up_map(NUM_CLUSTERS), queries(NUM_CLUSTERS, num_points)
    model(points[:1])
    return lambda: model(points)


def fit_job(path: Path, num_clusters: int) -> Callable[[], Any]:
    """All samples of a set, and the map that learns them."""
    samples = sample_rays(load_scans(path), seed=0)
    model = LardHilbertMap(dim=3)
    return lambda: model.fit(samples.points, samples.labels, num_clusters=num_clusters)


def memory(arguments: argparse.Namespace) -> Result:
    """Peak memory on top of the input, in fresh processes."""
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
    """What the machine needs at least for the grid of Table II, from its measured rates."""
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
    """Bytes a second, read and written, of a copy far larger than the caches."""
    source = torch.ones(64 << 20)
    target = torch.empty_like(source)
    timed = compare("copy", [Contender("copy", lambda: target.copy_(source))], repeats, 1)
    return 2 * source.numel() * 4 / (timed["rows"][0]["median_ms"] / 1e3)


def measured_rate(repeats: int) -> float:
    """Float32 operations a second of a matrix product."""
    left, right = torch.rand(1024, 1024), torch.rand(1024, 1024)
    timed = compare("product", [Contender("product", lambda: left @ right)], repeats, 1)
    return 2 * 1024**3 / (timed["rows"][0]["median_ms"] / 1e3)


PARTS: dict[str, Callable[[argparse.Namespace], Result]] = {
    "query": query,
    "train": train,
    "stages": stages,
    "kmeans": kmeans,
    "growth_clusters": growth_clusters,
    "growth_points": growth_points,
    "growth_scans": growth_scans,
    "memory": memory,
    "floor": floor,
}


def parse_arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--max-points", type=int, default=10**6, help="of growth_points")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "speed.json")
    return parser.parse_args(argv)


@torch.no_grad()
def main() -> None:
    arguments = parse_arguments()
    torch.set_num_threads(arguments.threads)
    record: dict[str, Any] = {"conditions": conditions(), "parts": {}}
    print(describe(record["conditions"]))
    for name in arguments.only:
        result = PARTS[name](arguments)
        record["parts"][name] = result
        show = format_comparison if "repeats" in result else format_rows
        print("\n" + show(result), flush=True)
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
