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

from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.channels import CLASS, COLOR
from lardhm_torch.learning.channel_sums import rows_of
from lardhm_torch.learning.map_tensors import MapTensors
from lardhm_torch.maps import TensorLike

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
        return torch.softmax(class_log_odds(model, points), dim=-1)
    local = model._to_map_frame(points)
    mixed = _mixture(model, local, _functions(model, name), sharp=True)
    total = mixed[:, -1:]
    answer = mixed[:, :-1] / total.where(total > NEAR**4, torch.nan)
    if name == COLOR:
        answer = answer.clamp(0, 1)
    if model.channel_layout[name] == 0:
        return answer[:, 0].reshape(local.shape[:-1])
    return answer.reshape(*local.shape[:-1], answer.shape[1])


def class_log_odds(model: MapTensors, points: TensorLike) -> Tensor:
    """`MapQueries.class_log_odds`."""
    functions = _functions(model, CLASS)
    local = model._to_map_frame(points)
    classes = functions.shape[1] - 1
    mixed = _mixture(model, local, functions, sharp=True)
    counts = mixed[:, :-1].clamp(min=0) / (mixed[:, -1:] + NEAR**4)
    answer = model.class_scale * (counts + PRIOR / classes).log()
    if model.class_weights is not None:
        answer = answer + _mixture(model, local, model.class_weights[:, :, None], sharp=False)
    return answer.reshape(*local.shape[:-1], classes)


def _functions(model: MapTensors, name: str) -> Tensor:
    """(M, C, 1 + D) sums and gradients of a channel at the centers, with what divides them in the end.

    That is the number of hits with a value, or, for classes, 1 where there are any.
    """
    sums, layout, dim = model.channel_sums, model.channel_layout, model.dim
    if sums is None or name not in layout:
        raise ValueError(
            f"the map must have the channel {name!r}; it has {', '.join(layout) or 'none'}. "
            "Give channels to fit or update"
        )
    rows = rows_of(layout, dim)[name]
    result = sums.new_zeros(len(model), rows.stop - rows.start + (name == CLASS), 1 + dim)
    seen = (sums[:, dim, 0] > 0).nonzero().squeeze(1)
    own = sums[seen]
    channel, position = own[:, rows], own[:, : dim + 1]
    ones = channel.sum(dim=1) if name == CLASS else channel[:, -1]
    counts = ones[:, :1].clamp(min=1e-12)
    middle = ones[:, 1:] / counts  # (S, D) mean position of the hits with a value
    covariance, number = _covariances(position)
    ridge = model.min_lengthscale**2 + covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1) / number
    covariance = covariance + torch.diag_embed(ridge[:, None].expand_as(middle))
    products = channel[:, :, 1:] - channel[:, :, :1] * middle[:, None]
    slopes = torch.cholesky_solve(products.mT, torch.linalg.cholesky(covariance)).mT
    center = model.centers.detach()[seen].double() - middle
    values = channel[:, :, :1] + slopes @ center[:, :, None]
    functions = torch.cat([values, slopes], dim=2)
    if name == CLASS:
        known = torch.zeros_like(functions[:, :1])
        known[:, 0, 0] = ones[:, 0] > 0
        functions = torch.cat([functions, known], dim=1)
    else:
        functions[:, -1, 0], functions[:, -1, 1:] = ones[:, 0], 0
    return result.index_copy(0, seen, functions)


def _covariances(position: Tensor) -> tuple[Tensor, Tensor]:
    """(S, D + 1, 1 + D) first rows of the sums -> (S, D, D) covariances [m^2], (S,) numbers of hits."""
    number = position[:, -1, 0]
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
