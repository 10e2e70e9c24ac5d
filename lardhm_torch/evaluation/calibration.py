"""Calibration of probabilities: reliability diagrams and the expected calibration error."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file

BINS = 15


def reliability(p: Tensor, labels: Tensor, mass: Tensor, bins: int = BINS) -> Tensor:
    """Reliability diagram with bins of equal mass.

    Points are sorted by probability and divided into bins. Points of equal probability all count
    with their mean label, so that neither their order nor a bin edge between them matters.

    Args:
        p: (N,) float64 probabilities.
        labels: (N,) 1 occupied, 0 free.
        mass: (N,) weight of each point, sum 1.
        bins: number of bins.

    Returns:
        (bins, 3) mass, mean probability and fraction of occupied points of each bin.
    """
    order = p.argsort()
    p, labels, mass = p[order], labels[order], mass[order]
    _, group = torch.unique_consecutive(p, return_inverse=True)
    sums = mass.new_zeros(len(p), 3).index_add_(
        0, group, torch.stack([mass, mass * labels, torch.ones_like(mass)], dim=1)
    )
    occupied, mass = (sums[:, 1] / sums[:, 0])[group], (sums[:, 0] / sums[:, 2])[group]
    bin_of = ((mass.cumsum(0) - 0.5 * mass) * bins).long().clamp(0, bins - 1)
    columns = torch.stack([mass, mass * p, mass * occupied], dim=1)
    total = torch.zeros(bins, 3, dtype=p.dtype, device=p.device).index_add_(0, bin_of, columns)
    return torch.cat([total[:, :1], total[:, 1:] / total[:, :1].clamp(min=1e-300)], dim=1)


def calibration_error(p: Tensor, labels: Tensor, mass: Tensor) -> Tensor:
    """Expected calibration error: mean of |mean probability - fraction occupied| over the bins.

    Arguments as for `reliability`.
    """
    diagram = reliability(p, labels, mass)
    return (diagram[:, 0] * (diagram[:, 1] - diagram[:, 2]).abs()).sum()


def draw_reliability(diagrams: dict[str, Tensor], path: str | Path) -> None:
    """Plot reliability diagrams to a PNG file.

    Args:
        diagrams: name -> (bins, 3), see `reliability`.
        path: PNG file to write.

    Raises:
        ValueError: the path does not end in .png, or there is no diagram.
    """
    from matplotlib.figure import Figure

    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"path must end in .png for an image; got {Path(path).name!r}")
    if not diagrams:
        raise ValueError("diagrams must hold at least one diagram; got none")
    figure = Figure(figsize=(4.2 * len(diagrams), 4.4), layout="constrained")
    panels = figure.subplots(1, len(diagrams), squeeze=False)[0]
    for axes, (name, diagram) in zip(panels, diagrams.items(), strict=True):
        mass, predicted, observed = diagram[diagram[:, 0] > 0].cpu().T
        error = float((mass * (predicted - observed).abs()).sum())
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        axes.plot(predicted.numpy(), observed.numpy(), marker="o", markersize=4)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=f"{name}: ECE {error:.3f}")
        axes.set(xlabel="predicted probability", ylabel="observed fraction")
    with replaced_file(path) as partial:
        figure.savefig(partial, dpi=130)
