"""Fig. 1: the two-dimensional example, its clusters, and what k and LARD do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from drawing import new_figure, save
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from lardhm_torch import LardHilbertMap
from lardhm_torch.queries.grids import query_slice

NUM_CLUSTERS = 28
MARGIN, RESOLUTION = 0.2, 0.01  # [m]
NUM_STDS = 2.0  # radius of the ellipses: covariance of the cluster's points


def figure_one(data: Path, folder: Path) -> dict[str, Any]:
    """Five panels: points, clusters, k = 1, k = 5, and k = 5 with round kernels of one size."""
    with np.load(data / "paper_rings" / "labelled.npz") as arrays:
        points, labels = torch.as_tensor(arrays["points"]), torch.as_tensor(arrays["labels"])
    maps = {
        "k = 1": fit_rings(points, labels, 1),
        "k = 5": fit_rings(points, labels, 5),
        "k = 5, no LARD": fit_without_lard(points, labels),
    }
    figure, axes = new_figure(17, 3.0, 5)
    _draw_points(axes[0], points, labels)
    _draw_clusters(axes[1], maps["k = 5"])
    lower, upper = points.amin(dim=0) - MARGIN, points.amax(dim=0) + MARGIN
    scores = {}
    for panel, (name, model) in zip(axes[2:], maps.items(), strict=True):
        probability, extent = query_slice(model, None, RESOLUTION, (lower, upper))
        panel.imshow(
            probability.T,
            origin="lower",
            extent=extent,
            cmap="RdBu_r",
            vmin=0,
            vmax=1,
            aspect="equal",
        )
        panel.set_title(name)
        with torch.no_grad():
            right = (model(points) > 0.5) == (labels > 0.5)
        scores[name] = float(right.float().mean())
    for panel in axes:
        panel.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), xticks=[], yticks=[])
        panel.set_aspect("equal")
    save(figure, folder / "figure_1.png")
    return {"points": len(points), "clusters": len(maps["k = 5"]), "training accuracy": scores}


def fit_rings(points: torch.Tensor, labels: torch.Tensor, num_neighbors: int) -> LardHilbertMap:
    """The map with the paper's number of neighbors."""
    return LardHilbertMap(2, num_neighbors).fit(points, labels, num_clusters=NUM_CLUSTERS)


def fit_without_lard(points: torch.Tensor, labels: torch.Tensor) -> LardHilbertMap:
    """The same clusters with one round kernel for all, weights trained anew by plain autograd."""
    model = fit_rings(points, labels, 5)
    with torch.no_grad():
        variance = (model.scatters / (model.counts - 1).clamp(min=1)[:, None, None]).diagonal(
            dim1=1, dim2=2
        )
        model.raw_scale_tril.copy_(0.5 * variance.mean().log() * torch.eye(2))
    optimizer = torch.optim.Adam([model.weights], lr=0.3)
    for _ in range(200):
        optimizer.zero_grad()
        torch.nn.functional.binary_cross_entropy_with_logits(
            model.log_odds(points), labels.float()
        ).backward()
        optimizer.step()
    return model


def _draw_points(panel: Axes, points: torch.Tensor, labels: torch.Tensor) -> None:
    for value, color in ((0, "#3d5a98"), (1, "#c8553d")):
        members = points[labels == value]
        panel.plot(members[:, 0], members[:, 1], ".", color=color, markersize=2)
    panel.set_title("points")


def _draw_clusters(panel: Axes, model: LardHilbertMap) -> None:
    means = (model.means.double() + model.origin).numpy()
    covariances = (model.scatters / (model.counts - 1).clamp(min=1)[:, None, None]).numpy()
    for mean, covariance, occupied in zip(means, covariances, model.is_occupied, strict=True):
        sizes, axes = np.linalg.eigh(covariance)
        angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        width, height = 2 * NUM_STDS * np.sqrt(sizes[::-1])
        color = "#c8553d" if occupied else "#3d5a98"
        panel.add_patch(Ellipse(mean, width, height, angle=angle, fill=False, color=color))
        panel.plot(*mean, ".", color=color, markersize=3)
    panel.set_title(f"{len(means)} clusters, {NUM_STDS:g} standard deviations")
