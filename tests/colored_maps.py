"""Walls with channels, and maps of them: what the tests of channels share."""

import torch
from small_maps import F64, wall

from lardhm_torch import LardHilbertMap

CLASSES = (3, 7)


def ramp(points):
    """A color that is linear in space, 0 to 1 on the wall."""
    return torch.stack([points[:, 1] / 2, points[:, 2] / 2, 0.5 + 0 * points[:, 0]], dim=1)


def channels_of(points, labels):
    """Channels of the hits of a wall: linear values, and two classes that meet at y = 1."""
    is_hit = labels == 1
    classes = torch.where(points[:, 1] < 1, *CLASSES)
    return {
        "color": torch.where(is_hit[:, None], ramp(points).clamp(0, 1), torch.nan),
        "intensity": torch.where(is_hit, 100 * points[:, 1], torch.nan),
        "class": torch.where(is_hit, classes, -1),
    }


def colored_wall(count=600, seed=0):
    points, labels = wall(count, seed=seed)
    return points, labels, channels_of(points, labels)


def colored_map(dtype=F64, **settings):
    points, labels, channels = colored_wall()
    model = LardHilbertMap(3, **settings).to(dtype)
    return model.fit(points, labels, 40, channels=channels)


def surface_points(count=50, seed=3):
    rng = torch.Generator().manual_seed(seed)
    points = 0.2 + 1.6 * torch.rand(count, 3, generator=rng, dtype=F64)
    points[:, 0] = 1
    return points


def total(model, name):
    return model.channels[name].sums.sum(dim=0)
