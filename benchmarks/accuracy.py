"""Accuracy and calibration on held-out rays: default maps compared with OctoMap.

Protocol: rays with 0.3 m < range < 60 m that hit and are the first return of their pulse; at most
``--rays`` of a set. A random fraction ``--ratio`` of them trains, the rest gives the test points.
Every system sees only the training rays and uses its default settings.

With ``--whole-scans`` even scans train and odd scans test; of fewer than 4 scans, each is the test
scan in turn. Test points then also lie in space that no training ray observed.

    python benchmarks/accuracy.py --data ../shared/data --sets paper_virtual tdtk_dat
    python benchmarks/accuracy.py --whole-scans --tune
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe, write_json
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    Scans,
    load_scans,
    sample_rays,
    scan_disagreement,
    split_rays,
)
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

# A 2-D set, and sets of other benchmarks: measured only if they are named.
NOT_BY_DEFAULT = ("hilbert2015_intel", "stream_balm", "stream_sevenscenes")
Model = Callable[[Tensor], Tensor]
System = Callable[[Scans, int], Model]
Scores = dict[str, dict[str, float]]  # kind of free point -> name of the score -> value

RESOLUTIONS = (0.05, 0.1, 0.2, 0.4)  # [m] voxels of OctoMap
WHOLE_SCAN_RESOLUTIONS = RESOLUTIONS[1:]
FEW_SCANS = 4  # fewer: every scan is the test scan in turn
COLUMNS = ("balanced_accuracy", "auc", "log_loss", "ece", "unknown")
BEST = "OctoMap, best of each"
LOWER_IS_BETTER = ("log_loss", "brier", "ece", "unknown")


def lard_hilbert_map(train: Scans, seed: int, *, is_blurred: bool = False) -> Model:
    """A map with default settings, or as by ``lardhm fit --hit-noise auto``."""
    samples = sample_rays(train, seed=seed)
    config = FitConfig(hit_noise=scan_disagreement(train) if is_blurred else 0.0)
    model = LardHilbertMap(dim=train.dim)
    return model.fit(samples.points, samples.labels, seed=seed, config=config)


@torch.enable_grad()
def tuned_hilbert_map(train: Scans, seed: int, *, is_blurred: bool = False) -> Model:
    """A fine-tuned map, as by ``lardhm fit --tune`` and, if wanted, ``--hit-noise auto``."""
    from lardhm_torch import TuneConfig, fine_tune

    samples = sample_rays(train, seed=seed)
    noise = scan_disagreement(train) if is_blurred else 0.0
    config = FitConfig(hit_noise=noise)
    model = LardHilbertMap(dim=train.dim)
    model.fit(samples.points, samples.labels, seed=seed, config=config)
    fine_tune(
        model,
        samples.points,
        samples.labels,
        resample=lambda epoch: sample_rays(train, seed=seed + epoch),
        seed=seed,
        config=TuneConfig(hit_noise=noise),
    )
    return model


def octomap(resolution: float) -> System:
    """OctoMap with one voxel size and its default sensor model."""
    return lambda train, seed: OctoMapBaseline(resolution).fit(train)


def choose_systems(
    names: list[str], resolutions: tuple[float, ...], is_blurred: bool
) -> dict[str, System]:
    """Return the systems named on the command line, in the order of the table."""
    systems: dict[str, System] = {}
    for name, title, build in (
        ("map", "LARD-HM", lard_hilbert_map),
        ("tuned", "LARD-HM tuned", tuned_hilbert_map),
    ):
        if name in names:
            systems[title] = build
            if is_blurred:
                systems[f"{title}, hit noise"] = partial(build, is_blurred=True)
    if "octomap" in names:
        systems |= {f"OctoMap {edge} m": octomap(edge) for edge in resolutions}
    return systems


def whole_scan_splits(rays: Scans) -> list[tuple[Scans, Scans]]:
    """Split rays into training and test rays by scan.

    Returns:
        One split, even scans and odd scans; of 2 or 3 scans, one split per test scan.

    Raises:
        ValueError: there is only one scan.
    """
    scans = rays.scan_id.unique()
    if len(scans) < 2:
        raise ValueError("whole scans are held out of two or more; got one")
    number = torch.searchsorted(scans, rays.scan_id)  # 0, 1, 2, ... without gaps
    if len(scans) < FEW_SCANS:
        tests = [number == test for test in range(len(scans))]
    else:
        tests = [number % 2 == 1]
    return [(rays.select(~test), rays.select(test)) for test in tests]


def run_set(
    scans: Scans, systems: dict[str, System], arguments: argparse.Namespace
) -> dict[str, Any]:
    """Scores of every system, one entry per seed and split, and the training time [s]."""
    runs: dict[str, Any] = {name: {"scores": [], "seconds": []} for name in systems}
    for seed in arguments.seeds:
        rays = protocol_rays(scans, arguments.rays, seed=seed)
        if arguments.whole_scans:
            splits = whole_scan_splits(rays)
        else:
            splits = [split_rays(rays, arguments.ratio, seed=seed)]
        for train, test in splits:
            for name, build in systems.items():
                start = time.perf_counter()
                model = build(train, seed)
                runs[name]["seconds"].append(time.perf_counter() - start)
                runs[name]["scores"].append(evaluate(model, test, seed=seed))
    table = {name: mean_scores(run["scores"]) for name, run in runs.items()}
    voxels = [table[name] for name in table if name.startswith("OctoMap")]
    if len(voxels) > 1:
        table[BEST] = best_scores(voxels)
    return {"rays": len(rays), "table": table, "runs": runs}


def mean_scores(runs: list[Scores]) -> Scores:
    """Mean over the runs; of several runs also the standard deviation, as ``<name>_std``."""
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
    """The best of several systems for each figure separately, which favors these systems."""
    best: Scores = {}
    for kind, scores in tables[0].items():
        best[kind] = {}
        for name in scores:
            if not name.endswith("_std"):
                choose = min if name in LOWER_IS_BETTER else max
                best[kind][name] = choose(table[kind][name] for table in tables)
    return best


def format_set(name: str, result: dict[str, Any]) -> str:
    """Text table of one set with one row per system; a cell holds unif / near."""
    heads = "".join(column.rjust(18) for column in COLUMNS)
    lines = [f"{name} ({result['rays']} rays); unif / near", " " * 28 + heads + "   train [s]"]
    for system, scores in result["table"].items():
        cells = "".join(
            f"{scores['unif'][column]:.3f} / {scores['near'][column]:.3f}".rjust(18)
            for column in COLUMNS
        )
        seconds = result["runs"].get(system, {}).get("seconds")
        took = f"{statistics.median(seconds):12.2f}" if seconds else ""
        lines.append(system.ljust(28) + cells + took)
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
        lines.append(f"largest standard deviation over the runs: {spread:.4f}")
    return "\n".join(lines)


def markdown(sets: dict[str, dict[str, Any]]) -> str:
    """Table of balanced accuracy and log-loss (unif / near) with one row per set, and the mean."""
    tables = [result["table"] for result in sets.values()]
    systems = [name for name in tables[0] if name == BEST or not name.startswith("OctoMap")]

    def cell(scores: list[Scores]) -> str:
        pairs = [
            " / ".join(
                f"{statistics.fmean(s[kind][column] for s in scores):.3f}".removeprefix("0")  # .985
                for kind in ("unif", "near")
            )
            for column in ("balanced_accuracy", "log_loss")
        ]
        return ", ".join(pairs)

    rows = {name: [cell([result["table"][s]]) for s in systems] for name, result in sets.items()}
    rows["mean"] = [cell([table[s] for table in tables]) for s in systems]
    lines = [f"| set | {' | '.join(systems)} |", "|---" * (len(systems) + 1) + "|"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(row)} |" for name, row in rows.items())])


def find_sets(folder: Path, names: list[str] | None) -> dict[str, Path]:
    """The 3-D sets of a data folder: each is a folder that contains scans.npz."""
    found = {path.parent.name: path for path in sorted(folder.glob("*/scans.npz"))}
    if names is None:
        return {name: path for name, path in found.items() if name not in NOT_BY_DEFAULT}
    missing = [name for name in names if name not in found]
    if missing:
        sys.exit(f"--sets must be folders with scans.npz in {folder}; missing: {missing}")
    return {name: found[name] for name in names}


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", help="names of folders (default: all 3-D sets)")
    parser.add_argument(
        "--rays", type=int, default=120_000, help="most rays of a set (default: 120000)"
    )
    parser.add_argument(
        "--ratio", type=float, default=0.5, help="fraction of training rays (default: 0.5)"
    )
    parser.add_argument(
        "--whole-scans", action="store_true", help="hold out whole scans instead of rays"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--systems", nargs="+", default=["map", "octomap"])
    parser.add_argument("--tune", action="store_true", help="also measure fine-tuned maps")
    parser.add_argument(
        "--hit-noise", action="store_true", help="also measure maps with --hit-noise auto"
    )
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "accuracy.json")
    return parser.parse_args()


@torch.no_grad()
def main() -> None:
    arguments = parse_arguments()
    names = [*arguments.systems, *(["tuned"] if arguments.tune else [])]
    resolutions = WHOLE_SCAN_RESOLUTIONS if arguments.whole_scans else RESOLUTIONS
    systems = choose_systems(names, resolutions, arguments.hit_noise)
    sets = find_sets(arguments.data, arguments.sets)
    if not sets or not systems:
        sys.exit(f"nothing to measure: sets {list(sets)} in {arguments.data}, systems {names}")
    record: dict[str, Any] = {"conditions": conditions(), "sets": {}}
    record["protocol"] = {
        key: getattr(arguments, key) for key in ("rays", "ratio", "seeds", "whole_scans")
    }
    print(describe(record["conditions"]), end="\n\n")
    for name, path in tqdm(sets.items(), disable=None):
        scans = load_scans(path)
        if arguments.whole_scans and scans.num_scans < 2:
            tqdm.write(f"{name}: one scan, none can be held out\n")
            continue
        record["sets"][name] = run_set(scans, systems, arguments)
        tqdm.write(format_set(name, record["sets"][name]) + "\n")
        sys.stdout.flush()
    print(markdown(record["sets"]))
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
