"""Channels of a map at points: colors, values and class probabilities."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from lardhm_torch.maps import OccupancyMap, TensorLike, channel_names


def channel(model: OccupancyMap, points: TensorLike, name: str) -> Tensor:
    """Interpolate a channel of a map: the local mean of the values of the hits; differentiable.

    This is a weighted mean over the nearest occupied clusters, each with the linear trend of its
    values; weights are powers of the features (`channel_queries`). It is NaN where no occupied cluster
    with a value is near.

    Args:
        model: a map with channels (see `LardHilbertMap.fit`).
        points: (..., D) world positions [m].
        name: name of the channel; "class" gives the probability of each class, in the order of
            ``model.classes`` (`LardHilbertMap.class_probability`).

    Returns:
        (...) values, or (..., C) for a channel with C values.

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
