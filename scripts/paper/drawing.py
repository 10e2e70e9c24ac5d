"""Curves for the page, all in one style."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLORS = {
    "LARD-HM": "#0b6e4f",
    "LARD-HM, fine-tuned": "#6bbf59",
    "Original HM": "#c8553d",
    "Local GP": "#3d5a98",
    "OctoMap": "#8d8d8d",
    "Fourier": "#e8a07f",
    "Nystroem": "#7a3b2e",
    "GPOM": "#b8860b",
    "GPIS": "#7b4397",
}
SPARE = ("#0b6e4f", "#c8553d")


def new_figure(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure with a row of axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, list(axes)


def draw_curves(
    axes: Axes,
    x: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    dashed: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
) -> None:
    """Ours as lines with dots, the paper's figures dashed in the same color."""
    for number, (name, values) in enumerate(curves.items()):
        color = COLORS.get(name, SPARE[number % len(SPARE)])
        axes.plot(x, values, "o-", color=color, label=name, markersize=4)
    for name, (places, values) in (dashed or {}).items():
        axes.plot(places, values, "x--", color=COLORS[name], alpha=0.5, label=f"{name} (paper)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG."""
    figure.savefig(path, dpi=120)
