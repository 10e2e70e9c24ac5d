"""Accuracy and calibration on held-out rays: the map with its defaults against OctoMap.

The protocol: rays with 0.3 m < range < 60 m that hit and are the first of their pulse; at most
``--rays`` of a set, a random ``--ratio`` of them trains; the rest gives the test points. Every
system sees only the training rays and keeps its default settings.

    python benchmarks/accuracy.py --data ../shared/data --sets paper_virtual tdtk_dat
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import LardHilbertMap, Scans, load_scans, sample_rays, split_rays
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

Model = Callable[[Tensor], Tensor]
System = Callable[[Scans, int], Model]
Scores = dict[str, dict[str, float]]  # kind of free point -> name of the score -> value

RESOLUTIONS = (0.05, 0.1, 0.2, 0.4)  # [m] voxels of OctoMap
COLUMNS = ("balanced_accuracy", "auc", "log_loss", "ece")
LOWER_IS_BETTER = ("log_loss", "brier", "ece", "unknown")


def lard_hilbert_map(train: Scans, seed: int) -> Model:
    """The map with its defaults: samples of the rays, clusters, weights."""
    samples = sample_rays(train, seed=seed)
    model = LardHilbertMap(dim=train.dim).fit(samples.points, samples.labels, seed=seed)
    return model


@torch.enable_grad()
def tuned_hilbert_map(train: Scans, seed: int) -> Model:
    """The same with centers, length-scales and weights trained by backpropagation."""
    from lardhm_torch import fine_tune

    samples = sample_rays(train, seed=seed)
    model = LardHilbertMap(dim=train.dim).fit(samples.points, samples.labels, seed=seed)
    fine_tune(
        model,
        samples.points,
        samples.labels,
        resample=lambda epoch: sample_rays(train, seed=seed + epoch),
        seed=seed,
    )
    return model


def octomap(resolution: float) -> System:
    """OctoMap with voxels of one size and its default sensor model."""
    return lambda train, seed: OctoMapBaseline(resolution).fit(train)


def choose_systems(names: list[str]) -> dict[str, System]:
    """Systems of the names on the command line, in the order of the table."""
    systems: dict[str, System] = {}
    if "map" in names:
        systems["LARD-HM"] = lard_hilbert_map
    if "tuned" in names:
        systems["LARD-HM tuned"] = tuned_hilbert_map
    if "octomap" in names:
        systems |= {f"OctoMap {edge} m": octomap(edge) for edge in RESOLUTIONS}
    return systems


def run_set(
    scans: Scans, systems: dict[str, System], arguments: argparse.Namespace
) -> dict[str, Any]:
    """Scores of every system, one entry a seed, and the seconds training took."""
    runs: dict[str, Any] = {name: {"scores": [], "seconds": []} for name in systems}
    for seed in arguments.seeds:
        rays = protocol_rays(scans, arguments.rays, seed)
        train, test = split_rays(rays, arguments.ratio, seed)
        for name, build in systems.items():
            start = time.perf_counter()
            model = build(train, seed)
            runs[name]["seconds"].append(time.perf_counter() - start)
            runs[name]["scores"].append(evaluate(model, test, seed))
    table = {name: mean_scores(run["scores"]) for name, run in runs.items()}
    voxels = [table[name] for name in table if name.startswith("OctoMap")]
    if len(voxels) > 1:
        table["OctoMap, best of each"] = best_scores(voxels)
    return {"rays": len(rays), "table": table, "runs": runs}


def mean_scores(runs: list[Scores]) -> Scores:
    """Mean over the seeds, and where there are several their standard deviation as ``<name>_std``."""
    means: Scores = {}
    for kind in runs[0]:
        means[kind] = {}
        for name in runs[0][kind]:
            values = [run[kind][name] for run in runs]
            means[kind][name] = statistics.fmean(values)
            if len(values) > 1:
                means[kind][f"{name}_std"] = statistics.stdev(values)
    return means


def best_scores(tables: list[Scores]) -> Scores:
    """The best of several systems, each figure on its own: flattering, and meant to be."""
    best: Scores = {}
    for kind, scores in tables[0].items():
        best[kind] = {}
        for name in scores:
            if not name.endswith("_std"):
                choose = min if name in LOWER_IS_BETTER else max
                best[kind][name] = choose(table[kind][name] for table in tables)
    return best


def format_set(name: str, result: dict[str, Any]) -> str:
    """Text table of one set, one row a system; unif / near figures in one cell."""
    heads = "".join(column.rjust(18) for column in COLUMNS)
    lines = [f"{name} ({result['rays']} rays); unif / near", " " * 24 + heads + "   train [s]"]
    for system, scores in result["table"].items():
        cells = "".join(
            f"{scores['unif'][column]:.3f} / {scores['near'][column]:.3f}".rjust(18)
            for column in COLUMNS
        )
        seconds = result["runs"].get(system, {}).get("seconds")
        took = f"{statistics.median(seconds):12.2f}" if seconds else ""
        lines.append(system.ljust(24) + cells + took)
    spread = max(
        (
            value
            for scores in result["table"].values()
            for kind in ("unif", "near")
            for name, value in scores[kind].items()
            if name.removesuffix("_std") in COLUMNS and name.endswith("_std")
        ),
        default=math.nan,
    )
    if not math.isnan(spread):
        lines.append(f"largest standard deviation over the seeds: {spread:.4f}")
    return "\n".join(lines)


def find_sets(folder: Path, names: list[str] | None) -> dict[str, Path]:
    """The 3-D sets in a data folder: one folder each, with scans.npz in it."""
    found = {path.parent.name: path for path in sorted(folder.glob("*/scans.npz"))}
    if names is None:
        return {name: path for name, path in found.items() if name != "hilbert2015_intel"}
    missing = [name for name in names if name not in found]
    if missing:
        sys.exit(f"--sets must be folders with scans.npz in {folder}; missing: {missing}")
    return {name: found[name] for name in names}


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", help="names of folders; default: all 3-D sets")
    parser.add_argument("--rays", type=int, default=120_000, help="at most so many of a set")
    parser.add_argument("--ratio", type=float, default=0.5, help="share of the rays that trains")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--systems", nargs="+", default=["map", "octomap"])
    parser.add_argument("--tune", action="store_true", help="add the map after fine_tune")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "accuracy.json")
    return parser.parse_args()


@torch.no_grad()
def main() -> None:
    arguments = parse_arguments()
    names = [*arguments.systems, *(["tuned"] if arguments.tune else [])]
    systems = choose_systems(names)
    sets = find_sets(arguments.data, arguments.sets)
    if not sets or not systems:
        sys.exit(f"nothing to measure: sets {list(sets)} in {arguments.data}, systems {names}")
    record: dict[str, Any] = {"conditions": conditions(), "sets": {}}
    record["protocol"] = {key: getattr(arguments, key) for key in ("rays", "ratio", "seeds")}
    print(describe(record["conditions"]), end="\n\n")
    for name, path in tqdm(sets.items(), disable=None):
        record["sets"][name] = run_set(load_scans(path), systems, arguments)
        tqdm.write(format_set(name, record["sets"][name]) + "\n")
        sys.stdout.flush()
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
