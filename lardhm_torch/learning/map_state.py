"""The clusters of a map as plain tensors with one row per cluster."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lardhm_torch.features import raw_factors
from lardhm_torch.learning.clustering import Clusters, Columns

EVIDENCE = 64  # E, number of points that a cluster keeps
NEVER = torch.finfo(torch.float64).min  # time of clusters that were learned without a time stamp
PER_MAP = ("origin", "posterior_scales")  # tensors without one row per cluster
HISTORY = ("evidence", "losses", "doubts", "fresh", "times")  # used by updates only
CHANNELS = ("channel_sums", "class_weights")  # None in a map without them


@dataclass(frozen=True, eq=False)
class MapState(Columns):
    """All tensors of a map except its origin, with M rows each (see `LardHilbertMap`).

    ``evidence`` is (M, E, D), see `evidence`. ``losses`` is (M,): the mean loss of the points that a
    cluster keeps, 0 if it has not been computed. ``doubts`` is (M,), see `forgetting`.
    ``fresh`` is (M,): the number of kept points that the weights have not been trained on.
    ``times`` is (M,) float64: when a cluster was last seen [s], see `aging`.
    ``channel_sums`` is (M, R, 1 + D) float64, see `channel_sums`; ``class_weights`` (M, K). R, K are 0
    in a map without channels or without trained classes.
    """

    weights: Tensor
    centers: Tensor
    raw_scale_tril: Tensor
    is_occupied: Tensor
    counts: Tensor
    means: Tensor
    scatters: Tensor
    evidence: Tensor
    losses: Tensor
    doubts: Tensor
    fresh: Tensor
    times: Tensor
    channel_sums: Tensor
    class_weights: Tensor

    def rows(self, which: Tensor) -> MapState:
        """Copies of the clusters selected by a mask or by indices, in that order."""
        which = which.nonzero().squeeze(1) if which.dtype == torch.bool else which
        return MapState(*(tensor.index_select(0, which) for tensor in self))

    def put(self, where: Tensor, part: MapState) -> MapState:
        """A copy with rows ``where`` replaced by the first rows of ``part``, and its others appended.

        Columns of channels that ``part`` does not have are 0.
        """
        count = len(where)
        part = replace(part, **{name: _widened(part, self, name) for name in CHANNELS})
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
    def kinds(self) -> Tensor:
        """(M,) class of each cluster: 0 occupied, 1 free, 2 unknown (`unknown_clusters`)."""
        return torch.where(self.is_occupied, 0, torch.where(self.counts > 0, 1, 2))

    @property
    def clusters(self) -> Clusters:
        """The moments of the clusters."""
        return Clusters(self.counts, self.means, self.scatters)


def _widened(part: MapState, like: MapState, name: str) -> Tensor:
    """A tensor of a state with as many rows per cluster as that of another; added ones are 0."""
    values: Tensor = getattr(part, name)
    missing = getattr(like, name).shape[1] - values.shape[1]
    if not missing:
        return values
    added = values.new_zeros(len(values), missing, *values.shape[2:])
    return torch.cat([values, added], dim=1)


def new_rows(
    clusters: Clusters, is_occupied: Tensor, floor: float, evidence: Tensor | None = None
) -> MapState:
    """Rows of new clusters, with centers and length scales from their moments and weights of 0.

    Args:
        clusters: M clusters.
        is_occupied: (M,) bool, class of each cluster.
        floor: smallest standard deviation [m], see `map_state.factor_covariances`.
        evidence: (M, E, D) points kept by the clusters [m]; None: no points.
    """
    factors = factor_covariances(clusters.covariances, floor)
    weights = torch.zeros_like(clusters.means[:, 0])
    if evidence is None:
        evidence = no_evidence(clusters.means)
    raw = raw_factors(factors)
    zeros = (weights.clone(), weights.clone(), weights.clone())
    moments = (clusters.counts, clusters.means, clusters.scatters)
    times, without = no_times(weights), no_channels(clusters.means)
    return MapState(
        weights, clusters.means, raw, is_occupied, *moments, evidence, *zeros, times, *without
    )


def no_channels(means: Tensor) -> tuple[Tensor, Tensor]:
    """(M, D) means -> `CHANNELS` of clusters without them: (M, 0, 1 + D) sums, (M, 0) class weights."""
    count, dim = means.shape
    return means.new_zeros(count, 0, 1 + dim, dtype=torch.float64), means.new_zeros(count, 0)


def no_times(weights: Tensor) -> Tensor:
    """(M,) weights -> (M,) `NEVER`: clusters that were learned without a time stamp."""
    return torch.full_like(weights, NEVER, dtype=torch.float64)


def fitting_evidence(evidence: Tensor) -> Tensor:
    """(M, any, D) evidence, also of a map that kept another number of points -> (M, E, D)."""
    more = EVIDENCE - evidence.shape[1]
    return torch.nn.functional.pad(evidence, (0, 0, 0, more), value=torch.inf)


def no_evidence(means: Tensor) -> Tensor:
    """(M, D) means -> (M, E, D) infinity: clusters that keep no points."""
    return means.new_full((len(means), EVIDENCE, means.shape[1]), torch.inf)


def factor_covariances(covariances: Tensor, floor: float) -> Tensor:
    """Regularized lower Cholesky factors; also valid for planar, linear and single-point clusters.

    ``floor``^2 is added to the diagonal, so the standard deviation along every axis is at least
    ``floor``, and wide clusters hardly change. In addition, 1e-6 of the largest variance is added, so
    that elongated clusters can be factorized in float32.

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
