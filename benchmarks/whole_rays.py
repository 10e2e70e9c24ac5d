"""Whole rays: where a map ends the rays it was trained on, and rays that it has not seen.

For each set, half of at most ``--rays`` rays train. Of ``--count`` held-out and of as many training
rays: early, the fraction that `raycast` ends more than 0.5 m before the hit; phantom, those of them
that end where no hit of the set lies within 0.2 m; late, the fraction that it ends more than 0.5 m
beyond the hit, or never. Beside them the scores of accuracy.py and the processor time of sampling and
`fit`. With ``--clear-rays``, `fit` is given the rays and reshapes clusters that end them early.

    python benchmarks/whole_rays.py --data ../shared/data --sets paper_virtual --seeds 0 1 2
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from accuracy import find_sets
from conditions import ROOT, conditions, describe, write_json
from scipy.spatial import cKDTree

from lardhm_torch import LardHilbertMap, Scans, load_scans, raycast, sample_rays, split_rays
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

TOLERANCE = 0.5  # [m] a ray may end so far before or beyond its hit
GRAZED = 0.2  # [m] from a hit: a ray that ends there early met a real surface
COLUMNS = (
    "early", "phantom", "late", "train_early", "train_phantom", "train_late",
    "unif", "near", "unif_loss", "near_loss", "seconds",
)  # fmt: skip


def ray_errors(model: LardHilbertMap, rays: Scans, hits: cKDTree) -> dict[str, float]:
    """Fractions of the rays that the map ends early, at phantoms, and late."""
    directions, ranges = rays.ends - rays.ray_origins, rays.ranges
    found = raycast(model, rays.ray_origins, directions, float(ranges.max()) + 5)
    early = found < ranges - TOLERANCE
    ends = rays.ray_origins + (found / ranges)[:, None] * directions
    apart = hits.query(ends[early])[0] if early.any() else ends.new_zeros(0).numpy()
    return {
        "early": float(early.double().mean()),
        "phantom": float((apart > GRAZED).sum()) / len(rays),
        "late": float((found > ranges + TOLERANCE).double().mean()),
    }


def run_seed(
    scans: Scans, seed: int, max_rays: int, count: int, clear_rays: bool
) -> dict[str, float]:
    """All figures of one set and seed."""
    rays = protocol_rays(scans, max_rays, seed)
    train, test = split_rays(rays, 0.5, seed)
    before = time.process_time()
    samples = sample_rays(train, seed=seed)
    model = LardHilbertMap(dim=scans.dim)
    model.fit(samples.points, samples.labels, seed=seed, rays=train if clear_rays else None)
    seconds = time.process_time() - before
    model.requires_grad_(False)
    hits = cKDTree(rays.ends.numpy())
    few = [
        part.select(torch.arange(0, len(part), max(1, len(part) // count)))
        for part in (test, train)
    ]
    row = ray_errors(model, few[0], hits)
    row |= {f"train_{name}": value for name, value in ray_errors(model, few[1], hits).items()}
    scores = evaluate(model, test, seed)
    for kind in ("unif", "near"):
        row[kind] = scores[kind]["balanced_accuracy"]
        row[f"{kind}_loss"] = scores[kind]["log_loss"]
    return row | {"clusters": len(model), "seconds": seconds}


def format_row(name: str, row: dict[str, float]) -> str:
    """One line of the table."""
    return name.ljust(24) + "".join(f"{row[column]:.4f}".rjust(13) for column in COLUMNS)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", help="names of folders; default: all 3-D sets")
    parser.add_argument("--rays", type=int, default=120_000, help="at most so many of a set")
    parser.add_argument("--count", type=int, default=4_000, help="rays cast of each kind")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--clear-rays", action="store_true", help="give the rays to `fit`")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "whole_rays.json")
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    report = {"conditions": conditions(), "sets": {}}
    print(describe(report["conditions"]))
    print(" " * 24 + "".join(column.rjust(13) for column in COLUMNS))
    for name, path in find_sets(arguments.data, arguments.sets).items():
        scans = load_scans(path)
        given = (arguments.rays, arguments.count, arguments.clear_rays)
        rows = [run_seed(scans, seed, *given) for seed in arguments.seeds]
        mean = {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}
        report["sets"][name] = rows
        print(format_row(name, mean), flush=True)
    write_json(arguments.json, report)


if __name__ == "__main__":
    main()
