"""Evidence: a bounded random sample of the points of each cluster.

Every point has a priority, a hash of its coordinates, and a cluster keeps the `EVIDENCE` points of
smallest priority. The kept points are a uniform random sample of all points that the cluster
received. They do not depend on the order of the scans or on how scans are divided into updates, and
repeated points change nothing.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import raw_factors
from lardhm_torch.learning.cluster_matching import moved_factors
from lardhm_torch.learning.clustering import (
    Clusters,
    Grouped,
    clusters_from_moments,
)
from lardhm_torch.learning.map_state import EVIDENCE, MapState, factor_covariances
from lardhm_torch.native.thinning import BITS, priorities


def keep_points(points: Tensor, owners: Tensor, num_clusters: int) -> Tensor:
    """The points of smallest priority of each cluster. Equal points are kept once.

    Args:
        points: (N, D) positions [m].
        owners: (N,) cluster of each point; points with any other number are left out.
        num_clusters: M.

    Returns:
        (M, E, D) positions, ascending by priority; infinity where a cluster has fewer points.
    """
    if native.supports(points):
        return torch.ops.lardhm.keep_points(points, owners.int(), num_clusters, EVIDENCE)
    rows = ((owners >= 0) & (owners < num_clusters)).nonzero().squeeze(1)
    points, owners = points[rows], owners[rows].long()
    for axis in range(points.shape[1]):  # equal priorities: in the order of the coordinates
        order = points[:, -1 - axis].argsort(stable=True)
        points, owners = points[order], owners[order]
    keys, order = (owners << BITS | priorities(points)).sort(stable=True)
    points, owners = points[order], owners[order]
    repeated = torch.zeros_like(keys, dtype=torch.bool)
    repeated[1:] = (keys[1:] == keys[:-1]) & (points[1:] == points[:-1]).all(dim=1)
    points, owners = points[~repeated], owners[~repeated]
    first = torch.searchsorted(owners, torch.arange(num_clusters, device=owners.device))
    place = torch.arange(len(owners), device=owners.device) - first[owners]
    kept = place < EVIDENCE
    evidence = points.new_full((num_clusters, EVIDENCE, points.shape[1]), torch.inf)
    evidence[owners[kept], place[kept]] = points[kept]
    return evidence


def add_points(
    evidence: Tensor, cleared: Tensor, points: Tensor, owners: Tensor
) -> tuple[Tensor, Tensor]:
    """Evidence after more points were added, see `keep_points`.

    Args:
        evidence: (K, E, D) of the first clusters; later ones keep no points yet.
        cleared: (M,) bool, clusters that lose the points that they keep first.
        points: (N, D) positions [m].
        owners: (N,) cluster of each point; points with any other number are left out.

    Returns:
        (M, E, D) evidence, and (M,) number of points that a cluster keeps and did not keep before.
    """
    if native.supports(points):
        return torch.ops.lardhm.add_points(evidence, cleared, points, owners.int())
    count = len(cleared)
    before = evidence.new_full((count, *evidence.shape[1:]), torch.inf)
    before[: len(evidence)] = evidence
    kept, homes = kept_points(before, (~cleared).nonzero().squeeze(1))
    after = keep_points(torch.cat([kept, points]), torch.cat([homes, owners.to(homes)]), count)
    inside = owners[(owners >= 0) & (owners < count)].long()
    touched = cleared.index_fill(0, inside, True)
    after = after.where(touched[:, None, None], before)
    again = (after[:, :, None] == before[:, None]).all(dim=3).any(dim=2)
    return after, (~again & ~after[:, :, 0].isinf()).sum(dim=1)


def keeps_points(evidence: Tensor) -> Tensor:
    """(M, E, D) evidence -> (M,) bool, whether a cluster keeps any point."""
    return ~evidence[:, 0, 0].isinf()


def kept_counts(evidence: Tensor) -> Tensor:
    """(M, E, D) evidence -> (M,) number of kept points."""
    if _is_native(evidence):
        return torch.ops.lardhm.kept_counts(evidence)
    return (~evidence[:, :, 0].isinf()).sum(dim=1)


def kept_points(evidence: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The points that some clusters keep.

    Args:
        evidence: (M, E, D).
        rows: (Q,) clusters; None: all.

    Returns:
        (L, D) points, in the order of ``rows``, and (L,) the cluster of each.
    """
    if rows is None:
        rows = torch.arange(len(evidence), device=evidence.device)
    if _is_native(evidence):
        return torch.ops.lardhm.kept_points(evidence, rows)
    found = evidence[rows]
    mask = ~found[:, :, 0].isinf()
    return found[mask], rows[mask.nonzero()[:, 0]]


def kept_again(
    points: Tensor, owners: Tensor, evidence: Tensor, cleared: Tensor
) -> tuple[Tensor, Tensor]:
    """Which points clusters keep already, and which they can keep.

    Args:
        points: (N, D) positions [m].
        owners: (N,) their clusters; points with a negative number are left out.
        evidence: (K, E, D) of the first of M clusters.
        cleared: (M,) bool, clusters that lose the points that they keep.

    Returns:
        (M,) number of the points that a cluster keeps already; (N,) bool: False for those, and for
        points with larger priorities than all points of a cluster that keeps E and loses none.
    """
    if _is_native(evidence):
        return torch.ops.lardhm.kept_again(points, owners, evidence, cleared)
    enters = owners >= 0
    rows = (enters & (owners < len(evidence))).nonzero().squeeze(1)
    points, owners = points[rows], owners[rows]
    kept = evidence[owners]
    again = (kept == points[:, None]).all(dim=2).any(dim=1)
    last = priorities(evidence.flatten(0, 1)).reshape(evidence.shape[:2]).amax(dim=1)[owners]
    loses = kept[:, -1, 0].isinf() | cleared[owners]
    enters[rows] = ~again & (loses | (priorities(points) <= last))
    return torch.bincount(owners[again], minlength=len(cleared)), enters


def _is_native(evidence: Tensor) -> bool:
    return evidence.shape[1] > 0 and native.supports(evidence[:, 0])


def first_points(evidence: Tensor, counts: Tensor) -> Tensor:
    """Evidence reduced to the first ``counts`` (M,) points of each cluster."""
    place = torch.arange(evidence.shape[1], device=evidence.device)
    return evidence.where((place < counts[:, None])[:, :, None], torch.inf)


def evidence_moments(evidence: Tensor) -> Clusters:
    """Moments of the kept points of M clusters; the mean is not finite if a cluster has none."""
    if _is_native(evidence):
        return Clusters(*torch.ops.lardhm.kept_moments(evidence))
    mask = ~evidence[:, :, :1].isinf()
    offsets = torch.where(mask, evidence - evidence[:, :1], 0)
    counts = mask.sum(dim=(1, 2))
    sums, scatters = offsets.sum(dim=1), offsets.mT @ offsets
    return clusters_from_moments(evidence[:, 0], counts, sums, scatters)


def following(
    state: MapState, rows: Tensor, evidence: Tensor, num_known: int, floor: float
) -> MapState:
    """Clusters that follow the points they keep. Fine-tuning of known ones is preserved.

    Args:
        state: M clusters.
        rows: (Q,) clusters whose points changed; each keeps one or more.
        evidence: (Q, E, D) their points [m].
        num_known: number of clusters that are not new, the first ones.
        floor: smallest standard deviation [m].
    """
    names = ("counts", "centers", "means", "scatters", "raw_scale_tril")
    before = [getattr(state, name).index_select(0, rows) for name in names]
    given = (evidence, *before, rows < num_known, floor)
    found = torch.ops.lardhm.follow_kept(*given) if _is_native(evidence) else follow_kept(*given)
    after = zip(names[1:], found, strict=True)
    return replace(
        state, **{name: getattr(state, name).index_copy(0, rows, t) for name, t in after}
    )


def follow_kept(
    evidence: Tensor, counts: Tensor, centers: Tensor, means: Tensor, scatters: Tensor,
    raw_scale_tril: Tensor, known: Tensor, floor: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Centers, means, scatters and raw factors of clusters that got the moments of their points.

    Args:
        evidence: (M, E, D) points [m], one or more in each cluster.
        counts: (M,) number of points that they represent.
        centers: (M, D) [m].
        means: (M, D) [m].
        scatters: (M, D, D) [m^2].
        raw_scale_tril: (M, D, D).
        known: (M,) bool: the center and the factor move as the moments do; otherwise they are those
            of the moments.
        floor: smallest standard deviation [m].
    """
    found = evidence_moments(evidence)
    scale = (counts - 1).clamp(min=1).to(scatters)[:, None, None]
    old = factor_covariances(scatters / scale, floor)
    new = factor_covariances(found.covariances, floor)
    raw = torch.where(
        known[:, None, None], moved_factors(raw_scale_tril, old, new), raw_factors(new)
    )
    return centers + (found.means - means), found.means, found.covariances * scale, raw


def halves(evidence: Tensor) -> tuple[Tensor, Tensor]:
    """Evidence of the two halves of each cluster, divided at the mean along its longest axis.

    The first half is where the largest component of the axis is positive.
    """
    if _is_native(evidence):
        return torch.ops.lardhm.halves(evidence)
    clusters = evidence_moments(evidence)
    axes = torch.linalg.eigh(clusters.covariances).eigenvectors[:, :, -1]
    axes = axes * axes.gather(1, axes.abs().argmax(dim=1, keepdim=True)).sign()
    along = ((evidence - clusters.means[:, None]) * axes[:, None]).sum(dim=2)
    parts = []
    for inside in (along > 0, along <= 0):  # padding is in neither
        order = inside.int().argsort(dim=1, descending=True, stable=True)
        part = evidence.gather(1, order[:, :, None].expand_as(evidence))
        parts.append(first_points(part, inside.sum(dim=1)))
    return parts[0], parts[1]


def fitted_evidence(grouped: Grouped) -> Tensor:
    """(M, E, D) evidence of clusters that were fitted to points of their classes."""
    parts = zip(grouped.classes, grouped.owners, grouped.numbers, strict=True)
    return torch.cat([keep_points(points, owners, number) for points, owners, number in parts])


def with_evidence(state: MapState, floor: float, rng: torch.Generator) -> Tensor:
    """(M, E, D) evidence of a map; drawn from the moments of clusters that keep no points.

    Clusters have no evidence if the map was saved without it. Points are then drawn uniformly from
    ellipsoids with the means and covariances of the clusters.
    """
    empty = (~keeps_points(state.evidence)).nonzero().squeeze(1)
    if len(empty) == 0:
        return state.evidence
    lost = state.rows(empty)
    factors = factor_covariances(lost.clusters.covariances, floor)
    dim = factors.shape[1]
    shape = (len(empty), EVIDENCE, dim)
    direction = torch.randn(shape, generator=rng, device=rng.device).to(factors)
    direction /= torch.linalg.vector_norm(direction, dim=2, keepdim=True)
    volume = torch.rand(len(empty), EVIDENCE, 1, generator=rng, device=rng.device).to(factors)
    ball = (dim + 2) ** 0.5 * volume ** (1 / dim) * direction
    points = (lost.means[:, None] + ball @ factors.mT).reshape(-1, dim)
    owners = torch.arange(len(empty), device=points.device).repeat_interleave(EVIDENCE)
    return state.evidence.index_copy(0, empty, keep_points(points, owners, len(empty)))
