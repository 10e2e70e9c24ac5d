"""Synthetic scenes of any size, for the growth with clusters and points."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import LardHilbertMap
from lardhm_torch.learning.points import morton_order

AREA_PER_CLUSTER = 0.25  # [m^2] of ground
AREA_PER_POINT = 0.005  # [m^2]


def hills(area: float, count: int, rng: torch.Generator) -> Tensor:
    """(count, 3) points on rolling ground of that area [m]: the same density at every size."""
    places = area**0.5 * torch.rand(count, 2, generator=rng)
    height = 2 * torch.sin(places[:, :1] / 5) * torch.cos(places[:, 1:] / 7)
    return torch.cat([places, height], dim=1)


def labelled_hills(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """(count, 3) training points and (count,) labels: the ground, and free space above it."""
    rng = torch.Generator().manual_seed(seed)
    points = hills(AREA_PER_POINT * count, count, rng)
    labels = (torch.arange(count) % 2).float()
    above = 0.2 + 3 * torch.rand(count, generator=rng)
    points[:, 2] += torch.where(labels > 0, 0.02 * torch.randn(count, generator=rng), above)
    return points, labels


def made_up_map(num_clusters: int, num_neighbors: int = 5, seed: int = 0) -> LardHilbertMap:
    """A map of so many clusters on hills, half of them free, built without training."""
    rng = torch.Generator().manual_seed(seed)
    centers = hills(AREA_PER_CLUSTER * num_clusters / 2, num_clusters, rng)
    is_occupied = torch.arange(num_clusters) % 2 > 0
    centers[:, 2] += torch.where(is_occupied, 0, 3 * torch.rand(num_clusters, generator=rng))
    order = morton_order(centers)  # as `fit` leaves them
    centers, is_occupied = centers[order], is_occupied[order]
    model = LardHilbertMap(dim=3, num_neighbors=num_neighbors)
    state = model.state_dict()
    raw = torch.zeros(num_clusters, 3, 3) + torch.diag(torch.tensor([0.2, 0.2, 0.1]).log())
    state |= {
        "weights": torch.where(is_occupied, 4.0, -4.0),
        "posterior_means": torch.zeros(num_clusters),
        "posterior_variances": torch.zeros(num_clusters),
        "centers": centers,
        "raw_scale_tril": raw,
        "is_occupied": is_occupied,
        "counts": torch.full((num_clusters,), 50),
        "means": centers.clone(),
        "scatters": 50 * torch.diag(torch.tensor([0.04, 0.04, 0.01])).repeat(num_clusters, 1, 1),
    }
    model.load_state_dict(state)
    return model


def queries(num_clusters: int, count: int, seed: int = 1) -> Tensor:
    """(count, 3) points in random order over the same hills, from the ground to 3 m above it."""
    rng = torch.Generator().manual_seed(seed)
    points = hills(AREA_PER_CLUSTER * num_clusters / 2, count, rng)
    points[:, 2] += 3 * torch.rand(count, generator=rng)
    return points
