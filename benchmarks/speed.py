"""Time and memory: the tasks of the paper, growth, and the lower bound of the machine.

Each comparison is one function and can be run alone:

    python benchmarks/speed.py --only query train

After a warm-up the systems are timed alternately; medians and ratios are printed. All use the number
of threads given by ``--threads``. The machine should be idle.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from default_query import default_query
from growth import floor, growth_clusters, growth_points, growth_scans, memory
from table_two import (
    NUM_CLUSTERS,
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
from workers import plain_path

from lardhm_torch import FitConfig, LardHilbertMap, native
from lardhm_torch.learning.clustering import clusters_from_moments
from lardhm_torch.learning.fitting import fit_weights, stratified_batches
from lardhm_torch.learning.kmeans import mini_batch_kmeans
from lardhm_torch.learning.map_state import factor_covariances
from lardhm_torch.learning.points import in_morton_order

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
Result = dict[str, Any]


def plain_jobs(data: Path) -> dict[str, Callable[[], Any]]:
    """Jobs for the process without the native kernel."""
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
            Contender("LARD-HM, query_lattice", lambda: model.query_lattice(task.axes)),
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
    """Points (or rays) in memory to a fitted map, clustering included."""
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
    """Passes and batch size of the defaults, for the system that trains in plain torch."""
    config = FitConfig()
    return config.passes_over(num_points), config.rows_per_batch(num_points)


def paper_note(kind: str) -> str:
    """The figures of the paper, from another machine."""
    figures = ", ".join(f"{name} {ms:,} ms" for name, ms in PAPER_TOTALS[kind].items())
    return f"paper, Table II (8 cores of 2.5 GHz, 2016): {figures}"


# --- Table I ---


def stages(arguments: argparse.Namespace) -> Result:
    """The steps of Table I separately, beside the times of the paper."""
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
        f"{FitConfig().passes_over(len(task.points))}."
    ]
    return {"title": "Stages, Table I", "rows": rows, "notes": notes}


def stage_calls(task: Task, model: LardHilbertMap) -> dict[str, Callable[[], Any]]:
    """One call for each row of Table I."""
    classes = [task.points[task.labels == value] for value in (1, 0)]
    half = NUM_CLUSTERS // 2

    def kmeans() -> list[torch.Tensor]:
        rng = torch.Generator().manual_seed(0)
        return [mini_batch_kmeans(*in_morton_order(points), half, rng) for points in classes]

    centers = kmeans()

    def lengthscales() -> None:
        for points, means in zip(classes, centers, strict=True):
            clusters = clusters_from_moments(means, *native.assign(points, means)[1:])
            factor_covariances(clusters.covariances, model.min_lengthscale)

    config, rng = FitConfig(), torch.Generator().manual_seed(0)
    samples = in_morton_order(task.points - model.origin.float(), task.labels)
    local, labels = stratified_batches(samples, config.rows_per_batch(len(task.points)), rng)
    state = (model.centers, model.raw_scale_tril, model.kernel)
    index = native.build_index(model.centers, model.num_neighbors)

    def features() -> tuple[torch.Tensor, torch.Tensor]:
        return native.nearest_features(local, *state, index)

    kept = features()

    def weights() -> torch.Tensor:
        start = torch.zeros(len(model))
        return fit_weights(lambda rows: (kept[0][rows], kept[1][rows]), labels, start, config)

    return {
        "k-means": kmeans,
        "length-scales": lengthscales,
        "training features": features,
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
        return mini_batch_kmeans(*in_morton_order(points), half, torch.Generator().manual_seed(0))

    def theirs() -> Any:
        return sklearn_kmeans(points.numpy(), half)

    contenders = [Contender("LARD-HM", ours), Contender("scikit-learn, one thread", theirs)]
    result = compare("k-means, 250 clusters", contenders, arguments.repeats, len(points))
    centers = torch.as_tensor(theirs().cluster_centers_)
    ratio = inertia(points, ours()) / inertia(points, centers)
    result["inertia_ratio"] = ratio
    return result | {"notes": [f"inertia: ours / scikit-learn's = {ratio:.4f}"]}


PARTS: dict[str, Callable[[argparse.Namespace], Result]] = {
    "query": query,
    "default_query": default_query,
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
    parser.add_argument(
        "--rays",
        type=int,
        default=120_000,
        help="most rays per set of default_query (default: 120000)",
    )
    parser.add_argument(
        "--max-points",
        type=int,
        default=10**6,
        help="most points of growth_points (default: 1000000)",
    )
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
