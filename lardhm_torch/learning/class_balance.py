"""Factors of points in the loss, so that classes count independently of their numbers of points."""

from __future__ import annotations

import torch
from torch import Tensor


def class_factors(free: Tensor, occupied: Tensor, occupied_share: float = 0.5) -> Tensor:
    """(2,) loss factors of a free and an occupied point that balance the classes.

    The mean over all points is 1. If only one class is present, both factors are 1.

    Args:
        free: () number, or total weight, of the free points.
        occupied: () number, or total weight, of the occupied points.
        occupied_share: class weight of the occupied points, as a fraction of the loss.
    """
    total = free + occupied
    balanced = total * torch.stack([(1 - occupied_share) / free, occupied_share / occupied])
    return torch.where((occupied > 0) & (free > 0), balanced, torch.ones_like(balanced))


def label_factors(
    labels: Tensor, occupied_share: float = 0.5, unknown_share: float = 0.25
) -> Tensor:
    """(N,) labels -> (3,) loss factors of a free, an unknown and an occupied point, float64.

    The first and last are those of `class_factors`. The total weight of the unknown points is
    ``unknown_share`` times that of all others.
    """
    occupied, unknown = (labels > 0.5).sum(), (labels == 0.5).sum()
    counts = torch.stack([len(labels) - unknown - occupied, unknown, occupied])
    return count_factors(counts, occupied_share, unknown_share)


def count_factors(
    counts: Tensor, occupied_share: float = 0.5, unknown_share: float = 0.25
) -> Tensor:
    """(3,) numbers of free, unknown and occupied points -> their `label_factors`."""
    free, unknown, occupied = counts.double().unbind()
    known = free + occupied
    factor, hit = class_factors(free, occupied, occupied_share).unbind()
    return torch.stack([factor, unknown_share * known / unknown.clamp(min=1), hit])


def balance_classes(
    labels: Tensor, occupied_share: float = 0.5, unknown_share: float = 0.25
) -> Tensor:
    """(N,) labels -> (N,) loss factors, see `label_factors`."""
    return label_factors(labels, occupied_share, unknown_share).to(labels)[(2 * labels).long()]
