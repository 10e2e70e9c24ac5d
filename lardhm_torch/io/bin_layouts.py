"""The layout of binary points without a header, recognized by their values."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Layout = tuple[str, int]
KITTI: Layout = ("<f4", 4)
NUSCENES: Layout = ("<f4", 5)

_COLUMNS = {"<f4": (4, 3, 5, 6, 7, 8), "<f8": (3, 4, 5, 6)}
_PROBED_BYTES = 3360 * 4  # a whole number of points in every layout
_LEAST_POINTS = 30  # with fewer, the number of columns cannot be recognized
_CLEARLY = 0.3  # in mean log variance: another number of columns must fit KITTI's better by this
_MULTIPLE = 1.0  # the same for twice as many columns, which always fit a little better
_FIRST_BYTES = 120 * 16  # points of KITTI's that are looked at first
_FAR = 1e9  # [m] beyond all coordinates
_SIGN, _EXPONENT = np.uint32(1 << 31), np.uint32(0xFF << 23)  # bits of a float32
# Exponents of coordinates, intensities and times are between 2^-40 and 2^63.
_TINY, _HUGE = np.uint32((127 - 40) << 23), np.uint32((127 + 63) << 23)


def find_layout(content: NDArray[np.uint8], is_nuscenes: bool = False) -> Layout:
    """Type and number of columns.

    Doubles read as floats have wild exponents. With the right number of columns each column holds
    one quantity, and varies least: any other number mixes coordinates with intensities.

    Args:
        content: of the file.
        is_nuscenes: the name is one of nuScenes, whose scans have five columns.

    Raises:
        ValueError: no layout fits, or several do.
    """
    probe = content[:_PROBED_BYTES]
    if len(content) % 16 == 0 and _is_clearly_kitti(probe[:_FIRST_BYTES]):
        return KITTI
    words = probe[: len(probe) // 8 * 8].view("<u4")
    exponents = words & _EXPONENT
    is_huge = exponents > _HUGE
    if np.count_nonzero(is_huge):
        is_huge &= exponents < _EXPONENT
    num_huge = int(np.count_nonzero(is_huge))
    num_huge_lower = int(np.count_nonzero(is_huge[::2])) if num_huge else 0
    kind = "<f8" if _are_doubles(words, num_huge_lower) else "<f4"
    size = np.dtype(kind).itemsize
    fitting = tuple(n for n in _COLUMNS[kind] if len(content) and len(content) % (size * n) == 0)
    layout = None
    if fitting and (kind == "<f8" or not _are_wild(words, exponents, num_huge)):
        layout = _layout_of(probe.view(kind), kind, fitting, is_nuscenes)
    if layout is None:
        raise ValueError(
            "points of 16 bytes (float32 x y z intensity) are needed; "
            f"got {len(content)} bytes of another layout. Convert the file to .npz, .pcd or .csv"
        )
    return layout


def _is_clearly_kitti(first: NDArray[np.uint8]) -> bool:
    """Whether every fourth float is a reflectance from 0 to 1, and each coordinate leaves that range.

    Quick, and true of no other layout: with a number of columns that is no multiple of 4, every fourth
    float would be a coordinate now and then; with 8, one of the first seven columns would be in the
    range, too; and halves of doubles have wild exponents.
    """
    if len(first) < _FIRST_BYTES:
        return False
    values = first.view("<f4").reshape(-1, 8)
    low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    is_reflectance = all(low[n] >= 0 and high[n] <= 1 for n in (3, 7))
    return is_reflectance and all(1 < max(high[n], -low[n]) < _FAR for n in (0, 1, 2, 4, 5, 6))


def _layout_of(
    values: NDArray, kind: str, fitting: tuple[int, ...], is_nuscenes: bool
) -> Layout | None:
    """The layout among numbers of columns that fit the size of the file; None if it is not clear."""
    is_kitti_size = kind == "<f4" and 4 in fitting
    if len(values) < 4 * _LEAST_POINTS:
        return KITTI if is_kitti_size else None
    scores = _mean_log_variances(values, fitting)
    scores = {n: scores[n] + _MULTIPLE * (n % 2 == 0 and n // 2 in fitting) for n in fitting}
    least = min(scores.values(), default=np.inf)
    if not np.isfinite(least):
        return KITTI if is_kitti_size else None  # no point is finite
    if is_nuscenes and kind == "<f4" and scores.get(5, np.inf) < least + _CLEARLY:
        return NUSCENES
    if is_kitti_size and scores[4] <= least + _CLEARLY:
        may_be_three = scores.get(3, np.inf) < scores[4] + _CLEARLY
        if may_be_three and (values.reshape(-1, 4)[:, 3] < 0).any():
            raise ValueError(
                "it may have three columns (x y z) or four of float32: a fourth one would have the "
                "values of coordinates. Convert the file to .npz, .pcd or .csv"
            )
        return KITTI
    # Coordinates alone fit several layouts: the first one is taken.
    return kind, next(n for n in fitting if scores[n] <= least + _CLEARLY / 2)


def _are_doubles(words: NDArray[np.uint32], num_huge_lower: int) -> bool:
    """Whether two words each are a double: the lower one is noise, or zero where floats end."""
    lower, upper = words[::2], words[1::2]
    num_coarse = len(lower) - np.count_nonzero(lower & 0x1FFFFFFF)
    is_coarse = num_coarse > 0.9 * len(lower) and (upper & 0x1FFFFFFF).any()
    if not is_coarse and num_huge_lower <= 0.005 * len(lower):
        return False
    exponents = (upper >> 20) & 0x7FF
    return bool(((exponents <= 1023 + 63) | (exponents == 0x7FF)).mean() > 0.99)


def _are_wild(words: NDArray[np.uint32], exponents: NDArray[np.uint32], num_huge: int) -> bool:
    """Whether too many floats are no coordinates, intensities or times."""
    num_tiny = np.count_nonzero(exponents < _TINY)
    if num_tiny > 0.35 * len(words):
        num_tiny -= len(words) - np.count_nonzero(words & ~_SIGN)  # zeros are none
    return bool(num_tiny > 0.35 * len(words) or num_huge > 0.05 * len(words))


def _mean_log_variances(values: NDArray, numbers: tuple[int, ...]) -> dict[int, float]:
    """How much the columns vary, for each number of columns; infinite without finite values."""
    column_of, mean_of = _columns_of(numbers)
    parts = np.empty((3, len(values)))
    parts[0], parts[1] = 1.0, values
    all_finite = math.isfinite(parts[1] @ parts[1])
    if not all_finite:
        parts[0] = np.isfinite(values)
        parts[1, parts[0] == 0] = 0.0
    np.square(parts[1], out=parts[2])
    cycles = parts.reshape(3, -1, len(column_of))
    count, total, squares = (np.ones(cycles.shape[1]) @ cycles) @ column_of
    known = count if all_finite else np.maximum(count, 1.0)
    logs = np.log(np.maximum(squares / known - (total / known) ** 2, 0.0) + 1e-6)
    means = logs @ mean_of
    if not all_finite:
        means[(count == 0) @ mean_of > 0] = np.inf
    return dict(zip(numbers, means.tolist(), strict=True))


@lru_cache
def _columns_of(numbers: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(cycle, C) which value belongs to which of all columns, and (C, n) the mean of each layout.

    A cycle is a whole number of points in every layout.
    """
    cycle = math.lcm(*numbers)
    column_of = np.hstack([np.tile(np.eye(n), (cycle // n, 1)) for n in numbers])
    layout_of = np.repeat(np.arange(len(numbers)), numbers)
    return column_of, np.eye(len(numbers))[layout_of] / numbers
