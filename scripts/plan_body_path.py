"""Plan the path of a long robot through the simulated room, by gradient descent on its poses.

A robot 1.3 m long and 0.4 m wide, with a mast at its front, crosses the room. It consists of spheres.
A pose is a position on the floor and a heading. The cost is the length of the path and its turns,
plus a penalty where the least distance of the spheres to the surface is below a margin. As descent
finds a local minimum, it starts from lines curved to both sides, and the best path is kept.

Usage: python scripts/plan_body_path.py [PICTURE]    (default: docs/pictures/question_body_path.png)
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from torch import Tensor

from lardhm_torch import (
    Body,
    LardHilbertMap,
    body_collision_probability,
    body_distance,
    grid,
    sample_rays,
    signed_distance,
    simulate_room,
)

START, GOAL = (1.3, 2.2, 0.0), (7.0, 2.6, 0.0)  # x, y [m], heading [rad]
MARGIN = 0.08  # [m] wanted beside the body
WAYPOINTS = 32
BENDS = (-1.6, -0.8, 0.8, 1.6)  # [m] by which the middle of the first guess lies beside the line


def robot() -> Body:
    """Four spheres in a row, and three more up the mast."""
    row = [(x, 0.0, 0.3) for x in (-0.45, -0.15, 0.15, 0.45)]
    mast = [(0.45, 0.0, z) for z in (0.65, 0.9, 1.15)]
    return Body(torch.tensor(row + mast, dtype=torch.float64), [0.2] * 4 + [0.12] * 3)


def poses_of(path: Tensor) -> Tensor:
    """(W, 3) x, y and heading -> (W, 4, 4) poses."""
    x, y, heading = path.unbind(dim=1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    cos, sin = heading.cos(), heading.sin()
    rows = [[cos, -sin, zero, x], [sin, cos, zero, y], [zero, zero, one, zero], [zero] * 3 + [one]]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def between(path: Tensor, parts: int = 4) -> Tensor:
    """The waypoints of a path, with more in between."""
    share = torch.arange(parts, dtype=path.dtype)[:, None] / parts
    filled = path[:-1, None] + share * (path[1:] - path[:-1])[:, None]
    return torch.cat([filled.reshape(-1, 3), path[-1:]])


def cost(model: LardHilbertMap, body: Body, path: Tensor) -> Tensor:
    """Length and turns of a path, and too little distance to the surface."""
    steps = path.diff(dim=0)
    smooth = 20 * steps[:, :2].square().sum() + 2 * steps[:, 2].square().sum()
    lack = (MARGIN - body_distance(model, body, poses_of(between(path, 2)))).clamp(min=0)
    return smooth + 60 * lack.sum()


def descend(model: LardHilbertMap, body: Body, guess: Tensor, iterations: int = 400) -> Tensor:
    """(W, 3) waypoints -> the same after gradient descent; both ends stay."""
    inner = guess[1:-1].clone().requires_grad_()
    optimizer = torch.optim.Adam([inner], lr=0.03)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        cost(model, body, torch.cat([guess[:1], inner, guess[-1:]])).backward()
        optimizer.step()
        schedule.step()
    return torch.cat([guess[:1], inner.detach(), guess[-1:]])


def plan(model: LardHilbertMap, body: Body) -> tuple[Tensor, Tensor]:
    """(W, 3) the straight line, and the best of the paths that its bends become."""
    share = torch.linspace(0, 1, WAYPOINTS, dtype=torch.float64)[:, None]
    start, goal = (torch.tensor([end], dtype=torch.float64) for end in (START, GOAL))
    line = start + share * (goal - start)
    bump = torch.cat([0 * share, torch.sin(torch.pi * share), 0 * share], dim=1)
    paths = [descend(model, body, line + bend * bump) for bend in BENDS]
    return line, min(paths, key=lambda path: float(cost(model, body, path)))


def draw(model: LardHilbertMap, body: Body, paths: dict[str, Tensor], picture: Path) -> None:
    """The distance at the height of the body, and the spheres along the paths."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot()
    points = grid([0.0, 0.0, 0.3], [8.0, 5.0, 0.3], 0.02)
    distance = signed_distance(model, points, 1.0)[..., 0]
    image = axes.imshow(
        distance.T, origin="lower", extent=(0, 8, 0, 5), cmap="RdBu", vmin=-0.6, vmax=0.6
    )
    figure.colorbar(image, label="signed distance at z = 0.3 m [m]", shrink=0.7)
    for (name, path), color in zip(paths.items(), ("0.35", "black"), strict=True):
        dense = poses_of(between(path))
        least = float(body_distance(model, body, dense).min())
        worst = float(body_collision_probability(model, body, dense).max())
        length = float(path[:, :2].diff(dim=0).norm(dim=1).sum())
        label = f"{name}: {length:.2f} m, least distance {least:.2f} m, collision {worst:.3f}"
        axes.plot(*path[:, :2].T, ".-", color=color, label=label)
        print(label)
    for place in body.placed(poses_of(path[::3])):
        for (x, y, _), radius in zip(place[:4].tolist(), body.radii[:4].tolist(), strict=True):
            axes.add_patch(Circle((x, y), radius, fill=False, color="black", alpha=0.35))
    axes.set(xlabel="x [m]", ylabel="y [m]", title="a long robot made of spheres")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12))
    figure.savefig(picture, dpi=110)


def main(picture: Path) -> None:
    """Fit, plan, draw."""
    samples = sample_rays(simulate_room(seed=0))
    model = LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)
    body = robot()
    line, path = plan(model, body)
    draw(model, body, {"straight": line, "optimized": path}, picture)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures/question_body_path.png"))
