"""Scores of probabilities at points whose class is known."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch.evaluation.calibration import calibration_error

CLIP = 1e-6  # probabilities are clipped to [CLIP, 1 - CLIP] in the log-loss


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
    p, labels, mass = both_classes(on_hits, on_free)
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


def both_classes(on_hits: Tensor, on_free: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
