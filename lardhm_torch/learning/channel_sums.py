"""Channels of a map: what its occupied clusters sum up of the colors, values and classes of the hits.

The statistics of a cluster are sufficient for means and class frequencies, and they add up: those of
merged clusters are the sums of theirs. All channels of a map are columns of one (M, W) float64 tensor:

- a channel of C values has C sums and the number of hits that were not missing;
- classes have one count for each class, a sum of probabilities where labels are probabilities.

A layout names the columns: ``{"color": 3, "intensity": 0, "class": [7, 2]}`` are 4 columns of color,
2 of intensity (0: values without a second dimension) and the counts of classes 7 and 2. It holds
plain values, and is stored with the map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.channels import CLASS, MOST_CLASSES, Channels, missing, select_channels
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.maps import TensorLike
from lardhm_torch.points import UNKNOWN, as_tensor, inliers, to_map_frame

Layout: TypeAlias = dict[str, Any]  # number of values by name; of classes, the list of their numbers
MOST_COLUMNS = 1024  # class numbers in one map; more are identifiers of objects, not classes


def layout_of(channels: Channels) -> Layout:
    """The layout of the channels of some points."""
    layout: Layout = {}
    for name, values in channels.items():
        if name != CLASS:
            layout[name] = values.shape[1] if values.ndim == 2 else 0
        elif values.is_floating_point():
            layout[name] = list(range(values.shape[1]))
        else:
            layout[name] = torch.bincount(values + 1)[1:].nonzero().squeeze(1).tolist()
    return layout


def joint_layout(first: Layout, second: Layout) -> Layout:
    """The channels and classes of the first layout, then those that only the second has.

    Raises:
        ValueError: a channel has different numbers of values, or there are too many classes.
    """
    joint = {**second, **first}
    for name in first.keys() & second.keys() - {CLASS}:
        if first[name] != second[name]:
            raise ValueError(
                f"channel {name!r} must have {first[name]} values as in the map; got {second[name]}"
            )
    if CLASS in first and CLASS in second:
        joint[CLASS] = list(dict.fromkeys([*first[CLASS], *second[CLASS]]))
    if len(joint.get(CLASS, ())) > MOST_COLUMNS:
        raise ValueError(
            f"a map must have at most {MOST_COLUMNS} classes; got {len(joint[CLASS])}. Numbers of "
            "objects are not classes"
        )
    return {name: joint[name] for name in dict.fromkeys([*first, *second])}


def columns_of(layout: Layout) -> dict[str, slice]:
    """The columns of each channel."""
    found, start = {}, 0
    for name, size in layout.items():
        width = len(size) if name == CLASS else max(1, size) + 1
        found[name] = slice(start, start + width)
        start += width
    return found


def num_columns(layout: Layout) -> int:
    """Number of columns W of a layout."""
    return max((columns.stop for columns in columns_of(layout).values()), default=0)


def check_layout(value: Any) -> Layout:
    """A layout that was read from a file.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"channels must be a layout by name; got {value!r}")
    for name, size in value.items():
        sizes = size if name == CLASS and isinstance(size, list) else [size]
        whole = all(isinstance(n, int) and not isinstance(n, bool) for n in sizes)
        if not whole or not all(0 <= n < MOST_CLASSES for n in sizes):
            raise ValueError(f"channels must have a number of values each; {name!r} has {size!r}")
        if name == CLASS and (not isinstance(size, list) or len(set(size)) != len(size)):
            raise ValueError(f"channels must list different classes; got {size!r}")
    return dict(value)


def conformed(sums: Tensor, before: Layout, after: Layout) -> Tensor:
    """(M, W) sums in another layout that has all channels and classes of theirs; others are 0."""
    if before == after:
        return sums
    result = sums.new_zeros(len(sums), num_columns(after))
    old, new = columns_of(before), columns_of(after)
    for name, columns in old.items():
        width = columns.stop - columns.start  # joint layouts append classes: theirs come first
        result[:, new[name].start : new[name].start + width] = sums[:, columns]
    return result


def sum_channels(channels: Channels, layout: Layout, owners: Tensor, num_clusters: int) -> Tensor:
    """(M, W) sums of the values of points over clusters, float64; missing values are left out.

    Args:
        channels: values of N points.
        layout: of the result; it has all of these channels and classes.
        owners: (N,) cluster of each point.
        num_clusters: M.
    """
    sums = torch.zeros(
        num_clusters, num_columns(layout), dtype=torch.float64, device=owners.device
    )
    for name, columns in columns_of(layout).items():
        if name not in channels:
            continue
        present = (~missing(channels[name])).nonzero().squeeze(1)
        values, rows = channels[name].index_select(0, present), owners.index_select(0, present)
        if name == CLASS:
            sums[:, columns] = _class_counts(values, layout[CLASS], rows, num_clusters)
            continue
        values = values.double().reshape(len(rows), -1)
        values = torch.cat([values, values.new_ones(len(rows), 1)], dim=1)
        sums[:, columns] = values.new_zeros(num_clusters, values.shape[1]).index_add_(
            0, rows, values
        )
    return sums


def column_of_class(classes: list[int], device: torch.device) -> Tensor:
    """(max(classes) + 1,) column of each class number; -1 for those that are not there."""
    place = torch.full((max(classes, default=-1) + 1,), -1, device=device)
    numbers = torch.tensor(classes, dtype=torch.long, device=device)
    return place.index_copy_(0, numbers, torch.arange(len(classes), device=device))


def _class_counts(values: Tensor, classes: list[int], rows: Tensor, num_clusters: int) -> Tensor:
    """(M, K) counts of the classes, or sums of their probabilities."""
    place = column_of_class(classes, rows.device)
    counts = torch.zeros(num_clusters, len(classes), dtype=torch.float64, device=rows.device)
    if values.is_floating_point():
        own = place[: values.shape[1]]
        found = counts.new_zeros(num_clusters, values.shape[1]).index_add_(0, rows, values.double())
        return counts.index_add_(1, own, found)
    keys = rows * len(classes) + place[values]
    return torch.bincount(keys, minlength=counts.numel()).reshape(counts.shape).double()


class Hits(NamedTuple):
    """(H, D) occupied points with a value in any channel, map frame [m], and their channels."""

    points: Tensor
    channels: Channels


def hits_with_channels(points: Tensor, labels: Tensor, channels: Channels) -> Hits:
    """The occupied ones of N points that have a value in any channel.

    Args:
        points: (N, D) positions [m].
        labels: (N,) 1 occupied.
        channels: values of all points.
    """
    wanted = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for values in channels.values():
        wanted |= ~missing(values)
    rows = (wanted & (labels > UNKNOWN)).nonzero().squeeze(1)
    return Hits(points.index_select(0, rows), select_channels(channels, rows))


def with_layout(
    state: MapState, before: Layout, after: Layout, is_trained: bool | None = None
) -> MapState:
    """Clusters whose channels have a layout, in one that continues it; added columns are 0.

    They have class weights in the end if ``is_trained``; None: if they have them now.
    """
    if is_trained is None:
        is_trained = state.class_weights.shape[1] > 0
    classes = len(after.get(CLASS, ())) if is_trained else 0
    missing = classes - state.class_weights.shape[1]
    if before == after and not missing:
        return state
    return replace(
        state,
        channel_sums=conformed(state.channel_sums, before, after),
        class_weights=torch.nn.functional.pad(state.class_weights, (0, missing)),
    )


def with_hits(state: MapState, layout: Layout, hits: Hits) -> MapState:
    """The clusters with the values of more hits, each added to the occupied cluster of nearest mean.

    Args:
        state: M clusters, whose channels have this layout.
        layout: it has all channels and classes of the hits.
        hits: of which there may be none.
    """
    rows = state.is_occupied.nonzero().squeeze(1)
    if len(rows) == 0 or len(hits.points) == 0:
        return state
    owners = native.nearest_centers(hits.points, state.means[rows], 1).squeeze(1)
    found = sum_channels(hits.channels, layout, owners, len(rows))
    return replace(state, channel_sums=state.channel_sums.index_add(0, rows, found))


def fitted(
    state: MapState, channels: Channels, points: TensorLike, labels: TensorLike, origin: Tensor
) -> tuple[MapState, Layout]:
    """Clusters of a new map with the channels of the N points that they were fitted to, and a layout.

    Args:
        state: M clusters without channels.
        channels: values of the points, checked.
        points: (N, D) world positions [m]; outliers are left out, as in `points.training_points`.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        origin: (D,) float64 origin of the map [m].
    """
    if not channels:
        return state, {}
    device = origin.device
    points, labels = as_tensor(points, "points", device), as_tensor(labels, "labels", device)
    labels = torch.where(inliers(points), labels, 0 * labels)
    hits = hits_with_channels(points, labels, channels)
    hits = hits._replace(points=to_map_frame(hits.points, origin, state.means.dtype))
    layout = layout_of(hits.channels)
    return with_hits(with_layout(state, {}, layout), layout, hits), layout


def handed_over(state: MapState, alive: Tensor) -> MapState:
    """The clusters after those that are not alive gave their sums to the nearest living occupied one.

    Args:
        state: M clusters.
        alive: (M,) bool; the others will be removed.
    """
    if state.channel_sums.shape[1] == 0:
        return state
    dying = (~alive & (state.channel_sums != 0).any(dim=1)).nonzero().squeeze(1)
    heirs = (alive & state.is_occupied).nonzero().squeeze(1)
    if len(dying) == 0 or len(heirs) == 0:
        return state
    nearest = native.nearest_centers(state.means[dying], state.means[heirs], 1).squeeze(1)
    sums = state.channel_sums.index_add(0, heirs[nearest], state.channel_sums[dying])
    return replace(state, channel_sums=sums.index_fill(0, dying, 0))

