"""Do probabilities mean what they say? Reliability diagrams and the expected calibration error."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

BINS = 15


def reliability(p: Tensor, labels: Tensor, mass: Tensor, bins: int = BINS) -> Tensor:
    """Reliability diagram: (bins, 3) mass, mean probability and occupied share of each bin.

    Points are ranked by probability and cut into bins of equal mass. Points of equal probability
    cannot be told apart, so each counts with the occupied share of them all: the order in which
    they come must not matter, nor a bin's edge that falls among them.

    Args:
        p: (N,) probabilities.
        labels: (N,) 1 occupied, 0 free.
        mass: (N,) what each point counts, sum 1.
        bins: how many.
    """
    order = p.argsort()
    p, labels, mass = p[order], labels[order], mass[order]
    _, group = torch.unique_consecutive(p, return_inverse=True)
    sums = mass.new_zeros(len(p), 3).index_add_(
        0, group, torch.stack([mass, mass * labels, torch.ones_like(mass)], dim=1)
    )
    occupied, mass = (sums[:, 1] / sums[:, 0])[group], (sums[:, 0] / sums[:, 2])[group]
    which = ((mass.cumsum(0) - 0.5 * mass) * bins).long().clamp(0, bins - 1)
    columns = torch.stack([mass, mass * p, mass * occupied], dim=1)
    total = torch.zeros(bins, 3, dtype=p.dtype, device=p.device).index_add_(0, which, columns)
    return torch.cat([total[:, :1], total[:, 1:] / total[:, :1].clamp(min=1e-300)], dim=1)


def calibration_error(p: Tensor, labels: Tensor, mass: Tensor) -> Tensor:
    """Expected calibration error: mean distance of probability and occupied share over the bins."""
    diagram = reliability(p, labels, mass)
    return (diagram[:, 0] * (diagram[:, 1] - diagram[:, 2]).abs()).sum()


def draw_reliability(diagrams: dict[str, Tensor], path: str | Path) -> None:
    """Reliability diagrams to a PNG: how often it was occupied where the map said so likely.

    Args:
        diagrams: name -> (bins, 3), see `reliability`.
        path: of the PNG.

    Raises:
        ValueError: the path does not end in .png, or there is no diagram.
    """
    from matplotlib.figure import Figure

    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"path must end in .png for a picture; got {Path(path).name!r}")
    if not diagrams:
        raise ValueError("diagrams must hold at least one diagram; got none")
    figure = Figure(figsize=(4.2 * len(diagrams), 4.4), layout="constrained")
    panels = figure.subplots(1, len(diagrams), squeeze=False)[0]
    for axes, (name, diagram) in zip(panels, diagrams.items(), strict=True):
        mass, said, was = diagram[diagram[:, 0] > 0].cpu().T
        error = float((mass * (said - was).abs()).sum())
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        axes.plot(said.numpy(), was.numpy(), marker="o", markersize=4)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=f"{name}: ECE {error:.3f}")
        axes.set(xlabel="probability of occupancy", ylabel="share occupied")
    figure.savefig(path, dpi=130)
