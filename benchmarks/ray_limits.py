"""What limits early, late and phantom rays (see whole_rays.py for these terms)?

Half of at most ``--rays`` rays train a default map. The same held-out rays are ended by

- the map, with several margins of the log-odds;
- the map, but only within 0.2 m of a training hit, where no phantom is possible;
- slabs about planes through the 20 nearest hits of the whole set, without their own hit. Reach and half
  thickness are the smallest that hold 95 or 98 % of the held-out hits;
- the ranges of the nearest training rays of the same scan: the nearest, or the largest of several.

    python benchmarks/ray_limits.py --data ../shared/data --sets kitti00_mulls balm_realworld
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from accuracy import find_sets
from conditions import ROOT, conditions, describe
from scipy.spatial import cKDTree
from whole_rays import GRAZED, TOLERANCE

from lardhm_torch import LardHilbertMap, Scans, load_scans, sample_rays, split_rays
from lardhm_torch.evaluation.held_out import protocol_rays

STEP = 0.06  # [m] along the rays
MARGINS = (1.0, 1.5, 2.0, 3.0)  # of the log-odds
FRACTIONS = (0.95, 0.98)  # of held-out hits in slabs
NEIGHBORS = 20  # hits of a plane


class Rays:
    """Held-out rays, and points on them every `STEP` to 5 m beyond the hit."""

    def __init__(self, rays: Scans, hits: np.ndarray) -> None:
        self.origins, self.ends = rays.ray_origins.numpy(), rays.ends.numpy()
        self.ranges, self.scan_id = rays.ranges.numpy(), rays.scan_id.numpy()
        self.directions = (self.ends - self.origins) / self.ranges[:, None]
        self.tree = cKDTree(hits)
        counts = np.ceil((self.ranges + 5) / STEP).astype(int)
        self.rows = np.repeat(np.arange(len(counts)), counts)
        self.depths = STEP * (1 + np.concatenate([np.arange(count) for count in counts]))
        self.points = self.origins[self.rows] + self.depths[:, None] * self.directions[self.rows]

    def report(self, name: str, stops: np.ndarray) -> None:
        """One line for rays that end at these distances [m]."""
        early, late = stops < self.ranges - TOLERANCE, stops > self.ranges + TOLERANCE
        places = self.origins[early] + stops[early, None] * self.directions[early]
        phantom = (self.tree.query(places)[0] > GRAZED).sum() / len(stops) if early.any() else 0.0
        print(f"  {name:<52}{early.mean():>9.4f}{phantom:>9.4f}{late.mean():>9.4f}", flush=True)

    def first(self, is_occupied: np.ndarray) -> np.ndarray:
        """(R,) depth of the first of the points that are occupied [m]."""
        stops = np.full(len(self.ranges), np.inf)
        np.minimum.at(stops, self.rows[is_occupied], self.depths[is_occupied])
        return stops


def plane_distances(
    hits: np.ndarray, points: np.ndarray, skip: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points from a nearest hit, and from the plane of the hits about it [m].

    ``skip`` is 1 if the points are hits themselves.
    """
    tree = cKDTree(hits)
    centers, normals = np.empty_like(hits), np.empty_like(hits)
    for rows in np.array_split(np.arange(len(hits)), 1 + len(hits) // 20_000):
        around = hits[tree.query(hits[rows], NEIGHBORS)[1]]
        centers[rows] = around.mean(axis=1)
        offsets = around - centers[rows, None]
        normals[rows] = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)[1][:, :, 0]
    distances, nearest = (column[:, skip] for column in tree.query(points, [1, 2]))
    across = np.einsum("nd,nd->n", points - centers[nearest], normals[nearest])
    return distances, np.abs(across)


def report_map(rays: Rays, model: LardHilbertMap, train: Scans) -> None:
    """Lines of the map."""
    log_odds = model.log_odds(torch.from_numpy(rays.points)).numpy()
    for margin in MARGINS:
        rays.report(f"map, log-odds above {margin}", rays.first(log_odds > margin))
    possible = np.flatnonzero(log_odds > MARGINS[0])
    distances = cKDTree(train.hits.numpy()).query(rays.points[possible])[0]
    is_near = np.zeros(len(log_odds), dtype=bool)
    is_near[possible[distances < GRAZED]] = True
    rays.report("map, within 0.2 m of training hits", rays.first(is_near))


def report_slabs(rays: Rays, hits: np.ndarray) -> None:
    """Lines of slabs about planes of the hits of the whole set."""
    own, own_across = plane_distances(hits, rays.ends, skip=1)
    distances, across = plane_distances(hits, rays.points)
    for fraction in FRACTIONS:
        both = (1 + fraction) / 2  # of hits within reach, of which so many lie in the slab
        reach = np.quantile(own, both)
        half = np.quantile(own_across[own <= reach], fraction / both)
        name = f"slabs of {fraction:.0%} of hits, {reach:.2f} m wide, +- {half:.2f} m"
        rays.report(name, rays.first((distances < reach) & (across < half)))


def report_neighbors(rays: Rays, train: Scans) -> None:
    """Lines of the training rays of the same scan that have the most similar directions."""
    ranges, scan_id = train.ranges.numpy(), train.scan_id.numpy()
    directions = (train.ends - train.ray_origins).numpy() / ranges[:, None]
    near = np.full((len(rays.ranges), 4), np.inf)
    for scan in np.unique(rays.scan_id):
        own, others = np.flatnonzero(rays.scan_id == scan), np.flatnonzero(scan_id == scan)
        near[own] = ranges[others[cKDTree(directions[others]).query(rays.directions[own], 4)[1]]]
    rays.report("range of the nearest ray", near[:, 0])
    for count in (2, 4):
        rays.report(f"largest range of {count} nearest rays", near[:, :count].max(axis=1))


def main() -> None:
    """Print one table per set."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", default=["kitti00_mulls", "balm_realworld"])
    parser.add_argument("--rays", type=int, default=120_000, help="at most so many of a set")
    parser.add_argument("--count", type=int, default=4_000, help="held-out rays")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(describe(conditions()))
    for name, path in find_sets(arguments.data, arguments.sets).items():
        all_rays = protocol_rays(load_scans(path), arguments.rays, arguments.seed)
        train, test = split_rays(all_rays, 0.5, arguments.seed)
        samples = sample_rays(train, seed=arguments.seed)
        model = LardHilbertMap().fit(samples.points, samples.labels, seed=arguments.seed)
        hits = all_rays.hits.numpy()
        step = max(1, len(test) // arguments.count)
        rays = Rays(test.select(torch.arange(0, len(test), step)), hits)
        print(f"{name:<54}{'early':>9}{'phantom':>9}{'late':>9}")
        report_map(rays, model.requires_grad_(False), train)
        report_slabs(rays, hits)
        report_neighbors(rays, train)


if __name__ == "__main__":
    main()
