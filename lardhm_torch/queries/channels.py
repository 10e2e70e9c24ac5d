"""Channels of a map at points: colors, values and class probabilities."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, channel_names


def channel(model: OccupancyMap, points: TensorLike, name: str) -> Tensor:
    """Interpolate a channel of a map: the local mean of the values of the hits, with gradients.

    The occupied clusters near a point are averaged with a power of their features, each with the
    linear trend of its values (`channel_queries`). An unknown value is NaN: no occupied cluster with a
    value is near.

    Args:
        model: a map that was given channels (`LardHilbertMap.fit`).
        points: (..., D) world positions [m].
        name: of the channel; "class": the probability of each class, in the order of
            ``model.classes`` (`LardHilbertMap.class_probability`).

    Returns:
        (...) values, or (..., C) of a channel with C values.

    Raises:
        ValueError: the map has no such channel.
    """
    check_channel(model, name)
    found: Any = model
    values: Tensor = found.channel(points, name)
    return values


def check_channel(model: OccupancyMap, name: str) -> None:
    """Raise a ValueError if a map has no channel of this name."""
    names = channel_names(model)
    if name not in names:
        raise ValueError(
            f"name must be a channel of the map, {', '.join(names) or 'which has none'}; got {name!r}"
        )
