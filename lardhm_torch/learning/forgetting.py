"""Forgetting: kept points that a new scan contradicts.

For each occupied cluster, the scans with rays that pass through it since its last hit are counted, or
those with free points near its center if the rays are not known. ``doubts`` is that count relative to a
third of the binary logarithm of the number of its hits. It exceeds `DOUBT` only together with that of
most clusters around: an obstacle is removed as a whole, while at the edges of one that is still there
some clusters are passed and others are hit. Above `DOUBT`, the kept points have less weight in training,
so a removed obstacle disappears after a few scans, a little later if it was observed for long. A hit
restores the weight. Points of unknown clusters are removed if the map predicts them as free or occupied.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.assignment import feature_sums
from lardhm_torch.learning.cluster_matching import take_clusters
from lardhm_torch.learning.clustering import split_labels
from lardhm_torch.learning.evidence import kept_counts
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.sampling import UNKNOWN

HIT = 0.1  # sum of the features of hits above which a cluster was hit
NARROWEST = 0.03  # [m] smallest standard deviation of kernels here: few points pass thinner ones
EXTENT = 0.25  # ... and at most this fraction of the clusters' usual size
CONFIRMS = 2.0  # covariance scale of kernels for hits if rays are known: hits beside do not confirm
DOUBT = 3.0  # doubt at which a cluster is contradicted
AROUND = 8  # so many occupied clusters, the cluster itself included, are asked whether ...
MOST = 0.6  # ... this fraction of them is in doubt, too,
REACH = 4.0  # ... if they are no farther away than so many standard deviations along a surface
GONE = 10 * DOUBT  # doubt at which a cluster is removed
AGAIN = 1 / 4  # of the points of a cluster whose trust changed counts as new: it is trained again
OVERRULED = 0.3  # mean loss of a cluster of unknown points that other evidence contradicts


def doubted(
    known: MapState,
    points: Tensor,
    labels: Tensor,
    kernel: Kernel,
    index: Tensor,
    passed: Tensor | None = None,
) -> Tensor:
    """(M,) evidence against each occupied cluster since its last hit.

    A scan with rays that passed through it counts 1. If the rays are not known, it counts the sum of the
    features of its free points, which are 1 at the center of the cluster and fall to 0, but at most 1.
    `DOUBT` is reached when the count is a third of the binary logarithm of 4 plus the cluster's hits.

    Args:
        known: M clusters.
        points: (N, D) new points [m].
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        kernel: kernel settings of the map.
        index: search index of the centers, see `native.build_index`.
        passed: (P,) clusters that rays passed through, see `passing.passed_clusters`; None: not known.
    """
    if len(known) == 0 or not bool((labels != UNKNOWN).any()):
        return known.doubts
    hits, free, _ = split_labels(points, labels)
    wide = kernel._replace(min_lengthscale=max(kernel.min_lengthscale, _narrowest(known)))
    shapes = (known.centers, known.raw_scale_tril, known.is_occupied)
    if passed is None:
        hit, near = (feature_sums(part, *shapes, wide, index) for part in (hits, free))
        more = near.clamp(max=1)
    else:
        hit = feature_sums(hits, *shapes, wide._replace(covariance_scale=CONFIRMS), index)
        more = torch.zeros_like(hit).index_fill_(0, passed, 1)
    tolerance = (4 + known.counts).log2().to(more) / 3
    doubts = torch.where(hit > HIT, 0, known.doubts + DOUBT * more / tolerance)
    return _shared(known, doubts * known.is_occupied)


def _shared(known: MapState, doubts: Tensor) -> Tensor:
    """(M,) doubts, limited to `DOUBT` where most occupied clusters around are not in doubt."""
    rows = (doubts > DOUBT).nonzero().squeeze(1)
    if len(rows) == 0:
        return doubts
    occupied = known.is_occupied.nonzero().squeeze(1)
    centers, others = known.centers[rows], known.centers[occupied]
    near = native.nearest_centers(centers, others, min(AROUND, len(others))).long()
    covariances = take_clusters(known.clusters, rows).covariances
    variances = covariances.diagonal(dim1=1, dim2=2).sum(dim=1)
    reach = REACH * (variances / max(1, centers.shape[1] - 1)).sqrt()
    around = (others[near] - centers[:, None]).norm(dim=2) <= reach[:, None]
    in_doubt = around & (doubts[occupied[near]] >= DOUBT)
    agree = in_doubt.sum(dim=1) >= MOST * around.sum(dim=1)
    return doubts.index_copy(0, rows, torch.where(agree, doubts[rows], DOUBT))


def _narrowest(known: MapState) -> float:
    """Smallest standard deviation of kernels [m].

    Wide kernels of small clusters would meet rays that pass beside a surface.
    """
    variances = known.clusters.covariances[known.is_occupied].diagonal(dim1=1, dim2=2).sum(dim=1)
    return min(NARROWEST, EXTENT * float(variances.median().sqrt())) if len(variances) else 0.0


def trust(doubts: Tensor) -> Tensor:
    """(M,) doubts -> (M,) factor on the weights of kept points, 1 until a cluster is in doubt."""
    return (DOUBT / doubts.clamp(min=DOUBT)) ** 8


def forget(known: MapState, before: Tensor) -> MapState:
    """The clusters without the points that others contradict.

    Points of clusters far in doubt and of overruled unknown clusters are removed. Where trust changed,
    the weights are to be trained again.

    Args:
        known: M clusters.
        before: (M,) doubts before the new scan.
    """
    lost = (known.doubts > GONE) | ((known.kinds == 2) & (known.losses > OVERRULED))
    rows = (lost | (trust(known.doubts) != trust(before))).nonzero().squeeze(1)
    kept = kept_counts(known.evidence.index_select(0, rows))
    fresh = known.fresh[rows].maximum((AGAIN * kept).to(known.fresh))
    evidence = known.evidence
    if bool(lost.any()):
        evidence = evidence.index_fill(0, lost.nonzero().squeeze(1), torch.inf)
    return replace(
        known,
        evidence=evidence,
        channel_sums=known.channel_sums.masked_fill(lost[:, None, None], 0),
        fresh=known.fresh.index_copy(0, rows, fresh),
    )
