"""Interpolation of the channels of a map: means of values, and posteriors of classes.

Let phi_m(x) be the features of a point, S_m the sums of a channel and n_m the number of its hits in
cluster m. The mean of the channel is

    sum_m phi_m(x)^4 S_m / sum_m phi_m(x)^4 n_m.

With the default covariance scale of 4, phi_m^4 is the Gaussian of the points of the cluster. Free and
unknown clusters have no hits. For classes, the same average of the counts n_mk gives the posterior

    (c_k(x) + PRIOR / K) / (sum_k c_k(x) + PRIOR),  c_k(x) = sum_m phi_m(x)^4 n_mk / sum_m phi_m(x)^4,

of a Dirichlet prior of weight PRIOR, which is all that is left far from the clusters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.channels import CLASS
from lardhm_torch.learning.channel_sums import columns_of
from lardhm_torch.maps import TensorLike

if TYPE_CHECKING:
    from lardhm_torch.map_queries import MapQueries

PRIOR = 1.0  # weight of the uniform prior of the classes, in hits
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


def channel_sums_of(model: MapQueries) -> dict[str, ChannelSums]:
    """The channels of a map by name."""
    found, sums = {}, model.channel_sums
    if sums is None:
        return {}
    for name, columns in columns_of(model.channel_layout).items():
        own = sums[:, columns]
        if name == CLASS:
            found[name] = ChannelSums(own, own.sum(dim=1), tuple(model.channel_layout[CLASS]))
        else:
            found[name] = ChannelSums(own[:, :-1], own[:, -1])
    return found


def interpolate(model: MapQueries, points: TensorLike, name: str) -> Tensor:
    """`MapQueries.channel`."""
    if name == CLASS:
        return model.class_probability(points)
    own = _channel(model, name)
    local = model._to_map_frame(points)
    table = torch.cat([own.sums, own.counts[:, None]], dim=1)
    mixed = _mixture(model, local, table, sharp=True)
    total = mixed[:, -1:]
    answer = mixed[:, :-1] / total.where(total > NEAR**4, torch.nan)
    if model.channel_layout[name] == 0:
        return answer[:, 0].reshape(local.shape[:-1])
    return answer.reshape(*local.shape[:-1], answer.shape[1])


def class_log_odds(model: MapQueries, points: TensorLike) -> Tensor:
    """`MapQueries.class_log_odds`."""
    own = _channel(model, CLASS)
    local = model._to_map_frame(points)
    classes = own.sums.shape[1]
    table = torch.cat([own.sums, (own.counts > 0)[:, None]], dim=1)
    mixed = _mixture(model, local, table, sharp=True)
    answer = (mixed[:, :-1] / (mixed[:, -1:] + NEAR**4) + PRIOR / classes).log()
    if model.class_weights is not None:
        answer = answer + _mixture(model, local, model.class_weights, sharp=False)
    return answer.reshape(*local.shape[:-1], classes)


def _channel(model: MapQueries, name: str) -> ChannelSums:
    found = channel_sums_of(model)
    if name not in found:
        raise ValueError(
            f"the map must have the channel {name!r}; it has {', '.join(found) or 'none'}. "
            "Give channels to fit or update"
        )
    return found[name]


def _mixture(model: MapQueries, local: Tensor, table: Tensor, *, sharp: bool) -> Tensor:
    """(..., D) positions, map frame -> (N, C), see `features.mixture`."""
    centers, raw_scale_tril, _, kernel = model._tensors()
    table = table.to(centers.dtype)
    flat, index = local.reshape(-1, model.dim), model._fresh_index()
    return native.mixture(flat, centers, raw_scale_tril, table, kernel, index, sharp=sharp)
