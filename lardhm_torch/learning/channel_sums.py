"""Channels of a map: what its occupied clusters sum up of the colors, values and classes of the hits.

Every hit adds the products of its values v with (1, x) to its cluster, where x is its position in the
map frame: the sums of v and their first moments. They are sufficient for the mean of a channel and its
linear trend in a cluster, and they add up: those of merged clusters are the sums of theirs. All are rows
of one (M, R, 1 + D) float64 tensor:

- first D + 1 rows for the values x_1 to x_D and 1 of all hits with any channel: their number, and the
  first and second moments of their positions;
- a channel of C values has C rows, and one for the value 1 of the hits where it is not missing;
- classes have one row for each class, for its probability: 1 or 0 where labels are numbers.

A layout names the rows: ``{"color": 3, "intensity": 0, "class": [7, 2]}`` are 4 rows of color, 2 of
intensity (0: values without a second dimension) and those of classes 7 and 2. It holds plain values,
and is stored with the map.
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
from lardhm_torch.learning.points import as_tensor, inliers, to_map_frame
from lardhm_torch.maps import TensorLike
from lardhm_torch.sampling import UNKNOWN

# Number of values by name; of classes, the list of their numbers.
Layout: TypeAlias = dict[str, Any]
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


def rows_of(layout: Layout, dim: int) -> dict[str, slice]:
    """The rows of each channel in a map of D = ``dim`` coordinates."""
    found, start = {}, dim + 1
    for name, size in layout.items():
        width = len(size) if name == CLASS else max(1, size) + 1
        found[name] = slice(start, start + width)
        start += width
    return found


def num_rows(layout: Layout, dim: int) -> int:
    """Number of rows R of a layout."""
    return max((rows.stop for rows in rows_of(layout, dim).values()), default=0)


def no_sums(like: Tensor, layout: Layout) -> Tensor:
    """(M, R, 1 + D) zeros for (M, D) centers."""
    count, dim = like.shape
    return like.new_zeros(count, num_rows(layout, dim), 1 + dim, dtype=torch.float64)


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
    """(M, R, 1 + D) sums in another layout that has all channels and classes of theirs; others are 0."""
    if before == after:
        return sums
    dim = sums.shape[2] - 1
    result = sums.new_zeros(len(sums), num_rows(after, dim), 1 + dim)
    if before:
        result[:, : dim + 1] = sums[:, : dim + 1]
    new = rows_of(after, dim)
    for name, rows in rows_of(before, dim).items():
        if name == CLASS:
            result[:, new[name]] = conformed_classes(sums[:, rows].mT, before, after).mT
        else:
            result[:, new[name]] = sums[:, rows]
    return result


def conformed_classes(values: Tensor, before: Layout, after: Layout) -> Tensor:
    """(..., K) values of the classes of a layout -> (..., L) of those of another, added ones are 0."""
    known, wanted = before.get(CLASS, []), after.get(CLASS, [])
    columns = column_of_class(wanted, values.device)[known]
    result = values.new_zeros(*values.shape[:-1], len(wanted))
    return result.index_copy(-1, columns, values)


def sum_channels(hits: Hits, layout: Layout, owners: Tensor, num_clusters: int) -> Tensor:
    """(M, R, 1 + D) sums over the hits of each cluster; missing values are left out.

    Args:
        hits: H points and their channels.
        layout: of the result; it has all channels and classes of the hits.
        owners: (H,) cluster of each hit.
        num_clusters: M.
    """
    dim = hits.points.shape[1]
    ones = hits.points.new_ones(len(owners), 1, dtype=torch.float64)
    moments = torch.cat([ones, hits.points.double()], dim=1)
    sums = moments.new_zeros(num_clusters, num_rows(layout, dim), 1 + dim)
    sums[:, : dim + 1] = _moments(moments.roll(-1, dims=1), moments, owners, num_clusters)
    for name, rows in rows_of(layout, dim).items():
        if name not in hits.channels:
            continue
        present = (~missing(hits.channels[name])).nonzero().squeeze(1)
        values = hits.channels[name].index_select(0, present)
        own, around = owners.index_select(0, present), moments.index_select(0, present)
        if name == CLASS and not values.is_floating_point():
            sums[:, rows] = _class_moments(values, layout[CLASS], around, own, num_clusters)
            continue
        values = values.double().reshape(len(own), -1)
        if name == CLASS:
            columns = column_of_class(layout[CLASS], own.device)[: values.shape[1]]
            values = values.new_zeros(len(own), len(layout[CLASS])).index_copy(1, columns, values)
        else:
            values = torch.cat([values, ones[: len(own)]], dim=1)
        sums[:, rows] = _moments(values, around, own, num_clusters)
    return sums


def _moments(values: Tensor, moments: Tensor, owners: Tensor, num_clusters: int) -> Tensor:
    """(H, C) values and (H, 1 + D) moments -> (M, C, 1 + D) sums of their products."""
    products = values[:, :, None] * moments[:, None]
    shape = (num_clusters, *products.shape[1:])
    return products.new_zeros(shape).index_add_(0, owners, products)


def column_of_class(classes: list[int], device: torch.device) -> Tensor:
    """(max(classes) + 1,) column of each class number; -1 for those that are not there."""
    place = torch.full((max(classes, default=-1) + 1,), -1, device=device)
    numbers = torch.tensor(classes, dtype=torch.long, device=device)
    return place.index_copy_(0, numbers, torch.arange(len(classes), device=device))


def _class_moments(
    values: Tensor, classes: list[int], moments: Tensor, owners: Tensor, num_clusters: int
) -> Tensor:
    """(M, K, 1 + D) sums of the moments of the hits of each class number."""
    keys = owners * len(classes) + column_of_class(classes, owners.device)[values]
    sums = moments.new_zeros(num_clusters * len(classes), moments.shape[1])
    return sums.index_add_(0, keys, moments).reshape(num_clusters, len(classes), -1)


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
    weights = state.class_weights
    if before == after and (weights.shape[1] > 0) == is_trained:
        return state
    if not is_trained or CLASS not in after:
        weights = weights[:, :0]
    elif weights.shape[1] == 0:
        weights = weights.new_zeros(len(state), len(after[CLASS]))
    else:
        weights = conformed_classes(weights, before, after)
    sums = conformed(state.channel_sums, before, after)
    return replace(state, channel_sums=sums, class_weights=weights)


def with_layout_of(hits: Hits, state: MapState, before: Layout) -> tuple[MapState, Layout]:
    """Clusters in a layout that also has the channels of the hits, and that layout."""
    layout = joint_layout(before, layout_of(hits.channels))
    return with_layout(state, before, layout), layout


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
    found = sum_channels(hits, layout, owners, len(rows))
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
    hits = hits_with_channels(points, labels, channels)
    kept = inliers(hits.points, among=points)
    if not bool(kept.all()):
        hits = Hits(hits.points[kept], select_channels(hits.channels, kept))
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
    dying = (~alive & (state.channel_sums != 0).flatten(1).any(dim=1)).nonzero().squeeze(1)
    heirs = (alive & state.is_occupied).nonzero().squeeze(1)
    if len(dying) == 0 or len(heirs) == 0:
        return state
    nearest = native.nearest_centers(state.means[dying], state.means[heirs], 1).squeeze(1)
    sums = state.channel_sums.index_add(0, heirs[nearest], state.channel_sums[dying])
    return replace(state, channel_sums=sums.index_fill(0, dying, 0))


def moved_sums(sums: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """(M, R, 1 + D) sums after the positions x became rotation x + shift."""
    if sums.shape[1] == 0:
        return sums
    dim = sums.shape[2] - 1
    transform = torch.eye(dim + 1, dtype=sums.dtype, device=sums.device)  # of (1, x)
    transform[1:, 0], transform[1:, 1:] = shift, rotation
    moved = sums @ transform.T
    positions = transform.roll((-1, -1), dims=(0, 1))  # of the values (x, 1) of the first rows
    moved[:, : dim + 1] = positions @ moved[:, : dim + 1]
    return moved
