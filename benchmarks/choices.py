"""Ablation study: the effect of each default, one change at a time, on every set.

The protocol is that of accuracy.py, with fewer rays so that all choices take minutes. Rows of the
table are choices, columns are sets; a cell is balanced accuracy unif / near in percent.

    python benchmarks/choices.py --data ../shared/data --markdown docs/choices.md
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from accuracy import Model, Scores, find_sets
from conditions import ROOT, conditions, describe, write_json
from torch import Tensor
from tqdm import tqdm

from lardhm_torch import (
    FitConfig,
    LardHilbertMap,
    SamplingConfig,
    Scans,
    TuneConfig,
    fine_tune,
    load_scans,
    native,
    sample_rays,
    split_rays,
)
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.learning.fitting import fit_weights

Kernel = Callable[[Tensor], Tensor]  # distance in length scales -> closeness

HEAD = """# Ablation study

Balanced accuracy unif / near in percent, and log-loss unif / near. Each row changes one default. At most
{rays:,} rays of a set, half of them for training, seed {seed}. The defaults were chosen on these sets.
Produced by `benchmarks/choices.py`.

"""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Settings that differ from the defaults."""

    sampling: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)
    fit: dict[str, Any] = field(default_factory=dict)
    tune: dict[str, Any] | None = field(default_factory=dict)  # None: not tuned
    hits_per_cluster: int | None = None  # None: chosen from the data
    resample: bool = True
    kernel: Kernel | None = None  # weights alone, on the fitted clusters


def matern_three_halves(d: Tensor) -> Tensor:
    return (1 + 3**0.5 * d) * torch.exp(-(3**0.5) * d)


def wendland(d: Tensor) -> Tensor:
    """Compactly supported, twice differentiable; 0 beyond 3.5 length scales."""
    r = (d / 3.5).clamp(max=1)
    return (1 - r) ** 4 * (4 * r + 1)


PAPERS_SGD = {
    "passes": 1,
    "learning_rate": 0.1,
    "decay": False,
    "preconditioner": False,
    "batch_size": 1,
    "l2": 0.0,
}
CHOICES = {
    "**default, fine-tuned**": Choice(),
    "k = 8": Choice(model={"num_neighbors": 8}),
    "k = 24": Choice(model={"num_neighbors": 24}),
    "covariance scale 2.5": Choice(model={"covariance_scale": 2.5}),
    "covariance scale 8": Choice(model={"covariance_scale": 8.0}),
    "one cluster per 10 hits": Choice(hits_per_cluster=10),
    "one cluster per 15 hits": Choice(hits_per_cluster=15),
    "one cluster per 30 hits": Choice(hits_per_cluster=30),
    "no near samples": Choice(sampling={"near_samples": 0}),
    "1 near sample": Choice(sampling={"near_samples": 1}),
    "3 free samples per ray": Choice(sampling={"free_samples": 3}),
    "near margin 0.2 m": Choice(sampling={"near_margin": 0.2}),
    "near margin 0.05 m": Choice(sampling={"near_margin": 0.05}),
    "equal class weights": Choice(fit={"occupied_share": 0.5}, tune={"occupied_share": 0.5}),
    "same samples every epoch": Choice(resample=False),
    "fine-tuned with l2 = 0.05": Choice(tune={"l2": 0.05}),
    "no stiffness": Choice(tune={"stiffness": 0.0}),
    "8 epochs": Choice(tune={"epochs": 8}),
    "best epoch on 10 % of the rays": Choice(tune={"hold_out": 0.1}),
    "length scales frozen": Choice(tune={"tune_scales": False}),
    "centers frozen": Choice(tune={"tune_centers": False}),
    "**default, not fine-tuned**": Choice(tune=None),
    "k = 8, not fine-tuned": Choice(model={"num_neighbors": 8}, tune=None),
    "the paper's SGD": Choice(fit=PAPERS_SGD, tune=None),
    "Matern 1/2, not fine-tuned": Choice(tune=None, kernel=lambda d: torch.exp(-d)),
    "Matern 3/2, not fine-tuned": Choice(tune=None, kernel=matern_three_halves),
    "Wendland, not fine-tuned": Choice(tune=None, kernel=wendland),
}


def build(train: Scans, choice: Choice, seed: int) -> Model:
    """Fit a map to the training rays with these settings."""
    sampling = SamplingConfig(**choice.sampling)
    samples = sample_rays(train, sampling, seed=seed)
    model = LardHilbertMap(dim=train.dim, **choice.model)
    hits = int((samples.labels == 1).sum())
    num_clusters = 2 * hits // choice.hits_per_cluster if choice.hits_per_cluster else None
    config = FitConfig(**choice.fit)
    model.fit(samples.points, samples.labels, num_clusters, seed=seed, config=config)
    if choice.kernel is not None:
        return _with_kernel(model, samples.points, samples.labels, choice.kernel)
    if choice.tune is not None:
        with torch.enable_grad():
            fine_tune(
                model,
                samples.points,
                samples.labels,
                ray_id=samples.ray_id,
                resample=(lambda epoch: sample_rays(train, sampling, seed=seed + epoch))
                if choice.resample
                else None,
                config=TuneConfig(**choice.tune),
                seed=seed,
            )
    return model


def _with_kernel(model: LardHilbertMap, points: Tensor, labels: Tensor, kernel: Kernel) -> Model:
    """Fit the weights of the same clusters with another kernel."""

    def features_at(positions: Tensor) -> tuple[Tensor, Tensor]:
        local = model._to_map_frame(positions)
        given = (local, model.centers, model.raw_scale_tril, model.kernel, model._fresh_index())
        indices, gauss = native.nearest_features(*given)
        distance = (-2 * gauss.clamp(min=1e-37).log()).clamp(min=0).sqrt()
        return indices, kernel(distance)

    weights = fit_weights(
        lambda rows: features_at(points[rows]),
        labels.float(),
        torch.zeros(len(model)),
        FitConfig(),
        torch.Generator().manual_seed(0),
    )

    def probability(positions: Tensor) -> Tensor:
        indices, values = features_at(positions)
        return torch.sigmoid((values * weights[indices.long()]).sum(dim=1))

    return probability


def markdown(results: dict[str, dict[str, Scores]], names: list[str]) -> str:
    """Table with one row per choice; the first columns are means over the sets."""
    lines = [
        "| choice | mean | mean log-loss | " + " | ".join(names) + " |",
        "|---" * (len(names) + 3) + "|",
    ]
    for choice, of_set in results.items():
        pairs = {
            column: [[of_set[name][kind][column] for name in names] for kind in ("unif", "near")]
            for column in ("balanced_accuracy", "log_loss")
        }
        cells = [
            f"{100 * u:.2f} / {100 * n:.2f}"
            for u, n in zip(*pairs["balanced_accuracy"], strict=True)
        ]
        unif, near = (sum(row) / len(names) for row in pairs["balanced_accuracy"])
        loss = " / ".join(f"{sum(row) / len(names):.4f}" for row in pairs["log_loss"])
        lines.append(
            f"| {choice} | {100 * unif:.2f} / {100 * near:.2f} | {loss} | "
            + " | ".join(cells)
            + " |"
        )
    return "\n".join(lines) + "\n"


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", help="names of folders (default: all 3-D sets)")
    parser.add_argument("--choices", nargs="+", help="names of rows (default: all)")
    parser.add_argument("--rays", type=int, default=30_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "choices.json")
    parser.add_argument("--markdown", type=Path, help="file to write the table to")
    arguments = parser.parse_args()
    sets = find_sets(arguments.data, arguments.sets)
    chosen = {name: CHOICES[name] for name in arguments.choices or CHOICES}
    record: dict[str, Any] = {"conditions": conditions(), "rays": arguments.rays}
    print(describe(record["conditions"]), end="\n\n")
    results: dict[str, dict[str, Scores]] = {}
    halves = {
        name: split_rays(
            protocol_rays(load_scans(path), arguments.rays, arguments.seed), 0.5, arguments.seed
        )
        for name, path in sets.items()
    }
    for name, choice in tqdm(chosen.items(), disable=None):
        results[name] = {
            of_set: evaluate(build(train, choice, arguments.seed), test, arguments.seed)
            for of_set, (train, test) in halves.items()
        }
        print(markdown({name: results[name]}, list(sets)).splitlines()[-1], flush=True)
        write_json(arguments.json, record | {"results": results})
        if arguments.markdown:
            page = HEAD.format(rays=arguments.rays, seed=arguments.seed)
            arguments.markdown.write_text(page + markdown(results, list(sets)))


if __name__ == "__main__":
    main()
