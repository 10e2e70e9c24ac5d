"""Draw the method in two dimensions: points, clusters, and maps with one and eight neighbors.

Usage: python scripts/draw_method.py [PICTURE]    (default: docs/pictures/method.png)
"""

import math
import sys
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans, sample_rays
from lardhm_torch.queries.grids import query_slice

BOUNDS = ([-3.3, -2.3], [3.3, 2.3])  # [m]
BOX, PILLAR = (3.0, 2.0), (1.2, 0.3, 0.6)  # [m] half edges of the room; x, y, radius in it


def simulate(origin: tuple[float, float], count: int = 400) -> Scans:
    """Scan of a rotating laser in a box with a round pillar."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    way = torch.stack([angle.cos(), angle.sin()], dim=1)
    start = torch.tensor(origin, dtype=torch.float64)
    half = torch.tensor(BOX, dtype=torch.float64)
    ranges = ((half * way.sign() - start) / way).amin(dim=1)
    offset = start - torch.tensor(PILLAR[:2], dtype=torch.float64)
    along = way @ offset
    root = along.square() - offset.square().sum() + PILLAR[2] ** 2
    pillar = -along - root.clamp(min=0).sqrt()
    ranges = torch.where((root > 0) & (pillar > 0), torch.minimum(ranges, pillar), ranges)
    return Scans(start[None], start + ranges[:, None] * way)


def draw_clusters(axes: Any, model: LardHilbertMap) -> None:
    """Ellipses of two standard deviations."""
    factors = model.scale_tril.detach() / model.covariance_scale**0.5
    axes_of, stds, _ = torch.linalg.svd(factors)
    for center, turn, std, occupied in zip(
        model.centers.detach() + model.origin, axes_of, stds, model.is_occupied, strict=True
    ):
        degrees = math.degrees(math.atan2(float(turn[1, 0]), float(turn[0, 0])))
        color = "firebrick" if occupied else "steelblue"
        width, height = 4 * std.tolist()[0], 4 * std.tolist()[1]
        axes.add_patch(
            Ellipse(center.tolist(), width, height, angle=degrees, fill=False, color=color)
        )


def main(picture: Path) -> None:
    """Fit two maps and draw the four pictures."""
    parts = [sample_rays(simulate(origin), seed=1) for origin in ((-1.5, 0.5), (0.5, -1.2))]
    points = torch.cat([part.points for part in parts])
    labels: Tensor = torch.cat([part.labels for part in parts])
    models = {k: LardHilbertMap(2, k).fit(points, labels, 80) for k in (1, 8)}
    figure = Figure(figsize=(10, 7), layout="constrained")
    cells = figure.subplots(2, 2, sharex=True, sharey=True)
    for part, color in ((labels > 0, "firebrick"), (labels == 0, "steelblue")):
        cells[0, 0].plot(*points[part].T, ".", color=color, ms=2)
    cells[0, 0].set_title("(a) hits and free points")
    draw_clusters(cells[0, 1], models[8])
    cells[0, 1].set_title("(b) clusters, at two standard deviations")
    for axes, (k, model), letter in zip(cells[1], models.items(), "cd", strict=True):
        probability, extent = query_slice(model, None, 0.02, BOUNDS)
        axes.imshow(probability.T, origin="lower", extent=extent, cmap="RdBu_r", vmin=0, vmax=1)
        axes.set_title(f"({letter}) probability, {k} neighbor{'s' * (k > 1)}")
    for axes in cells.flat:
        axes.set(xlim=(-3.3, 3.3), ylim=(-2.3, 2.3), aspect="equal")
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures/method.png"))
