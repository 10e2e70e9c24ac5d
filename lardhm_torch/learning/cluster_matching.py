"""Matching and merging of clusters (Algorithm 2)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import PLAIN, kernel_factors, raw_factors, squared_distances
from lardhm_torch.learning.clustering import Clusters, concatenate_clusters, pool_clusters
from lardhm_torch.learning.map_state import MapState, factor_covariances, new_rows


def match_clusters(
    known: MapState, new: Clusters, is_occupied: Tensor, zeta: float, floor: float
) -> Tensor:
    """(P,) row of the known cluster that matches each new cluster, or -1.

    Two clusters match if they have the same class, their centers are closer than ``zeta``, and each
    center lies within one standard deviation of the other cluster. Of several matches the nearest is
    used.

    Source: Guizilini & Ramos 2016, Algorithm 2, lines 4 to 6.
    """
    pairs = _pairs_within(new.means, known.means, zeta)
    pairs = pairs[:, is_occupied[pairs[0]] == known.is_occupied[pairs[1]]]
    offsets = known.means[pairs[1]] - new.means[pairs[0]]
    inside = (whitened(offsets, new.covariances[pairs[0]], floor) < 1) & (
        whitened(offsets, known.clusters.covariances[pairs[1]], floor) < 1
    )
    rows, columns = pairs[:, inside]
    distance = squared_distances(new.means[rows], known.means[columns])
    nearest = distance.new_full((len(new),), torch.inf).scatter_reduce(0, rows, distance, "amin")
    first = distance == nearest[rows]
    none = len(known)  # ties are resolved in favor of the lower row
    match = torch.full((len(new),), none, device=rows.device)
    match = match.scatter_reduce(0, rows[first], columns[first], "amin")
    return torch.where(match == none, -1, match)


def _pairs_within(first: Tensor, second: Tensor, distance: float) -> Tensor:
    """(2, L) all pairs of rows of (P, D) and (Q, D) positions closer than ``distance`` [m]."""
    found = []
    step = max(1, (1 << 22) // max(1, len(second)))
    for start in range(0, len(first), step):
        near = squared_distances(first[start : start + step, None], second[None]) < distance**2
        found.append(near.nonzero().T + torch.tensor([[start], [0]], device=first.device))
    return torch.cat(found, dim=1)


def whitened(offsets: Tensor, covariances: Tensor, floor: float) -> Tensor:
    """(L, D) offsets [m] and (L, D, D) covariances -> (L,) length in standard deviations."""
    factors = factor_covariances(covariances, floor)
    solved = torch.linalg.solve_triangular(factors, offsets[:, :, None], upper=False)
    return torch.linalg.vector_norm(solved.squeeze(2), dim=1)


def merge_clusters(
    known: MapState, new: Clusters, is_occupied: Tensor, zeta: float, floor: float
) -> MapState:
    """Merge known clusters with matching new ones; append the others with weight 0.

    Source: Guizilini & Ramos 2016, Algorithm 2, lines 7 to 16.
    """
    match = match_clusters(known, new, is_occupied, zeta, floor)
    matched, fresh = match >= 0, match < 0
    where, groups = match[matched].unique(return_inverse=True)
    merged = pool_clusters(take_clusters(new, matched), groups, len(where))
    part = pool_into(known, where, merged, floor)
    added = new_rows(take_clusters(new, fresh), is_occupied[fresh], floor)
    return part.put(match[:0], added)


def take_clusters(clusters: Clusters, rows: Tensor) -> Clusters:
    """The clusters selected by a mask or by indices, in that order."""
    rows = rows.nonzero().squeeze(1) if rows.dtype == torch.bool else rows
    return Clusters(*(moments.index_select(0, rows) for moments in clusters))


def pool_into(known: MapState, where: Tensor, found: Clusters, floor: float) -> MapState:
    """Merge the clusters in rows ``where`` with one cluster each.

    Centers and factors are changed by the change of the moments, so fine-tuning is preserved.
    """
    before = known.rows(where)
    if native.supports(before.means):
        tensors = (before.counts, before.means, before.scatters, before.raw_scale_tril)
        *moments, shift, moved = torch.ops.lardhm.pool(*tensors, *found, floor)
        pooled = Clusters(*moments)
    else:
        pooled, shift, moved = _pooled(before, found, floor)
    after = replace(
        before,
        centers=before.centers + shift,
        raw_scale_tril=moved,
        counts=pooled.counts,
        means=pooled.means,
        scatters=pooled.scatters,
    )
    return known.put(where, after)


def _pooled(known: MapState, found: Clusters, floor: float) -> tuple[Clusters, Tensor, Tensor]:
    """Merged clusters, shift of their means, and updated raw factors, in plain torch."""
    groups = torch.arange(len(known), device=known.counts.device).repeat(2)
    both = concatenate_clusters([known.clusters, found])
    pooled = pool_clusters(both, groups, num_groups=len(known))
    old, new = (factor_covariances(c.covariances, floor) for c in (known.clusters, pooled))
    return pooled, pooled.means - known.means, moved_factors(known.raw_scale_tril, old, new)


def moved_factors(raw_scale_tril: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Apply the change of the moments' factors to raw factors: L -> after inv(before) L.

    A factor that was not fine-tuned equals ``before`` and becomes ``after``.
    """
    factors = kernel_factors(raw_scale_tril, PLAIN)
    return raw_factors(after @ torch.linalg.solve_triangular(before, factors, upper=False))
