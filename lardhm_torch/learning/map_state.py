"""The clusters of a map as plain tensors, one row each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lardhm_torch.features import raw_factors
from lardhm_torch.learning.clustering import Clusters, Columns


@dataclass(frozen=True, eq=False)
class MapState(Columns):
    """Everything a map knows but its origin: M rows each (see `LardHilbertMap`)."""

    weights: Tensor
    centers: Tensor
    raw_scale_tril: Tensor
    is_occupied: Tensor
    counts: Tensor
    means: Tensor
    scatters: Tensor

    def rows(self, which: Tensor) -> MapState:
        """The clusters of a mask or of indices, in that order, as copies."""
        which = which.nonzero().squeeze(1) if which.dtype == torch.bool else which
        return MapState(*(tensor.index_select(0, which) for tensor in self))

    def put(self, where: Tensor, part: MapState) -> MapState:
        """A copy with the first rows of ``part`` in the places ``where`` and its others at the end."""
        count = len(where)
        return MapState(
            *(
                torch.cat([ours, theirs[count:]]).index_copy_(0, where, theirs[:count])
                for ours, theirs in zip(self, part, strict=True)
            )
        )

    def __len__(self) -> int:
        """Number of clusters M."""
        return self.weights.shape[0]

    @property
    def clusters(self) -> Clusters:
        """The moments."""
        return Clusters(self.counts, self.means, self.scatters)


def new_rows(clusters: Clusters, is_occupied: Tensor, floor: float) -> MapState:
    """Rows of new clusters: centers and length-scales from their moments, weights of 0.

    Args:
        clusters: M clusters.
        is_occupied: (M,) bool, their class.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
    """
    factors = factor_covariances(clusters.covariances, floor)
    weights = torch.zeros_like(clusters.means[:, 0])
    return MapState(weights, clusters.means, raw_factors(factors), is_occupied, *clusters)


def factor_covariances(covariances: Tensor, floor: float) -> Tensor:
    """Lower Cholesky factors, valid for flat, line-like and single-point clusters too.

    ``floor``^2 is added to every variance: no axis is thinner than ``floor``, a single point
    becomes a ball of that size, and wide clusters hardly change. A relative 1e-6 of the largest
    variance keeps long thin clusters factorable in float32.

    Args:
        covariances: (M, D, D) [m^2], positive semi-definite up to rounding.
        floor: smallest standard deviation [m].

    Returns:
        (M, D, D) lower factors [m] with positive diagonals.
    """
    largest = covariances.diagonal(dim1=-2, dim2=-1).amax(dim=-1)
    ridge = floor**2 + 1e-6 * largest
    eye = torch.eye(covariances.shape[-1], dtype=covariances.dtype, device=covariances.device)
    return torch.linalg.cholesky(covariances + ridge[:, None, None] * eye)
