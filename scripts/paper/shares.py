"""Accuracy against the share of rays that trains (Fig. 3, Table III) and against clusters (Fig. 6)."""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from typing import Any

from contenders import BASELINES, OURS, accuracy, build, choose_settings, describe, rays_of
from drawing import draw_curves, new_figure, save
from tqdm import tqdm

from lardhm_torch import LardHilbertMap, sample_rays, split_rays

SHARES = (0.99, 0.7, 0.5, 0.4, 0.2, 0.1, 0.05)
SEEDS = {0.99: 20}  # few rays are left to test
OTHER_SEEDS = 4
SLOW_SEEDS = 5  # of Local GP at most
CHOSEN_AT = (0.5, 0.05)  # shares at which settings are chosen; others take the nearest
PAPER_FIG3 = {  # read off the paper's text, Section IV-A
    "LARD-HM": ((0.99, 0.05), (1.0, 0.78)),
    "Original HM": ((0.99, 0.05), (0.97, 0.62)),
    "OctoMap": ((0.99, 0.05), (0.89, 0.55)),
    "Local GP": ((0.99, 0.05), (0.82, 0.66)),
}
TABLE_THREE_SETS = ("riegl_vz400i_rtls", "sevenscenes_semidense")
TABLE_THREE_RAYS, TABLE_THREE_SEEDS = 40_000, 2
FIG6_RAYS = 40_000
FIG6_SHARES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.9)
FIG6_CLUSTERS = (50, 100, 250, 500, 1000, 1500, 2500, 4000, 6000)


def figure_three(data: Path, folder: Path) -> dict[str, Any]:
    """Accuracy of four methods on paper_virtual at every share, mean and spread over seeds."""
    rays = rays_of(data, "paper_virtual")
    settings = {at: choose_settings(split_rays(rays, at, seed=0)[0]) for at in CHOSEN_AT}
    table: dict[str, Any] = {}
    jobs = [(share, seed) for share in SHARES for seed in range(SEEDS.get(share, OTHER_SEEDS))]
    for share, seed in tqdm(jobs, "Fig. 3", file=sys.stderr):
        at = CHOSEN_AT[0] if share >= 0.2 else CHOSEN_AT[1]
        _one_split(rays, share, seed, settings[at], table.setdefault(str(share), {}))
    result = {share: summarize(scores) for share, scores in table.items()}
    draw_figure_three(result, folder)
    chosen = {str(at): describe(found) for at, found in settings.items()}
    return {"settings": chosen, "accuracy": result}


def draw_figure_three(result: dict[str, Any], folder: Path) -> None:
    """All methods with the paper's figures, then closer looks at the best by both tests."""
    figure, axes = new_figure(16, 4.4, 3)
    panels = (
        ("paper", PAPER_FIG3, (0.5, 1.005), "the paper's own test"),
        ("paper", None, (0.93, 0.98), "the same, closer (OctoMap is below)"),
        ("unif", None, (0.96, 1.0), "free points at least 0.2 m before the hit"),
    )
    for panel, (kind, dashed, limits, title) in zip(axes, panels, strict=True):
        curves = {
            name: [result[str(share)][name][kind]["mean"] for share in SHARES]
            for name in (*OURS, *BASELINES)
            if dashed or name != "OctoMap"
        }
        draw_curves(panel, SHARES, curves, dashed)
        panel.set(xlabel="share of rays that trains", ylabel="accuracy", title=title, ylim=limits)
    save(figure, folder / "figure_3.png")


def _one_split(
    rays: Any, share: float, seed: int, settings: dict[str, Any], scores: dict[str, Any]
) -> None:
    train, test = split_rays(rays, share, seed)
    samples = sample_rays(train, seed=seed)
    for name in (*OURS, *BASELINES):
        if name == "Local GP" and seed >= SLOW_SEEDS:
            continue
        model = build(name, settings.get(name, ()), train, samples, seed)
        for kind, value in accuracy(model, test, seed).items():
            scores.setdefault(name, {}).setdefault(kind, []).append(value)


def summarize(scores: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """Mean, standard deviation and number of the seeds' values."""
    return {
        name: {
            kind: {
                "mean": statistics.fmean(values),
                "std": statistics.stdev(values) if len(values) > 1 else 0.0,
                "values": values,
            }
            for kind, values in kinds.items()
        }
        for name, kinds in scores.items()
    }


def table_three(data: Path, folder: Path) -> dict[str, Any]:
    """Accuracy on the real sets with half of the rays training."""
    result = {}
    for name in TABLE_THREE_SETS:
        scores: dict[str, Any] = {}
        settings = None
        for seed in tqdm(range(TABLE_THREE_SEEDS), f"Table III, {name}", file=sys.stderr):
            rays = rays_of(data, name, TABLE_THREE_RAYS, seed)
            settings = settings or choose_settings(split_rays(rays, 0.5, seed=0)[0])
            _one_split(rays, 0.5, seed, settings, scores)
        result[name] = {"settings": describe(settings or {}), "accuracy": summarize(scores)}
    return result


def figure_six(data: Path, folder: Path) -> dict[str, Any]:
    """LARD-HM on the real sets: accuracy against share (default m) and against m (80 % train)."""
    result: dict[str, Any] = {"shares": {}, "clusters": {}, "made": {}}
    for name in tqdm(TABLE_THREE_SETS, "Fig. 6", file=sys.stderr):
        rays = rays_of(data, name, FIG6_RAYS)
        result["shares"][name] = []
        for share in FIG6_SHARES:
            train, test = split_rays(rays, share)
            samples = sample_rays(train)
            model = LardHilbertMap().fit(samples.points, samples.labels)
            result["shares"][name].append(accuracy(model, test)["paper"])
        train, test = split_rays(rays, 0.8)
        samples = sample_rays(train)
        result["clusters"][name], result["made"][name] = [], []
        for count in FIG6_CLUSTERS:
            model = LardHilbertMap().fit(samples.points, samples.labels, num_clusters=count)
            result["clusters"][name].append(accuracy(model, test)["paper"])
            result["made"][name].append(len(model))
    figure, axes = new_figure(11, 4.2, 2)
    draw_curves(axes[0], FIG6_SHARES, result["shares"])
    axes[0].set(xlabel="share of rays that trains", ylabel="accuracy (paper's test)")
    draw_curves(axes[1], FIG6_CLUSTERS, result["clusters"])
    axes[1].set(xlabel="clusters asked for", xscale="log", ylabel="accuracy (paper's test)")
    save(figure, folder / "figure_6.png")
    return result
