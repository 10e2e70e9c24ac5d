"""The extension: what the variance says, and whether a probability that knows it is better."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from contenders import rays_of
from drawing import new_figure, save
from scipy.spatial import cKDTree
from scipy.stats import spearmanr
from tqdm import tqdm

from lardhm_torch import LardHilbertMap, Samples, sample_rays, split_rays
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.learning.posterior import PRIOR_VARIANCE
from lardhm_torch.queries.grids import grid, map_bounds

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
SHARES = (0.5, 0.05)
MAX_RAYS, MAX_TEST_RAYS = 40_000, 10_000
SEED = 11  # of the split: no constant of the uncertainty was chosen on it
SLICE_HEIGHT = 1.0  # [m]
NUM_PLACES = 20_000  # where variance and distance are compared
BINS = 20
NEAR = 0.5  # [m] up to which variance still rises, and the curve is drawn


def log_losses(data: Path, folder: Path) -> dict[str, Any]:
    """Log-loss on held-out rays without and with the variance, every 3-D set, two shares."""
    result: dict[str, Any] = {}
    for name in tqdm(SETS, "uncertainty", file=sys.stderr):
        rays = rays_of(data, name, MAX_RAYS, SEED)
        for share in SHARES:
            train, test = split_rays(rays, share, SEED)
            model, _ = fit_with_doubt(sample_rays(train, seed=SEED))
            test = protocol_rays(test, MAX_TEST_RAYS, SEED)
            with torch.no_grad():
                tables = {
                    "plain": evaluate(model, test, SEED),
                    "bayes": evaluate(model.bayesian_probability, test, SEED),
                }
            result.setdefault(name, {})[str(share)] = {
                kind: {way: table[kind]["log_loss"] for way, table in tables.items()}
                for kind in ("unif", "near", "paper")
            }
    return result


def fit_with_doubt(samples: Samples) -> tuple[LardHilbertMap, Samples]:
    """A map with defaults that knows its variance."""
    model = LardHilbertMap().fit(samples.points, samples.labels)
    return model.fit_uncertainty(samples.points, samples.labels), samples


@torch.no_grad()
def variance_and_distance(data: Path, folder: Path) -> dict[str, Any]:
    """Rank correlation of variance and distance to the nearest observation, with pictures."""
    rays = rays_of(data, "paper_virtual")
    with torch.enable_grad():
        model, samples = fit_with_doubt(sample_rays(split_rays(rays, 0.5)[0]))
        contradicted = contradict(samples)
        doubting, _ = fit_with_doubt(contradicted)
    lower, upper = map_bounds(model, 1.0)
    rng = torch.Generator().manual_seed(0)
    places = lower + torch.rand(NUM_PLACES, 3, generator=rng, dtype=torch.float64) * (upper - lower)
    distance = cKDTree(samples.points).query(places)[0]
    variance = model.variance(places).numpy()
    correlation = float(spearmanr(variance, distance)[0])
    figure, axes = new_figure(16, 4.0, 3)
    near = distance < NEAR
    correlation_near = float(spearmanr(variance[near], distance[near])[0])
    edges = np.linspace(0, NEAR, BINS + 1)
    bins = np.searchsorted(edges, distance, side="right") - 1
    for quantile, style in ((0.5, "o-"), (0.1, "--"), (0.9, "--")):
        curve = [np.quantile(variance[bins == b], quantile) for b in range(BINS)]
        axes[0].plot(0.5 * (edges[1:] + edges[:-1]), curve, style, color="#0b6e4f", markersize=4)
    axes[0].set(xlabel="distance to the nearest observation [m]", ylabel="variance of the log-odds")
    axes[0].set_title(f"median, 10 % and 90 %; rank correlation {correlation_near:.2f}")
    axes[0].grid(alpha=0.3)
    level = [*lower[:2].tolist(), SLICE_HEIGHT], [*upper[:2].tolist(), SLICE_HEIGHT]
    plane = grid(*level, 0.04).squeeze(2)
    extent = (float(lower[0]), float(upper[0]), float(lower[1]), float(upper[1]))
    pictures = {
        "probability, labels of the far corner at random": (
            doubting.bayesian_probability,
            "RdBu_r",
        ),
        "variance of the same map": (doubting.variance, "plasma"),
    }
    for panel, (title, (answer, colors)) in zip(axes[1:], pictures.items(), strict=True):
        top = 1.0 if answer == doubting.bayesian_probability else PRIOR_VARIANCE
        image = panel.imshow(
            answer(plane).T, origin="lower", extent=extent, cmap=colors, vmin=0, vmax=top
        )
        panel.set_title(title, fontsize=10)
        figure.colorbar(image, ax=panel, shrink=0.8)
    save(figure, folder / "uncertainty.png")
    inside = in_corner(contradicted.points) > 0.5
    nowhere = places[distance > np.quantile(distance, 0.95)]
    rows = {
        "observed, consistent": contradicted.points[~inside][::50],
        "observed, contradictory": contradicted.points[inside][::10],
        "never observed": nowhere,
    }
    return {
        "correlation": correlation,
        "correlation_near": correlation_near,
        "kinds": {
            name: {
                "undecided": float(
                    (doubting.bayesian_probability(p) - 0.5).abs().lt(0.3).float().mean()
                ),
                "variance": float(doubting.variance(p).median()),
            }
            for name, p in rows.items()
        },
    }


def in_corner(points: torch.Tensor) -> torch.Tensor:
    """(N,) 1 in the quarter of largest x and y, else 0."""
    middle = points[:, :2].quantile(0.6, dim=0)
    return (points[:, :2] > middle).all(dim=1).float()


def contradict(samples: Samples) -> Samples:
    """The same points, the labels of one quarter replaced by coin flips."""
    rng = torch.Generator().manual_seed(0)
    coin = (torch.rand(len(samples), generator=rng) < 0.5).to(samples.labels)
    labels = torch.where(in_corner(samples.points) > 0.5, coin, samples.labels)
    return Samples(samples.points, labels, samples.ray_id, samples.dropped)
