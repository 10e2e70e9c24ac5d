"""What the map says where it was taught nothing, beside what it says where it was.

For each set a map with the defaults is fitted to half of the rays. Printed, one row a set:
balanced accuracy and log-loss (unif and near) and calibration error on held-out rays; ``behind``,
the share of places 0.2 m behind held-out hits, in no cell of 0.05 m that any ray of the set
crossed, that are called free; ``unseen``, the shares of points in cells of 0.25 m (0.5 m in large
scenes) that no ray of the set came near which are called occupied and free; ``jump``, the largest
step of the probability along random lines of 1 m, also of maps with k = 5; ``scans``, accuracy
and log-loss on whole scans held out; and the time of `fit`. Called means log-odds beyond 1.

    python benchmarks/unseen.py --data ../shared/data --sets tdtk_dat --rays 40000 --seeds 11
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from conditions import ROOT, conditions, describe, write_json
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans, load_scans, sample_rays, split_rays
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

CALLED = 1.0  # log-odds
BEHIND = 0.2  # [m] behind a hit
CELL = 0.05  # [m] of the cells that rays cross
UNSEEN_POINTS = 40_000
LINE_STEPS = 10_000  # of 0.1 mm: the slope of a real surface is no jump
RAYS_AT_A_TIME = 1 << 14


class Crossed(NamedTuple):
    """Cells that rays cross: sorted keys (C,), edge [m]."""

    keys: Tensor
    edge: float

    def holds(self, points: Tensor) -> Tensor:
        """(N, D) positions [m] -> (N,) whether a ray crossed their cell."""
        keys = cell_keys(points, self.edge)
        place = torch.searchsorted(self.keys, keys).clamp(max=len(self.keys) - 1)
        return self.keys[place] == keys


def cell_keys(points: Tensor, edge: float) -> Tensor:
    """(..., D) positions [m] -> (...) one whole number for each cell."""
    cells = (points / edge).floor().long()
    strides = (1 << 20) ** torch.arange(points.shape[-1])
    return (cells * strides).sum(dim=-1)


def crossed_cells(scans: Scans, edge: float) -> Crossed:
    """The cells that the rays cross, by steps of half an edge."""
    found = []
    for ids in torch.arange(len(scans)).split(RAYS_AT_A_TIME):
        origins, ends = scans.ray_origins[ids], scans.ends[ids]
        longest = float((ends - origins).norm(dim=1).max())
        keys = [
            cell_keys(torch.lerp(origins, ends, float(share)), edge).unique()
            for share in torch.linspace(0, 1, int(2 * longest / edge) + 2, dtype=torch.float64)
        ]
        found.append(torch.cat(keys).unique())
    return Crossed(torch.cat(found).unique(), edge)


def places_behind(rays: Scans, seed: int) -> Tensor:
    """(N, D) places behind held-out hits that no ray of ``rays`` has crossed [m]."""
    test = split_rays(rays, 0.5, seed)[1]
    offsets = test.ends - test.ray_origins
    behind = test.ends + BEHIND * offsets / offsets.norm(dim=1, keepdim=True)
    return behind[~crossed_cells(rays, CELL).holds(behind)]


def places_unseen(scans: Scans, seed: int) -> Tensor:
    """(N, D) places in the box of the hits and 2 m around it whose cell no ray came near [m]."""
    ranges = scans.ranges
    scans = scans.select((ranges > 0.3) & (ranges < 60))
    hits = scans.ends[scans.is_return].numpy()
    low, high = (torch.from_numpy(np.percentile(hits, q, axis=0)) for q in (1, 99))
    low, high = low - 2, high + 2
    crossed = crossed_cells(scans, 0.5 if float((high - low).max()) > 64 else 0.25)
    rng = torch.Generator().manual_seed(seed)
    shape = (8 * UNSEEN_POINTS, scans.dim)
    points = low + torch.rand(shape, generator=rng, dtype=torch.float64) * (high - low)
    near = torch.zeros(len(points), dtype=torch.bool)
    for step in torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * scans.dim):
        near |= crossed.holds(points + step * crossed.edge)
    return points[~near][:UNSEEN_POINTS]


def known_places(path: Path, scans: Scans, arguments: argparse.Namespace, seed: int) -> Any:
    """Places behind and unseen, which take long to find and depend on the set alone: kept."""
    kept = arguments.cache / f"{path.parent.name}-{arguments.rays}-{seed}.pt"
    if kept.exists():
        return torch.load(kept)
    rays = protocol_rays(scans, arguments.rays, seed)
    found = (places_behind(rays, seed), places_unseen(scans, seed))
    kept.parent.mkdir(parents=True, exist_ok=True)
    torch.save(found, kept)
    return found


def largest_jump(model: LardHilbertMap, hits: Tensor, lines: int, seed: int) -> float:
    """Largest step of the probability along random lines of 1 m through the box of the hits."""
    rng = torch.Generator().manual_seed(seed)
    starts = hits[torch.randint(len(hits), (lines,), generator=rng)]
    along = torch.randn(starts.shape, generator=rng, dtype=torch.float64)
    along /= along.norm(dim=1, keepdim=True)
    starts = starts - torch.rand((lines, 1), generator=rng, dtype=torch.float64) * along
    steps = torch.linspace(0, 1, LINE_STEPS + 1, dtype=torch.float64)[:, None]
    largest = 0.0
    for start, way in zip(starts, along, strict=True):
        largest = max(largest, float(model(start + steps * way).diff().abs().max()))
    return largest


def drop_flat_axis(scans: Scans) -> Scans:
    """Two-dimensional where all points have the same z."""
    if scans.dim == 2 or bool((scans.ends[:, 2] != scans.ends[0, 2]).any()):
        return scans
    return Scans(
        origins=scans.origins[:, :2].clone(),
        ends=scans.ends[:, :2].clone(),
        scan_id=scans.scan_id,
        is_return=scans.is_return,
        target_index=scans.target_index,
    )


def fitted(train: Scans, seed: int, **settings: Any) -> tuple[LardHilbertMap, float]:
    """A map with its defaults, and the seconds that sampling and `fit` took."""
    start = time.perf_counter()
    samples = sample_rays(train, seed=seed)
    model = LardHilbertMap(dim=train.dim, **settings)
    with torch.enable_grad():
        model.fit(samples.points, samples.labels, seed=seed)
    return model, time.perf_counter() - start


def point_scores(model: LardHilbertMap, test: Scans, seed: int, name: str) -> dict[str, float]:
    """Balanced accuracy, log-loss and calibration error of both kinds of free points."""
    table = evaluate(model, test, seed)
    row = {}
    for kind in ("unif", "near"):
        row[f"{name}{kind}"] = table[kind]["balanced_accuracy"]
        row[f"{name}{kind}_loss"] = table[kind]["log_loss"]
        row[f"{name}{kind}_ece"] = table[kind]["ece"]
    return row


def whole_scans(rays: Scans, seed: int) -> dict[str, float]:
    """Scores on scans held out whole: the odd ones; of fewer than four scans each in turn."""
    ids = rays.scan_id.unique()
    if len(ids) < 2:
        return {}
    odd = torch.zeros(int(ids.max()) + 1, dtype=torch.bool)
    odd[ids[1::2]] = True
    turns = [rays.scan_id == i for i in ids] if len(ids) < 4 else [odd[rays.scan_id]]
    rows = []
    for held_out in turns:
        model, _ = fitted(rays.select(~held_out), seed)
        rows.append(point_scores(model, rays.select(held_out), seed, "scans_"))
    return {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}


def measure(path: Path, arguments: argparse.Namespace, seed: int) -> dict[str, float]:
    """All figures of one set."""
    scans = drop_flat_axis(load_scans(path))
    behind, unseen = known_places(path, scans, arguments, seed)
    rays = protocol_rays(scans, arguments.rays, seed)
    train, test = split_rays(rays, 0.5, seed)
    model, seconds = fitted(train, seed)
    row = {"clusters": len(model), "fit_s": seconds, **point_scores(model, test, seed, "")}
    if len(behind):
        row["behind"] = float((model.log_odds(behind) < -CALLED).double().mean())
    if len(unseen):
        log_odds = model.log_odds(unseen)
        row["unseen_occ"] = float((log_odds > CALLED).double().mean())
        row["unseen_free"] = float((log_odds < -CALLED).double().mean())
    if arguments.lines:
        row["jump"] = largest_jump(model, train.ends, arguments.lines, seed)
        few = fitted(train, seed, num_neighbors=5)[0]
        row["jump_k5"] = largest_jump(few, train.ends, arguments.lines, seed)
    if arguments.scans:
        row |= whole_scans(rays, seed)
    return row


def format_row(name: str, row: dict[str, float]) -> str:
    """One line of the table."""
    nan = float("nan")
    cells = [f"{name:22.22s}"]
    for title, keys in {
        "": ("unif", "unif_loss", "near", "near_loss", "unif_ece"),
        "behind": ("behind",),
        "unseen": ("unseen_occ", "unseen_free"),
        "jump": ("jump", "jump_k5"),
        "scans": ("scans_unif", "scans_unif_loss", "scans_near"),
    }.items():
        cells.append(f"{title} " + " ".join(f"{row.get(key, nan):.4f}" for key in keys))
    return " | ".join([*cells, f"{row['fit_s']:.2f} s, {row['clusters']:.0f}"])


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", required=True, help="names of folders")
    parser.add_argument("--rays", type=int, default=120_000, help="at most so many of a set")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--lines", type=int, default=0, help="random lines for the jumps")
    parser.add_argument("--scans", action="store_true", help="hold whole scans out, too")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "unseen")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "unseen.json")
    return parser.parse_args()


@torch.no_grad()
def main() -> None:
    arguments = parse_arguments()
    record: dict[str, Any] = {"conditions": conditions(), "sets": {}}
    print(describe(record["conditions"]), end="\n\n")
    means = []
    for name in arguments.sets:
        path = arguments.data / name / "scans.npz"
        runs = [measure(path, arguments, seed) for seed in arguments.seeds]
        record["sets"][name] = runs
        means.append({key: statistics.fmean(run[key] for run in runs) for key in runs[0]})
        print(format_row(name, means[-1]), flush=True)
    shared = [key for key in means[0] if all(key in row for row in means)]
    mean = {key: statistics.fmean(row[key] for row in means) for key in shared}
    print(format_row("mean", mean))
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
