"""Scores of probabilities at points of known class."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch.evaluation.calibration import calibration_error
from lardhm_torch.maps import TensorLike, to_tensor

CLIP = 1e-6  # the log-loss clips probabilities to [CLIP, 1 - CLIP]


def occupancy_metrics(on_hits: TensorLike, on_free: TensorLike) -> dict[str, float]:
    """Scores of the probabilities at occupied and at free points.

    Exactly 1/2 means unknown: it counts as wrong in the accuracies, and as 1/2 in the other scores.
    Log-loss, Brier score and calibration error give both classes the same weight.

    Args:
        on_hits: (H,) probability of occupancy at occupied points.
        on_free: (F,) at free points.

    Returns:
        balanced_accuracy, accuracy, hit_rate, free_rate, auc, log_loss, brier, ece (expected
        calibration error, 15 bins of equal mass), unknown (fraction of exactly 1/2).

    Raises:
        ValueError: a class has no points, or a probability is NaN or outside [0, 1].
    """
    from sklearn.metrics import roc_auc_score

    hits = _check_probability(on_hits, "on_hits")
    free = _check_probability(on_free, "on_free")
    hit_rate, free_rate = (hits > 0.5).double().mean(), (free < 0.5).double().mean()
    p, labels, mass = both_classes(hits, free)
    likelihood = torch.where(labels > 0.5, p, 1 - p).clamp(CLIP, 1 - CLIP)
    scores = {
        "balanced_accuracy": 0.5 * (hit_rate + free_rate),
        "accuracy": (hit_rate * len(hits) + free_rate * len(free)) / len(p),
        "hit_rate": hit_rate,
        "free_rate": free_rate,
        "auc": roc_auc_score(labels, p),
        "log_loss": -(mass * likelihood.log()).sum(),
        "brier": (mass * (p - labels).square()).sum(),
        "ece": calibration_error(p, labels, mass),
        "unknown": (p == 0.5).double().mean(),
    }
    return {name: float(value) for name, value in scores.items()}


def format_metrics(table: dict[str, dict[str, float]]) -> str:
    """Format scores as a text table.

    Args:
        table: scores for each kind of test point, one row each, see `evaluate`.

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
    """(N,) probabilities, labels and masses of both classes; each class has mass 1/2."""
    parts = (on_hits.double().cpu(), on_free.double().cpu())
    labels = torch.cat([torch.ones_like(parts[0]), torch.zeros_like(parts[1])])
    mass = torch.cat([part.new_full(part.shape, 0.5 / len(part)) for part in parts])
    return torch.cat(parts), labels, mass


def _check_probability(values: TensorLike, name: str) -> Tensor:
    """(N,) float64 on the CPU, for scikit-learn; or a ValueError."""
    p = to_tensor(values, name).detach().cpu()
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
