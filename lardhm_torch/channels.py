"""Additional values of rays and points: color, intensity, class labels and others, by name.

Channels are a dictionary of tensors with one row per ray or point:

- ``"class"``: (N,) int64 class numbers, -1 where missing; or (N, K) float probabilities of the
  classes 0 to K - 1, such as those of a segmentation network, NaN where missing;
- ``"color"``: (N, 3) red, green and blue, 0 to 1, NaN where missing;
- any other name: (N,) or (N, C) float values, NaN where missing.

A missing value stays missing everywhere; it never counts as zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import torch
from torch import Tensor

CLASS, COLOR, INTENSITY = "class", "color", "intensity"
# Class numbers are below; larger ones are identifiers of objects, or mistakes.
MOST_CLASSES = 1 << 16
Channels: TypeAlias = Mapping[str, Tensor]


def check_channels(
    channels: Channels | None, count: int, device: torch.device | str | None = None
) -> dict[str, Tensor]:
    """Validate channels and convert them to int64 class numbers and float32 values.

    Args:
        channels: tensors, arrays or lists by name (see the module); None: no channels.
        count: number N of rows.
        device: device of the result; None: that of each tensor.

    Raises:
        ValueError: a channel has another number of rows or another shape than its name demands, a
            class number or probability is out of range, or a value is infinite.
    """
    return {
        name: _checked(name, torch.as_tensor(values, device=device), count)
        for name, values in (channels or {}).items()
    }


def _checked(name: str, values: Tensor, count: int) -> Tensor:
    if not isinstance(name, str) or not name:
        raise ValueError(f"the name of a channel must be a string that is not empty; got {name!r}")
    if values.ndim == 0 or len(values) != count:
        raise ValueError(
            f"channel {name!r} must have {count} rows, one per ray or point; "
            f"got {tuple(values.shape)}"
        )
    if name == CLASS and not values.is_floating_point():
        return _checked_classes(values)
    values = values.detach().float()
    if values.ndim > 2 or (values.ndim == 2 and values.shape[1] == 0):
        raise ValueError(
            f"channel {name!r} must be ({count},) or ({count}, C); got {tuple(values.shape)}"
        )
    if values.ndim == 2 and values.shape[1] == 1 and name != CLASS:
        values = values[:, 0]
    if not math.isfinite(values.sum()) and bool(values.isinf().any()):  # the sum is quick
        raise ValueError(f"channel {name!r} must be finite, or NaN where missing; got infinity")
    if name == COLOR:
        _check_colors(values)
    if name == CLASS:
        _check_probabilities(values)
    return values


def _checked_classes(values: Tensor) -> Tensor:
    if values.ndim != 1:
        raise ValueError(
            f"channel {CLASS!r} must be ({len(values)},) whole numbers or ({len(values)}, K) "
            f"probabilities; got {tuple(values.shape)} of {values.dtype}"
        )
    values = values.detach().long()
    if len(values):
        lowest, highest = map(int, values.aminmax())
        if lowest < -1 or highest >= MOST_CLASSES:
            raise ValueError(
                f"class numbers must be 0 to {MOST_CLASSES - 1}, or -1 where missing; "
                f"got {lowest if lowest < -1 else highest}"
            )
    return values


def _check_colors(values: Tensor) -> None:
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"channel {COLOR!r} must be (N, 3) red, green, blue; got {_shape(values)}")
    outside = (values < 0) | (values > 1)
    if bool(outside.any()):
        raise ValueError(
            f"colors must be 0 to 1; got {values[outside][0].item():g}. "
            "From bytes: color = bytes / 255"
        )


def _check_probabilities(values: Tensor) -> None:
    if values.ndim != 2:
        raise ValueError(
            f"class probabilities must be (N, K), class numbers whole numbers; got {_shape(values)} "
            f"of {values.dtype}"
        )
    total = values.sum(dim=1)
    wrong = (values < 0).any(dim=1) | ((total - 1).abs() > 1e-2)  # NaN compares False
    if bool(wrong.any()):
        raise ValueError(
            "class probabilities must be 0 or more and add up to 1 in each row; "
            f"got {values[wrong][0].tolist()}"
        )


def _shape(values: Tensor) -> tuple[int, ...]:
    return tuple(values.shape)


def missing(values: Tensor) -> Tensor:
    """(N, ...) values of a channel -> (N,) bool: the row is missing."""
    if not values.is_floating_point():
        return values < 0
    return values.isnan() if values.ndim == 1 else values.isnan().any(dim=1)


def count_missing(channels: Channels) -> dict[str, int]:
    """Number of rows without a value, by channel."""
    return {name: int(missing(values).sum()) for name, values in channels.items()}


def missing_like(values: Tensor, count: int) -> Tensor:
    """``count`` rows of a channel without values: NaN, or class -1."""
    filler = torch.nan if values.is_floating_point() else -1
    return values.new_full((count, *values.shape[1:]), filler)


def select_channels(channels: Channels, rows: Tensor) -> dict[str, Tensor]:
    """The rows selected by a mask or by indices."""
    if not channels:
        return {}
    rows = rows.nonzero().squeeze(1) if rows.dtype == torch.bool else rows
    return {name: values.index_select(0, rows) for name, values in channels.items()}


def pad_channels(channels: Channels, count: int) -> dict[str, Tensor]:
    """The rows followed by missing ones, ``count`` in total."""
    return {
        name: torch.cat([values, missing_like(values, count - len(values))])
        for name, values in channels.items()
    }


def concatenate_channels(parts: Sequence[tuple[Channels, int]]) -> dict[str, Tensor]:
    """Concatenate channels; rows of a part without a channel are missing in it.

    Args:
        parts: channels and number of rows of each part.

    Raises:
        ValueError: a channel has different shapes, or classes are numbers in one part and
            probabilities in another.
    """
    joined: dict[str, Tensor] = {}
    for name in dict.fromkeys(name for channels, _ in parts for name in channels):
        like = next(channels[name] for channels, _ in parts if name in channels)
        rows = [
            channels[name] if name in channels else missing_like(like, count)
            for channels, count in parts
        ]
        kinds = sorted({(_shape(values)[1:], str(values.dtype)) for values in rows})
        if len(kinds) > 1:
            found = " and ".join(f"(N, {', '.join(map(str, s))}) {d}" for s, d in kinds)
            raise ValueError(f"channel {name!r} must have one shape and type; got {found}")
        joined[name] = torch.cat(rows)
    return joined
