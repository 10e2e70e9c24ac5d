"""How good a map is: held-out rays, scores and calibration of probabilities, distances of meshes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.calibration import calibration_error, reliability
from lardhm_torch.scans import Scans

if TYPE_CHECKING:
    import trimesh

MIN_RANGE, MAX_RANGE = 0.3, 60.0  # [m] rays outside are not test rays
NEAR_START, NEAR_END = 0.6, 0.2  # [m] before the hit: where the near points lie
FREE_KINDS = ("unif", "near", "paper")
PAPER_SHARE = 0.95  # of a ray: where the paper's own free test points lie
CLIP = 1e-6  # probabilities are clipped to [CLIP, 1 - CLIP] in the log-loss
F_SCORE_LIMITS = (0.05, 0.1)  # [m]
QUERY_POINTS = 1 << 20  # points asked at a time


class HeldOut(NamedTuple):
    """Test points of R rays, world frame, each (R, D) float64 [m].

    ``hits`` are occupied, all others free: ``unif`` uniform from the sensor to 0.2 m before the
    hit, ``near`` between 0.6 m and 0.2 m before it, ``paper`` uniform over 95 % of the ray, with
    no margin (the paper's own kind of test).
    """

    hits: Tensor
    unif: Tensor
    near: Tensor
    paper: Tensor


def protocol_rays(scans: Scans, max_rays: int | None = None, seed: int = 0) -> Scans:
    """The rays that train and test: returns, first of their pulse, 0.3 m < range < 60 m.

    Args:
        scans: range scans.
        max_rays: a random subset of this size where there are more; None: all.
        seed: of the subset.
    """
    ranges = scans.ranges
    usable = (ranges > MIN_RANGE) & (ranges < MAX_RANGE) & scans.is_return
    scans = scans.select(usable & (scans.target_index == 1))
    if max_rays is None or len(scans) <= max_rays:
        return scans
    rng = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(scans), generator=rng)[:max_rays].sort().values
    return scans.select(chosen.to(scans.ends.device))


def held_out_points(scans: Scans, seed: int = 0) -> HeldOut:
    """Test points of every usable ray: its hit and three free points before it.

    Raises:
        ValueError: no ray is usable (see `protocol_rays`).
    """
    rays = protocol_rays(scans)
    if len(rays) == 0:
        raise ValueError(
            f"scans must hold at least one ray that hit, with {MIN_RANGE} m < range < "
            f"{MAX_RANGE:g} m; got none of {len(scans)}"
        )
    ranges, origins = rays.ranges[:, None], rays.ray_origins
    directions = (rays.ends - origins) / ranges
    rng = torch.Generator(device=ranges.device).manual_seed(seed)

    def uniform(start: Tensor, end: Tensor) -> Tensor:
        share = torch.rand(ranges.shape, generator=rng, device=ranges.device, dtype=ranges.dtype)
        return origins + (start + share * (end - start)) * directions

    zero, margin = torch.zeros_like(ranges), ranges - NEAR_END
    return HeldOut(
        hits=rays.ends,
        unif=uniform(zero, margin),
        near=uniform((ranges - NEAR_START).clamp(min=0), margin),
        paper=uniform(zero, PAPER_SHARE * ranges),
    )


def occupancy_metrics(on_hits: Tensor, on_free: Tensor) -> dict[str, float]:
    """Scores of the probabilities answered at occupied and at free points.

    Exactly 1/2 means unknown: wrong for the accuracies, 1/2 for the others. Log-loss, Brier score
    and calibration weigh both classes the same.

    Args:
        on_hits: (H,) probability of occupancy at occupied points.
        on_free: (F,) at free points.

    Returns:
        balanced_accuracy, accuracy, hit_rate, free_rate, auc, log_loss, brier, ece (expected
        calibration error, 15 equal-mass bins), unknown (share of exactly 1/2).

    Raises:
        ValueError: a class has no points, or a probability is NaN or outside [0, 1].
    """
    from sklearn.metrics import roc_auc_score

    on_hits = _check_probability(on_hits, "on_hits")
    on_free = _check_probability(on_free, "on_free")
    hit_rate, free_rate = (on_hits > 0.5).double().mean(), (on_free < 0.5).double().mean()
    p, labels, mass = _both_classes(on_hits, on_free)
    of_truth = torch.where(labels > 0.5, p, 1 - p).clamp(CLIP, 1 - CLIP)
    scores = {
        "balanced_accuracy": 0.5 * (hit_rate + free_rate),
        "accuracy": (hit_rate * len(on_hits) + free_rate * len(on_free)) / len(p),
        "hit_rate": hit_rate,
        "free_rate": free_rate,
        "auc": roc_auc_score(labels, p),
        "log_loss": -(mass * of_truth.log()).sum(),
        "brier": (mass * (p - labels).square()).sum(),
        "ece": calibration_error(p, labels, mass),
        "unknown": (p == 0.5).double().mean(),
    }
    return {name: float(value) for name, value in scores.items()}


def _both_classes(on_hits: Tensor, on_free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) probabilities, labels and masses: each class has mass 1/2."""
    answers = (on_hits.double().cpu(), on_free.double().cpu())
    labels = torch.cat([torch.ones_like(answers[0]), torch.zeros_like(answers[1])])
    mass = torch.cat([answer.new_full(answer.shape, 0.5 / len(answer)) for answer in answers])
    return torch.cat(answers), labels, mass


def _check_probability(p: Tensor, name: str) -> Tensor:
    """(N,) float64 on the CPU, where scikit-learn reads it, or a ValueError that says why not."""
    p = torch.as_tensor(p).detach().double().cpu()
    if p.ndim != 1 or len(p) == 0:
        raise ValueError(
            f"{name} must be (N,), one probability per point and at least one; got {tuple(p.shape)}"
        )
    wrong = int((~((p >= 0) & (p <= 1))).sum())
    if wrong:
        raise ValueError(
            f"{name} must be probabilities in [0, 1]; got {wrong} of {len(p)} NaN or outside. "
            "From log-odds: torch.sigmoid(log_odds)"
        )
    return p


@torch.no_grad()
def answer_held_out(model: Callable[[Tensor], Tensor], scans: Scans, seed: int = 0) -> HeldOut:
    """Probabilities of a map at the test points of held-out rays, each (R,).

    Args:
        model: (N, D) world positions -> (N,) probability of occupancy.
        scans: rays that the map has not seen.
        seed: of the test points.

    Raises:
        ValueError: no ray is usable, or the model answers with anything but (N,) probabilities.
    """

    def ask(positions: Tensor) -> Tensor:
        answers = [model(chunk) for chunk in positions.split(QUERY_POINTS)]
        if sum(len(answer) for answer in answers) != len(positions):
            raise ValueError(
                f"model must answer ({len(positions)},), one probability per point; "
                f"got {[tuple(answer.shape) for answer in answers]}"
            )
        return torch.cat(answers)

    return HeldOut(*map(ask, held_out_points(scans, seed)))


def score_held_out(answers: HeldOut) -> dict[str, dict[str, float]]:
    """Scores for each kind of free point: unif, near, paper."""
    return {kind: occupancy_metrics(answers.hits, getattr(answers, kind)) for kind in FREE_KINDS}


def reliability_held_out(answers: HeldOut) -> dict[str, Tensor]:
    """Reliability diagram for each kind of free point, both classes of the same mass."""
    return {
        kind: reliability(*_both_classes(answers.hits, getattr(answers, kind)))
        for kind in FREE_KINDS
    }


def evaluate(
    model: Callable[[Tensor], Tensor], scans: Scans, seed: int = 0
) -> dict[str, dict[str, float]]:
    """Scores of a map on held-out rays, for each kind of free point: unif, near, paper.

    Arguments and errors are those of `answer_held_out`.
    """
    return score_held_out(answer_held_out(model, scans, seed))


def format_metrics(table: dict[str, dict[str, float]]) -> str:
    """A text table, one row for each kind of test point.

    Raises:
        ValueError: the table is empty.
    """
    if not table:
        raise ValueError("table must hold at least one row of scores; got none")
    widths = {name: max(len(name), len("0.0000")) + 2 for name in next(iter(table.values()))}
    lines = ["test".ljust(8) + "".join(name.rjust(width) for name, width in widths.items())]
    for kind, scores in table.items():
        cells = (f"{scores[name]:.4f}".rjust(width) for name, width in widths.items())
        lines.append(kind.ljust(8) + "".join(cells))
    return "\n".join(lines)


def mesh_metrics(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    hits: Tensor,
    *,
    num_points: int = 200_000,
    seen_within: float = 0.1,
    seed: int = 0,
) -> dict[str, float]:
    """Distances between a mesh and the true surface, on the part of the truth that rays reached.

    Args:
        mesh: extracted surface [m].
        truth: true surface [m].
        hits: (H, 3) ends of the rays the map was made from [m].
        num_points: sampled on each surface.
        seen_within: a point of the truth counts if some hit is this near [m].
        seed: of the sampling.

    Returns:
        accuracy (mean distance mesh to truth), completeness (truth to mesh), chamfer (mean of
        both) [m]; f_score_0.05 and f_score_0.1 at those distances [m].

    Raises:
        ValueError: a mesh has no faces, hits are not (H, 3), or no truth was seen.
    """
    from scipy.spatial import cKDTree

    for name, surface in {"mesh": mesh, "truth": truth}.items():
        if len(surface.faces) == 0:
            raise ValueError(f"{name} must have faces; got none")
    if hits.ndim != 2 or hits.shape[1] != 3 or len(hits) == 0:
        raise ValueError(f"hits must be (H, 3), at least one; got {tuple(hits.shape)}")
    ours, true = (_sample_surface(surface, num_points, seed) for surface in (mesh, truth))
    near_hit, _ = cKDTree(hits.detach().cpu()).query(true, distance_upper_bound=seen_within)
    true = true[near_hit < float("inf")]
    if len(true) == 0:
        raise ValueError(f"hits must lie within {seen_within} m of the truth somewhere; none does")
    to_truth, to_mesh = cKDTree(true).query(ours)[0], cKDTree(ours).query(true)[0]
    scores = {"accuracy": to_truth.mean(), "completeness": to_mesh.mean()}
    scores["chamfer"] = 0.5 * (scores["accuracy"] + scores["completeness"])
    for limit in F_SCORE_LIMITS:
        scores[f"f_score_{limit}"] = _f_score((to_truth < limit).mean(), (to_mesh < limit).mean())
    return {name: float(value) for name, value in scores.items()}


def _f_score(precision: float, recall: float) -> float:
    return 2 * precision * recall / max(precision + recall, 1e-12)


def _sample_surface(surface: trimesh.Trimesh, num_points: int, seed: int) -> np.ndarray:
    from trimesh.sample import sample_surface

    return np.asarray(sample_surface(surface, num_points, seed=seed)[0])
