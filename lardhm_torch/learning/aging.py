"""Forgetting by age: when clusters were last seen, and removal of those that were not for long."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import feature_sums
from lardhm_torch.learning.clustering import split_labels
from lardhm_torch.learning.map_merging import with_limits
from lardhm_torch.learning.map_state import NEVER, MapState
from lardhm_torch.learning.parameters import AnyMap, MapParameters, read_state, write_rows
from lardhm_torch.learning.state_checks import check_max_age

SEEN = 0.1  # sum of the features of points of its class above which a cluster was seen


def check_time(time: float | None, max_age: float | None = None) -> None:
    """Raise a ValueError if a time stamp is missing or not finite, or max_age is not above 0."""
    if time is not None and not math.isfinite(time):
        raise ValueError(f"time must be finite [s]; got {time}")
    check_max_age(max_age)
    if max_age is not None and time is None:
        raise ValueError(
            f"time must be given: the map forgets what it has not seen for {max_age:g} s"
        )


def timed(
    part: MapState, points: Tensor, labels: Tensor, kernel: Kernel, time: float | None
) -> MapState:
    """The clusters, with the time of those that the points of a scan lie in.

    Args:
        part: M clusters near the scan, new ones among them.
        points: (N, D) [m].
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        kernel: of the map.
        time: of the scan [s]; None: the clusters are returned as they are.
    """
    if time is None or len(part) == 0:
        return part
    index = native.build_index(part.centers, kernel.num_neighbors)
    seen = torch.zeros_like(part.is_occupied)
    for kind, own in enumerate(split_labels(points, labels)):
        if len(own):
            wanted = part.kinds == kind
            sums = feature_sums(own, part.centers, part.raw_scale_tril, wanted, kernel, index)
            seen |= sums > SEEN
    latest = part.times.clamp(min=time)  # scans may come in any order
    return replace(part, times=torch.where(seen, latest, part.times))


def stamped(model: AnyMap, time: float | None) -> AnyMap:
    """The map, with all clusters seen at a time [s]; None: as it was."""
    if time is not None:
        with model.lock.writing():
            model.times.fill_(time)
    return model


def forget_old(model: MapParameters, time: float | None) -> None:
    """Remove the clusters that were last seen more than ``max_age`` before a time [s].

    Clusters of surfaces and of unknown space stay where they limit free space that was seen since.
    Clusters that were learned without a time stamp stay until they are seen with one.
    """
    if model.max_age is None or time is None:
        return
    state = read_state(model)
    old = (state.times != NEVER) & (state.times < time - model.max_age)
    if not bool(old.any()):
        return
    removed = (~with_limits(state, ~old, model.kernel)).nonzero().squeeze(1)
    none = removed[:0]
    write_rows(model, none, state.rows(none), removed, model.channel_layout)
