"""Draw a picture of each query: rays, segments, clearance, frontiers.

Usage: python scripts/robot_questions.py [FOLDER]    (default: docs/pictures)
"""

import math
import sys
from pathlib import Path
from typing import Any

import torch
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from torch import Tensor

from lardhm_torch import LardHilbertMap, raycast, sample_rays, simulate_room
from lardhm_torch.queries.clearance import clearance
from lardhm_torch.queries.collision import Mover, expected_range, free_probability
from lardhm_torch.queries.exploration import information_gain
from lardhm_torch.queries.frontiers import frontiers
from lardhm_torch.queries.grids import grid, occupancy_gradient, query_slice

HEIGHT = 1.1  # [m]
BOUNDS = ([0.0, 0.0], [8.0, 5.0])  # [m]


def canvas(model: LardHilbertMap, title: str) -> tuple[Figure, Any]:
    """A picture with the probability at one height."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot()
    probability, extent = query_slice(model, HEIGHT, 0.02, BOUNDS)
    axes.imshow(probability.T, origin="lower", extent=extent, cmap="RdBu_r", vmin=0, vmax=1)
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, xlim=(-0.2, 8.2), ylim=(-0.2, 5.2))
    return figure, axes


def fan(count: int, dim: int = 3) -> Tensor:
    """(count, 3) horizontal directions all around."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)[:, :dim]


def draw_rays(model: LardHilbertMap, path: Path) -> None:
    """Where rays end, and how far they get on average."""
    origin, directions = torch.tensor([6.4, 2.6, HEIGHT], dtype=torch.float64), fan(90)
    ends = raycast(model, origin, directions, 10.0)
    crossing = raycast(model, origin, directions, 10.0, surface="crossing")
    mean = expected_range(model, origin, directions, 10.0)
    figure, axes = canvas(model, "raycast and expected_range")
    for end, way in zip(ends, directions, strict=True):
        far = min(float(end), 10.0)
        axes.plot(
            *[(float(origin[i]), float(origin[i] + far * way[i])) for i in (0, 1)], "0.6", lw=0.6
        )
    for ranges, style, name in (
        (ends, "k.", "surface: raycast(...)"),
        (crossing, "g.", 'raycast(..., surface="crossing")'),
        (mean, "mx", "expected_range(...)"),
    ):
        places = origin + ranges.clamp(max=10)[:, None] * directions
        axes.plot(places[:, 0], places[:, 1], style, ms=5, label=name)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def draw_segments(model: LardHilbertMap, path: Path) -> None:
    """Straight ways from one place, colored by the probability that a sphere gets through."""
    from matplotlib import colormaps

    start = torch.tensor([[3.2, 3.2, HEIGHT]], dtype=torch.float64)
    ends = start + fan(72) * torch.tensor([1.8, 2.4, 3.0], dtype=torch.float64).repeat(24)[:, None]
    chance = free_probability(model, start.expand_as(ends), ends, Mover(radius=0.15))
    figure, axes = canvas(model, "free_probability of a sphere of 15 cm on straight ways")
    for end, p in zip(ends, chance, strict=True):
        color = colormaps["RdYlGn"](float(p))
        axes.plot([3.2, float(end[0])], [3.2, float(end[1])], color=color, lw=2)
    figure.colorbar(
        ScalarMappable(cmap="RdYlGn"), ax=axes, shrink=0.7, label="probability that the way is free"
    )
    figure.savefig(path, dpi=110)


def draw_clearance(model: LardHilbertMap, path: Path) -> None:
    """The distance-like bound, and the way out of obstacles."""
    points = grid([0, 0, HEIGHT], [8, 5, HEIGHT], 0.04).squeeze(2)
    figure, axes = canvas(model, "clearance [m] (lines) and the gradient away from obstacles")
    lines = axes.contour(
        points[..., 0],
        points[..., 1],
        clearance(model, points),
        levels=[0, 0.2, 0.4, 0.6, 0.8, 1.0],
        cmap="viridis",
    )
    axes.clabel(lines)
    sparse = grid([0.1, 0.1, HEIGHT], [7.9, 4.9, HEIGHT], 0.2).reshape(-1, 3)
    away = -occupancy_gradient(model, sparse)[:, :2].double()
    away = away / (1 + away.norm(dim=1, keepdim=True))
    axes.quiver(sparse[:, 0], sparse[:, 1], away[:, 0], away[:, 1], scale=45, width=0.0015)
    figure.savefig(path, dpi=110)


def draw_frontiers(path: Path) -> None:
    """After one scan: the border of the known, and what views from six places would tell."""
    scans = simulate_room(seed=0)
    samples = sample_rays(scans.select(scans.scan_id == 0))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    found = frontiers(model, [0, 0, HEIGHT - 0.1], [8, 5, HEIGHT + 0.1], 0.1)
    figure, axes = canvas(model, "frontiers after the first scan, and information_gain of views")
    shown = axes.scatter(
        found.points[:, 0], found.points[:, 1], c=found.groups.clamp(max=9), cmap="tab10", s=9
    )
    shown.set_zorder(3)
    rise = torch.linspace(-0.6, 0.6, 9, dtype=torch.float64)
    directions = torch.cat([fan(120) + torch.tensor([0, 0, float(z)]) for z in rise])
    for x, y in ((1.7, 3.1), (3.0, 3.3), (4.4, 0.9), (6.2, 2.6), (7.0, 2.4), (6.6, 1.0)):
        view = torch.tensor([x, y, HEIGHT], dtype=torch.float64)
        bits = information_gain(model, view, directions, 6.0)
        axes.plot(x, y, "k^", ms=9)
        axes.annotate(f"{bits / 1000:.1f} kbit", (x, y), (6, 6), textcoords="offset points")
        print(f"view from ({x}, {y}): {bits:.0f} bits")
    figure.savefig(path, dpi=110)


def main(folder: Path) -> None:
    """Fit the room, draw all."""
    samples = sample_rays(simulate_room(seed=0))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    draw_rays(model, folder / "question_rays.png")
    draw_segments(model, folder / "question_segments.png")
    draw_clearance(model, folder / "question_clearance.png")
    draw_frontiers(folder / "question_frontiers.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))
