"""The methods that are compared, and the choice of the baselines' settings on validation rays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import (
    LardHilbertMap,
    Samples,
    Scans,
    fine_tune,
    load_scans,
    sample_rays,
    split_rays,
)
from lardhm_torch.evaluation.baselines.local_gp import LocalGP
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.baselines.original_hilbert_map import OriginalHilbertMap
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays

Model = Callable[[Tensor], Tensor]
Build = Callable[[Scans, Samples], Model]

OURS = ("LARD-HM", "LARD-HM, fine-tuned")
BASELINES = ("Original HM", "Local GP", "OctoMap")
CANDIDATES: dict[str, list[tuple[Any, ...]]] = {
    "Original HM": [(0.15, 0.7), (0.2, 0.7), (0.2, 1.0), (0.3, 0.7), (0.3, 1.0)],
    "Local GP": [(50, 2), (50, 5), (100, 2), (100, 5)],
    "OctoMap": [(0.05,), (0.1,), (0.2,), (0.4,)],
}
MEANING = {
    "Original HM": "cell {} m, lengthscale {} cells",
    "Local GP": "{} points per process, k = {}",
    "OctoMap": "voxel {} m",
}
VALIDATION_SHARE = 0.2
MAX_VALIDATION_RAYS = 10_000  # that settings are chosen on
MAX_TEST_RAYS = 10_000


def build(name: str, settings: tuple[Any, ...], train: Scans, samples: Samples, seed: int) -> Model:
    """A method trained on rays and on the samples of these rays, the same for all."""
    points, labels = samples.points, samples.labels
    if name == "Original HM":
        return OriginalHilbertMap(*settings, seed=seed).fit(points, labels)
    if name == "Local GP":
        return LocalGP(*settings, seed=seed).fit(points, labels)
    if name == "OctoMap":
        return OctoMapBaseline(*settings).fit(train)
    model = LardHilbertMap().fit(points, labels, seed=seed)
    if name == "LARD-HM, fine-tuned":
        fine_tune(model, points, labels, ray_id=samples.ray_id, seed=seed)
    return model


def choose_settings(train: Scans, names: tuple[str, ...] = BASELINES) -> dict[str, tuple[Any, ...]]:
    """For each baseline the candidate of best accuracy on a fifth of the training rays.

    The measure is the paper's own test, the one the comparison is then made by.
    """
    rays = protocol_rays(train, MAX_VALIDATION_RAYS)
    fit_rays, validation = split_rays(rays, 1 - VALIDATION_SHARE, seed=1)
    samples = sample_rays(fit_rays, seed=0)
    chosen = {}
    for name in names:
        scores = {}
        for settings in CANDIDATES[name]:
            model = build(name, settings, fit_rays, samples, seed=0)
            scores[settings] = accuracy(model, validation)["paper"]
        chosen[name] = max(scores, key=scores.__getitem__)
    return chosen


@torch.no_grad()
def accuracy(model: Model, test: Scans, seed: int = 0) -> dict[str, float]:
    """Balanced accuracy by kind of free test point: unif, near, paper."""
    scores = evaluate(model, protocol_rays(test, MAX_TEST_RAYS, seed), seed)
    return {kind: values["balanced_accuracy"] for kind, values in scores.items()}


def describe(chosen: dict[str, tuple[Any, ...]]) -> dict[str, str]:
    """Settings in words."""
    return {name: MEANING[name].format(*settings) for name, settings in chosen.items()}


def rays_of(data: Path, name: str, max_rays: int | None = None, seed: int = 0) -> Scans:
    """The protocol's rays of a set."""
    return protocol_rays(load_scans(data / name / "scans.npz"), max_rays, seed)
