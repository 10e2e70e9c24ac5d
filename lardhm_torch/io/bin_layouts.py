"""The layout of binary points without a header, recognized by their values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Layout = tuple[str, int]
KITTI: Layout = ("<f4", 4)
NUSCENES: Layout = ("<f4", 5)

_COLUMNS = {"<f4": (4, 3, 5, 6, 7, 8), "<f8": (3, 4, 5, 6)}
_PROBED_BYTES = 3360 * 4  # a whole number of points in every layout
_NUMBERS = (3, 4, 5, 6, 7, 8)  # of columns
_CYCLE = 840  # a whole number of points for all of them
_COLUMN_OF = np.hstack([np.tile(np.eye(n), (_CYCLE // n, 1)) for n in _NUMBERS])
_STARTS = np.cumsum(_NUMBERS, dtype=np.int64) - np.array(_NUMBERS)
_LEAST_POINTS = 30  # with fewer, the number of columns cannot be recognized
_CLEARLY = 0.3  # in mean log variance: another number of columns must fit KITTI's better by this
_MULTIPLE = 1.0  # the same for twice as many columns, which always fit a little better
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
    probe = content[: min(_PROBED_BYTES, len(content) // 8 * 8)]
    words = probe.view("<u4")
    kind = "<f8" if _are_doubles(words) else "<f4"
    size = np.dtype(kind).itemsize
    fitting = [n for n in _COLUMNS[kind] if len(content) and len(content) % (size * n) == 0]
    layout = None
    if kind == "<f8" or not _are_wild(words):
        layout = _layout_of(probe.view(kind), kind, fitting, is_nuscenes)
    if layout is None:
        raise ValueError(
            "points of 16 bytes (float32 x y z intensity) are needed; "
            f"got {len(content)} bytes of another layout. Convert the file to .npz, .pcd or .csv"
        )
    return layout


def _layout_of(values: NDArray, kind: str, fitting: list[int], is_nuscenes: bool) -> Layout | None:
    """The layout among numbers of columns that fit the size of the file; None if it is not clear."""
    is_kitti_size = kind == "<f4" and 4 in fitting
    if len(values) < 4 * _LEAST_POINTS:
        return KITTI if is_kitti_size else None
    all_scores = _mean_log_variances(values.astype(np.float64))
    scores = {n: all_scores[n] + _MULTIPLE * (n % 2 == 0 and n // 2 in fitting) for n in fitting}
    least = min(scores.values(), default=np.inf)
    if not np.isfinite(least):
        return KITTI if is_kitti_size else None  # no point is finite
    if is_nuscenes and kind == "<f4" and scores.get(5, np.inf) < least + _CLEARLY:
        return NUSCENES
    if is_kitti_size and scores[4] <= least + _CLEARLY:
        is_negative = values.reshape(-1, 4)[:, 3] < 0
        if scores.get(3, np.inf) < scores[4] + _CLEARLY and is_negative.any():
            raise ValueError(
                "it may have three columns (x y z) or four of float32: a fourth one would have the "
                "values of coordinates. Convert the file to .npz, .pcd or .csv"
            )
        return KITTI
    # Coordinates alone fit several layouts: the first one is taken.
    return kind, next(n for n in fitting if scores[n] <= least + _CLEARLY / 2)


def _are_doubles(words: NDArray[np.uint32]) -> bool:
    """Whether two words each are a double: the lower one is noise, or zero where floats end."""
    lower, upper = words[::2], words[1::2]
    num_coarse = len(lower) - np.count_nonzero(lower & 0x1FFFFFFF)
    is_coarse = num_coarse > 0.9 * len(lower) and (upper & 0x1FFFFFFF).any()
    if not is_coarse and _num_huge(lower) <= 0.005 * len(lower):
        return False
    exponents = (upper >> 20) & 0x7FF
    return bool(((exponents <= 1023 + 63) | (exponents == 0x7FF)).mean() > 0.99)


def _num_huge(words: NDArray[np.uint32]) -> int:
    """How many floats are beyond 10^19, yet finite."""
    exponents = words & _EXPONENT
    return int(np.count_nonzero((exponents > _HUGE) & (exponents < _EXPONENT)))


def _are_wild(words: NDArray[np.uint32]) -> bool:
    """Whether too many floats are no coordinates, intensities or times."""
    num_tiny = np.count_nonzero((words & _EXPONENT) < _TINY)
    num_tiny -= len(words) - np.count_nonzero(words & ~_SIGN)  # zeros are none
    return bool(num_tiny > 0.35 * len(words) or _num_huge(words) > 0.05 * len(words))


def _mean_log_variances(values: NDArray[np.float64]) -> dict[int, float]:
    """How much the columns vary, for each number of columns; infinite without finite values."""
    padded = np.full(-(-len(values) // _CYCLE) * _CYCLE, np.nan)
    padded[: len(values)] = values
    is_finite = np.isfinite(padded)
    padded[~is_finite] = 0.0
    sums = [part.reshape(-1, _CYCLE).sum(axis=0) for part in (is_finite, padded, padded**2)]
    count, total, squares = np.array(sums) @ _COLUMN_OF
    known = np.maximum(count, 1.0)
    variances = np.maximum(squares / known - (total / known) ** 2, 0.0)
    logs = np.log(variances + 1e-6)
    logs[count == 0] = np.inf
    means = np.add.reduceat(logs, _STARTS) / _NUMBERS
    return dict(zip(_NUMBERS, means.tolist(), strict=True))
