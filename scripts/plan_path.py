"""Plan a path around furniture by gradient descent on its waypoints.

A robot of 25 cm radius crosses the simulated room. The cost is the length of the path, plus the hazard
of its segments, plus a penalty on small clearance. All are differentiable functions of the map. Since
gradient descent finds a local minimum, it starts from lines curved to both sides, and the path with
the lowest cost is kept.

Usage: python scripts/plan_path.py [PICTURE]    (default: docs/pictures/question_path.png)
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from lardhm_torch import LardHilbertMap, sample_rays, simulate_room
from lardhm_torch.queries.clearance import clearance
from lardhm_torch.queries.collision import Mover, free_probability, segment_hazard
from lardhm_torch.queries.grids import query_slice

START, GOAL = (0.8, 1.9), (7.1, 2.4)  # [m]
HEIGHTS = (0.5, 0.75)  # [m] of the robot's body where it is checked
RADIUS = 0.25  # [m]
WAYPOINTS = 30
BENDS = (-1.5, -0.5, 0.5, 1.5)  # [m] by which the middle of the first guess lies beside the line


def at_height(path: Tensor, height: float) -> Tensor:
    """(W, 2) path on the floor -> (W, 3) at a height."""
    return torch.cat([path, torch.full_like(path[:, :1], height)], dim=1)


def cost(model: LardHilbertMap, path: Tensor) -> Tensor:
    """Length [m], obstacles met, and too little clearance, of (W, 2) waypoints."""
    total = (
        2 * (WAYPOINTS - 1) * path.diff(dim=0).square().sum()
    )  # short, with segments of equal length
    for height in HEIGHTS:
        points = at_height(path, height)
        total = total + 10 * segment_hazard(model, points[:-1], points[1:]).sum()
        lack = (RADIUS - clearance(model, points)).clamp(min=0)
        total = total + 200 * lack.square().sum()
    return total


def descend(model: LardHilbertMap, guess: Tensor, iterations: int = 200) -> Tensor:
    """(W, 2) waypoints -> the same after gradient descent; both ends stay."""
    inner = guess[1:-1].clone().requires_grad_()
    optimizer = torch.optim.Adam([inner], lr=0.04)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        cost(model, torch.cat([guess[:1], inner, guess[-1:]])).backward()
        optimizer.step()
        schedule.step()
    return torch.cat([guess[:1], inner.detach(), guess[-1:]])


def plan(model: LardHilbertMap) -> tuple[Tensor, Tensor]:
    """(W, 2) the straight line, and the best path that bends of it become."""
    share = torch.linspace(0, 1, WAYPOINTS, dtype=torch.float64)[:, None]
    start, goal = (torch.tensor([end], dtype=torch.float64) for end in (START, GOAL))
    line = start + share * (goal - start)
    aside = torch.tensor([-1.0, 1.0]) * (goal - start).flip(1) / (goal - start).norm()
    paths = [descend(model, line + bend * torch.sin(torch.pi * share) * aside) for bend in BENDS]
    return line, min(paths, key=lambda path: float(cost(model, path)))


def free(model: LardHilbertMap, path: Tensor) -> float:
    """Probability that the robot gets along the path, at all its heights."""
    chance = 1.0
    for height in HEIGHTS:
        points = at_height(path, height)
        free = free_probability(model, points[:-1], points[1:], Mover(radius=RADIUS))
        chance = min(chance, float(free.prod()))
    return chance


def main(picture: Path) -> None:
    """Fit, plan, draw."""
    samples = sample_rays(simulate_room(seed=0))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    line, path = plan(model)
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot()
    probability, extent = query_slice(model, 0.45, 0.02, ([0, 0], [8, 5]))
    axes.imshow(probability.T, origin="lower", extent=extent, cmap="RdBu_r", vmin=0, vmax=1)
    for way, color, name in ((line, "0.35", "straight"), (path, "black", "optimized")):
        length = float(way.diff(dim=0).norm(dim=1).sum())
        label = f"{name}: {length:.2f} m, free with probability {free(model, way):.3f}"
        axes.plot(*way.T, ".-", color=color, label=label)
        print(label)
    for x, y in path[::3]:
        axes.add_patch(_circle(float(x), float(y)))
    axes.set(xlabel="x [m]", ylabel="y [m]", title="probability at z = 0.45 m")
    axes.legend(loc="lower right")
    figure.savefig(picture, dpi=110)


def _circle(x: float, y: float):
    from matplotlib.patches import Circle

    return Circle((x, y), RADIUS, fill=False, color="black", alpha=0.3)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures/question_path.png"))
