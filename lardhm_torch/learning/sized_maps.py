"""Maps whose packed file has at most a given size."""

from __future__ import annotations

from collections.abc import Callable

from lardhm_torch.learning.channel_sums import Layout
from lardhm_torch.learning.fitting import FitConfig, FitTask, fit_clusters
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.packing import packed_bytes
from lardhm_torch.learning.parameters import MapParameters, write_state
from lardhm_torch.learning.points import TrainingPoints
from lardhm_torch.learning.scene_clusters import fit_shapes, is_learnable

SMALL = FitConfig(shape_passes=4)  # of maps with few clusters
HEADER_BYTES, CLUSTER_BYTES = 140, 14  # of a packed file in 3-D, about
SMALLEST = 256  # bytes that can be asked for: a few clusters
FULL = 0.95  # a file of so much of the size is large enough
CAUTION = 0.98  # of the next attempt: bytes per cluster vary by a few percent
ATTEMPTS = 6


def fit_size(
    samples: TrainingPoints,
    max_bytes: int,
    task: FitTask,
    finish: Callable[..., tuple[MapState, Layout]],
    draft: MapParameters,
) -> MapState:
    """The map with the most clusters whose packed file has at most ``max_bytes``.

    The number of clusters is found in a few attempts. It is limited by the number of points, so the
    file may be much smaller.

    Args:
        samples: points in the map's frame, in Morton order.
        max_bytes: size of the file.
        task: kernel, settings, random generator.
        finish: function of a state and ``origin`` that adds the channels.
        draft: a map with these settings, which is overwritten to measure its size.

    Raises:
        ValueError: max_bytes is too small.
    """
    check_size(max_bytes)
    count, most = (max_bytes - HEADER_BYTES) // CLUSTER_BYTES, len(samples.points)
    best: MapState | None = None
    for _ in range(ATTEMPTS):
        state = _fitted(samples, count, task)
        complete, layout = finish(state, origin=samples.origin)
        write_state(draft, complete, samples.origin, layout)
        size = len(packed_bytes(draft))
        gains = best is None or len(state) > len(best)
        if size <= max_bytes and gains:
            best = state
        if best is not None and (size >= FULL * max_bytes or not gains) and size <= max_bytes:
            break
        ratio = CAUTION * (max_bytes - HEADER_BYTES) / max(1, size - HEADER_BYTES)
        count = max(1, min(int(count * ratio), most))
    if best is None:
        raise ValueError(f"max_bytes must be larger for this map; {max_bytes} are too few")
    return best


def check_size(max_bytes: int) -> None:
    """Raise a ValueError if no map can have this size."""
    whole = isinstance(max_bytes, int) and not isinstance(max_bytes, bool)
    if not whole or max_bytes < SMALLEST:
        raise ValueError(
            f"max_bytes must be a whole number of bytes, at least {SMALLEST}; got {max_bytes!r}"
        )


def _fitted(samples: TrainingPoints, count: int, task: FitTask) -> MapState:
    fit = fit_shapes if is_learnable(samples.labels, task) else fit_clusters
    return fit(samples.points, samples.labels, count, task)
