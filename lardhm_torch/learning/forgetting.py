"""Forgetting: evidence that a new scan contradicts.

Free points near the center of an occupied cluster raise its doubt, and a hit resets it. A cluster in
doubt is contradicted, and so is a cluster of unknown points that the map predicts as free or occupied. A
contradicted cluster keeps a quarter of its evidence, however long it was observed before, so an obstacle
that has been removed disappears after a few scans.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.evidence import first_points, kept_counts
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.points import UNKNOWN

HIT = 0.1  # sum of the features of hits above which a cluster was hit
NARROWEST = 0.03  # [m] standard deviation of kernels here: few points pass through smaller ones
DOUBT = 3.0  # free points at the center of a cluster, since its last hit, that contradict it
FEWEST = 3  # contradicted clusters that would keep fewer points keep none
OVERRULED = 0.3  # mean loss of a cluster of unknown points that other evidence contradicts


def doubted(
    known: MapState, points: Tensor, labels: Tensor, kernel: Kernel, index: Tensor
) -> Tensor:
    """(M,) free points at the center of each occupied cluster since its last hit.

    A point counts with its feature, which is 1 at the center of a cluster and falls to 0.

    Args:
        known: M clusters.
        points: (N, D) new points [m].
        labels: (N,) 1 occupied, 0 free, 1/2 unknown.
        kernel: kernel settings of the map.
        index: search index of the centers, see `native.build_index`.
    """
    seen = labels != UNKNOWN
    points, is_hit = points[seen], labels[seen] > UNKNOWN
    if len(known) == 0 or len(points) == 0:
        return known.doubts
    kernel = kernel._replace(min_lengthscale=max(kernel.min_lengthscale, NARROWEST))
    indices, values = native.nearest_features(
        points, known.centers, known.raw_scale_tril, kernel, index
    )

    def total(rows: Tensor) -> Tensor:
        sums = torch.zeros_like(known.weights)
        return sums.index_add_(0, indices[rows].reshape(-1).long(), values[rows].reshape(-1))

    doubts = torch.where(total(is_hit) > HIT, 0, known.doubts + total(~is_hit))
    return doubts * known.is_occupied


def contradicted(known: MapState) -> Tensor:
    """(M,) mask of occupied clusters in doubt, and of unknown ones that other evidence overrules."""
    return (known.doubts > DOUBT) | ((known.kinds == 2) & (known.losses > OVERRULED))


def forget(known: MapState, which: Tensor) -> MapState:
    """Keep a quarter of the evidence and counts of the clusters in a mask, if enough points are left."""
    kept = kept_counts(known.evidence)
    left = torch.where(kept >= 4 * FEWEST, kept // 4, 0)
    counts = torch.where(which, (known.counts + 3) // 4, known.counts)
    fresh = torch.where(which, kept.to(known.fresh), known.fresh)
    fraction = (counts - 1).clamp(min=1) / (known.counts - 1).clamp(min=1)
    left = torch.where(which, left, kept)
    return replace(
        known,
        evidence=first_points(known.evidence, left),
        channel_sums=known.channel_sums
        * torch.where(which & (left == 0), 0, fraction)[:, None, None],
        counts=counts,
        fresh=fresh,
        scatters=known.scatters * fraction.to(known.scatters)[:, None, None],
    )
