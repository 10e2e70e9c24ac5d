"""Interpolation of the channels of a map: means of values, and posteriors of classes.

Let phi_m(x) be the features of a point, n_m the number of hits of cluster m with a value, S_m the sum of
their values and G_m its gradient: n_m times the slope of the linear regression of the values on the
positions of the hits, around their mean position z_m. The mean of the channel is

    sum_m phi_m(x)^4 (S_m + G_m (x - z_m)) / sum_m phi_m(x)^4 n_m.

With the default covariance scale of 4, phi_m^4 is the Gaussian of the points of the cluster. Free and
unknown clusters have no hits. For classes, the same sums of the counts give c_k(x), their weighted mean
over clusters, no less than 0, and the posterior

    (c_k(x) + PRIOR / K) / (sum_k c_k(x) + PRIOR)

of a Dirichlet prior of weight PRIOR, which is all that is left far from the clusters. Its logarithm is
multiplied by the ``class_scale`` of the map, which is 1 until `LardHilbertMap.calibrate_classes`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.channels import CLASS, COLOR
from lardhm_torch.learning.channel_sums import Layout, rows_of
from lardhm_torch.learning.map_tensors import MapTensors
from lardhm_torch.maps import TensorLike

PRIOR = 1.0  # weight of the uniform prior of the classes, in hits
RIDGE = 2e-3  # [m] of the regressions: positions are not known better
NEAR = 1e-6  # sum of the features of occupied clusters below which nothing is near


class ChannelSums(NamedTuple):
    """Statistics of a channel in M clusters.

    Args:
        sums: (M, C) sums of the values of the hits; of classes, the counts of the K classes.
        counts: (M,) number of hits with a value.
        classes: numbers of the K classes; empty for other channels.
    """

    sums: Tensor
    counts: Tensor
    classes: tuple[int, ...] = ()


def channel_sums_of(model: MapTensors) -> dict[str, ChannelSums]:
    """The channels of a map by name."""
    found, sums = {}, model.channel_sums
    if sums is None:
        return {}
    for name, rows in rows_of(model.channel_layout, model.dim).items():
        own = sums[:, rows, 0]
        if name == CLASS:
            found[name] = ChannelSums(own, own.sum(dim=1), tuple(model.channel_layout[CLASS]))
        else:
            found[name] = ChannelSums(own[:, :-1], own[:, -1])
    return found


def interpolate(model: MapTensors, points: TensorLike, name: str) -> Tensor:
    """`MapQueries.channel`."""
    if name == CLASS:
        return class_probability(model, points)
    local = model._to_map_frame(points)
    mixed = _mixture(model, local, _table(model, name), sharp=True)
    total = mixed[:, -1:]
    answer = mixed[:, :-1] / total.where(total > NEAR**4, torch.nan)
    if name == COLOR:
        answer = answer.clamp(0, 1)
    if model.channel_layout[name] == 0:
        return answer[:, 0].reshape(local.shape[:-1])
    return answer.reshape(*local.shape[:-1], answer.shape[1])


def class_log_odds(model: MapTensors, points: TensorLike) -> Tensor:
    """`MapQueries.class_log_odds`."""
    local = model._to_map_frame(points)
    answer = model.class_scale * _class_counts(model, local).log()
    if model.class_weights is not None:
        answer = answer + _mixture(model, local, model.class_weights[:, :, None], sharp=False)
    return answer.reshape(*local.shape[:-1], answer.shape[1])


def class_probability(model: MapTensors, points: TensorLike) -> Tensor:
    """`MapQueries.class_probability`: the softmax of the log-odds, without logarithms if possible."""
    if model.class_weights is not None or model.class_scale != 1:
        return torch.softmax(class_log_odds(model, points), dim=-1)
    local = model._to_map_frame(points)
    counts = _class_counts(model, local)
    answer = counts / counts.sum(dim=1, keepdim=True)
    return answer.reshape(*local.shape[:-1], answer.shape[1])


def _class_counts(model: MapTensors, local: Tensor) -> Tensor:
    """(..., D) positions, map frame -> (N, K) class counts around them, with the prior."""
    mixed = _mixture(model, local, _table(model, CLASS), sharp=True)
    classes = mixed.shape[1] - 1
    counts = mixed[:, :-1].clamp(min=0) / (mixed[:, -1:] + NEAR**4)
    return counts + PRIOR / classes


def prior_log_odds(num_classes: int, class_scale: float) -> Tensor:
    """(K,) `class_log_odds` far from all clusters."""
    value = class_scale * math.log(PRIOR / num_classes)
    return torch.full((num_classes,), value, dtype=torch.float64)


def joint_posterior(occupied: Tensor, classes: Tensor) -> Tensor:
    """(...) probability of occupancy, (..., K) of the classes -> (..., K + 1) free, or each class."""
    occupied = occupied[..., None]
    return torch.cat([1 - occupied, occupied * classes], dim=-1)


def layout_entry(layout: Layout, name: str) -> Any:
    """What a layout says of a channel.

    Raises:
        ValueError: it has no such channel.
    """
    if name not in layout:
        raise ValueError(
            f"the map must have the channel {name!r}; it has {', '.join(layout) or 'none'}. "
            "Give channels to fit or update"
        )
    return layout[name]


class Regression(NamedTuple):
    """Affine functions of a channel in the S clusters with hits, and the tensor that they were made of.

    Args:
        sums: the channel sums, to recognize a change.
        version: of these.
        rows: (S,) the clusters.
        middle: (S, D) mean position of the hits with a value, map frame [m].
        values: (S, C, 1) sums of the values of these hits; see `_table` for the last row.
        slopes: (S, C, D) gradients of the sums [1/m].
    """

    sums: Tensor
    version: int
    rows: Tensor
    middle: Tensor
    values: Tensor
    slopes: Tensor


def _table(model: MapTensors, name: str) -> Tensor:
    """(M, C, 1 + D) sums and gradients of a channel at the centers, with what divides them in the end.

    That is the number of hits with a value, or, for classes, 1 where there are any.
    """
    found = _regression(model, name)
    center = model.centers.detach()[found.rows].double() - found.middle
    values = found.values + (found.slopes * center[:, None]).sum(dim=2, keepdim=True)
    functions = torch.cat([values, found.slopes], dim=2)
    return functions.new_zeros(len(model), *functions.shape[1:]).index_copy(
        0, found.rows, functions
    )


def affine_functions(model: MapTensors, name: str, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Regressions of a channel in the S occupied clusters, on the CPU.

    Args:
        model: a map with the channel.
        name: of the channel; for "class", the values are the fractions of the classes.
        places: (S, D) positions, map frame [m].

    Returns:
        (S,) number of hits with a value, (S, C) values at the places, (S, C, D) gradients [1/m].
    """
    found = _regression(model, name)
    values, slopes = found.values[:, :-1, 0], found.slopes[:, :-1]
    counts = values.sum(dim=1) if name == CLASS else found.values[:, -1, 0]
    each = counts.clamp(min=1e-12)[:, None]
    rows = (torch.cumsum(model.is_occupied, 0) - 1)[found.rows]
    slopes = slopes / each[..., None]
    offsets = places.to(found.middle)[rows] - found.middle
    values = values / each + (slopes * offsets[:, None]).sum(dim=2)
    size = len(places)
    return (
        counts.new_zeros(size).index_copy(0, rows, counts).cpu(),
        values.new_zeros(size, values.shape[1]).index_copy(0, rows, values).cpu(),
        slopes.new_zeros(size, *slopes.shape[1:]).index_copy(0, rows, slopes).cpu(),
    )


def _regression(model: MapTensors, name: str) -> Regression:
    """The affine functions of a channel; they are kept until the channel sums change."""
    layout_entry(model.channel_layout, name)
    sums = model.channel_sums
    assert sums is not None  # as the map has a layout
    if torch.compiler.is_compiling() or native.transformed() or sums.is_inference():
        return _new_regression(model, sums, name, 0)
    known = model._regressions.get(name)
    if known is None or known.sums is not sums or known.version != sums._version:
        known = _new_regression(model, sums, name, sums._version)
        others = {n: r for n, r in model._regressions.items() if r.sums is sums}
        model._regressions = {**others, name: known}
    return known


def _new_regression(model: MapTensors, sums: Tensor, name: str, version: int) -> Regression:
    """Linear regression of a channel on the positions of the hits, in each cluster that has any."""
    dim = model.dim
    rows = rows_of(model.channel_layout, dim)[name]
    if torch.compiler.is_compiling():  # without shapes that depend on the values
        seen = torch.arange(len(sums), device=sums.device)
    else:
        seen = (sums[:, dim, 0] > 0).nonzero().squeeze(1)
    own = sums[seen]
    channel, position = own[:, rows], own[:, : dim + 1]
    ones = channel.sum(dim=1) if name == CLASS else channel[:, -1]
    counts = ones[:, :1].clamp(min=1e-12)
    middle = ones[:, 1:] / counts  # (S, D) mean position of the hits with a value
    covariance, number = _covariances(position)
    ridge = RIDGE**2 + covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1) / number
    covariance = covariance + torch.diag_embed(ridge[:, None].expand_as(middle))
    products = channel[:, :, 1:] - channel[:, :, :1] * middle[:, None]
    slopes = torch.cholesky_solve(products.mT, torch.linalg.cholesky(covariance)).mT
    values = channel[:, :, :1]
    if name == CLASS:
        known = (ones[:, :1, None] > 0).to(values)
        values, slopes = (
            torch.cat([values, known], 1),
            torch.nn.functional.pad(slopes, (0, 0, 0, 1)),
        )
    else:
        slopes = torch.cat([slopes[:, :-1], torch.zeros_like(slopes[:, :1])], dim=1)
    return Regression(sums, version, seen, middle, values, slopes)


def _covariances(position: Tensor) -> tuple[Tensor, Tensor]:
    """(S, D + 1, 1 + D) first rows of the sums -> (S, D, D) covariances [m^2], (S,) numbers of hits."""
    number = position[:, -1, 0].clamp(min=1e-12)
    mean = position[:, -1, 1:] / number[:, None]
    second = position[:, :-1, 1:] / number[:, None, None]
    covariance = second - mean[:, :, None] * mean[:, None, :]
    return (covariance + covariance.mT) / 2, number


def _mixture(model: MapTensors, local: Tensor, table: Tensor, *, sharp: bool) -> Tensor:
    """(..., D) positions, map frame, and a table -> (N, C), see `features.mixture`."""
    centers, raw_scale_tril, _, kernel = model._tensors()
    table = table.to(centers.dtype)
    flat, index = local.reshape(-1, model.dim), model._fresh_index()
    return native.mixture(flat, centers, raw_scale_tril, table, kernel, index, sharp=sharp)
