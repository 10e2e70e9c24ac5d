"""Ray casting: range errors on held-out rays, and time.

Usage: python benchmarks/raycasting.py [--data DATA] [--only error speed]

error: half of at most 120,000 rays of each set train the map (default settings, seed 0), the ranges of
the others are asked for. speed: 10^6 rays against the map of a street, beside OctoMap's castRay, which
answers one ray a call; its loop is timed on 10,000 of the rays, for several voxel sizes. Large voxels are
fast and blunt, so the median error stands beside: of 10,000 held-out rays in their true directions, those
that met anything (OctoMap's range goes to the center of the voxel it met).
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from conditions import conditions, describe
from torch import Tensor

from lardhm_torch import LardHilbertMap, load_scans, raycast, sample_rays, split_rays
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import protocol_rays
from lardhm_torch.queries.collision import expected_range

SETS = (
    "paper_virtual",
    "la3dm_sim_structured",
    "riegl_vz400i_rtls",
    "tdtk_dat",
    "balm_realworld",
    "kitti00_mulls",
    "sevenscenes_rgbd",
    "sevenscenes_semidense",
)
STREET = "kitti00_mulls"
MAX_RANGE = 80.0  # [m]
VOXELS = (0.05, 0.1, 0.2, 0.4)  # [m]
COUNT = 10_000  # rays of the loop over OctoMap


def fitted(data: Path, name: str):
    """A map fitted to half of the rays, and both halves."""
    rays = protocol_rays(load_scans(data / name / "scans.npz"), 120_000)
    train, test = split_rays(rays, 0.5, 0)
    samples = sample_rays(train)
    return LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False), train, test


def errors(data: Path) -> None:
    """Median error [m] and fraction of rays that hit, for all sets."""
    print(f"{'set':<24}{'ridge':>8}{'met':>7}{'crossing':>10}{'expected':>10}   median error [m]")
    for name in SETS:
        model, _, test = fitted(data, name)
        ways = test.ends - test.ray_origins
        ridge, crossing = (
            raycast(model, test.ray_origins, ways, MAX_RANGE, surface=s)
            for s in ("peak", "crossing")
        )
        few = torch.arange(0, len(test), len(test) // 300)
        mean = expected_range(model, test.ray_origins[few], ways[few], float(test.ranges.max()) + 1)
        off = [(r - test.ranges).abs().median() for r in (ridge, crossing)]
        off.append((mean - test.ranges[few]).abs().median())
        met = float(ridge.isfinite().double().mean())
        print(f"{name:<24}{off[0]:>8.3f}{met:>7.3f}{off[1]:>10.3f}{off[2]:>10.3f}", flush=True)


def speed(data: Path) -> None:
    """Time of 10^6 rays and of a loop over OctoMap, with both errors on held-out rays."""
    model, train, test = fitted(data, STREET)
    rng = torch.Generator().manual_seed(0)
    pick = torch.randint(len(test), (1_000_000,), generator=rng)
    origins, ways = test.ray_origins[pick], (test.ends - test.ray_origins)[pick]
    ways = ways + 0.01 * ways.norm(dim=1, keepdim=True) * torch.randn(ways.shape, generator=rng)
    held_out = test.select(torch.randperm(len(test), generator=rng)[:COUNT])
    truth = held_out.ray_origins, held_out.ends - held_out.ray_origins
    raycast(model, origins[:1000], ways[:1000], MAX_RANGE)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        ranges = raycast(model, origins, ways, MAX_RANGE)
        seconds.append(time.perf_counter() - start)
    ours = float(np.median(seconds))
    off = median_error(raycast(model, *truth, MAX_RANGE), held_out.ranges)
    print(f"{'speed':<24}{'10^6 rays':>11}{'x ours':>8}{'met':>7}   median error of held-out rays")
    print_speed("lardhm_torch", ours, ours, ranges, off)
    for voxel in VOXELS:
        baseline = OctoMapBaseline(voxel).fit(train)
        start = time.perf_counter()
        ranges = octomap_ranges(baseline, origins[:COUNT], ways[:COUNT])
        theirs = (time.perf_counter() - start) * len(origins) / COUNT
        off = median_error(octomap_ranges(baseline, *truth), held_out.ranges)
        print_speed(f"OctoMap castRay {voxel} m", theirs, ours, ranges, off)


def octomap_ranges(baseline: OctoMapBaseline, origins: Tensor, ways: Tensor) -> Tensor:
    """(R,) ranges [m] to the centers of the voxels that rays meet, infinity where they meet none."""
    starts = (origins - baseline.origin).numpy()
    headings = (ways / ways.norm(dim=1, keepdim=True)).numpy()
    ends, met = np.zeros((len(starts), 3)), np.zeros(len(starts), dtype=bool)
    for ray, (start, heading) in enumerate(zip(starts, headings, strict=True)):
        met[ray] = baseline.tree.castRay(start, heading, ends[ray], True, MAX_RANGE)
    ranges = np.linalg.norm(ends - starts, axis=1)
    return torch.from_numpy(np.where(met, ranges, np.inf))


def median_error(ranges: Tensor, truth: Tensor) -> float:
    """Median error of the rays that hit [m]."""
    met = ranges.isfinite()
    return float((ranges - truth)[met].abs().median())


def print_speed(name: str, seconds: float, ours: float, ranges: Tensor, off: float) -> None:
    """One line of the table."""
    met = float(ranges.isfinite().double().mean())
    print(
        f"{name:<24}{seconds:>9.2f} s{seconds / ours:>8.1f}{met:>7.3f}{off:>8.3f} m",
        flush=True,
    )


def main() -> None:
    """Run both parts."""
    parser = argparse.ArgumentParser(description="Ranges of held-out rays, and their speed.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--only", nargs="+", choices=("error", "speed"), default=("error", "speed"))
    arguments = parser.parse_args()
    print(describe(conditions()))
    if "error" in arguments.only:
        errors(arguments.data)
    if "speed" in arguments.only:
        speed(arguments.data)


if __name__ == "__main__":
    main()
