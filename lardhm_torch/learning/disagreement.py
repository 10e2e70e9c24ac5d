"""How far apart scans see the same surfaces.

Poses of scans are known to centimeters, while the noise of one scan is a few millimeters. A map that
takes poses as exact is sure of surfaces that the next scan will see a few centimeters away. What scans
see in common tells how much they disagree: hits of other scans lie farther from the flat patches of a
scan than its own hits do.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.native.crossings import PATCH_HITS, Patches, find_patches
from lardhm_torch.sampling import SamplingConfig, spread_rows, usable_rays
from lardhm_torch.scans import Scans, seeded_generator

MOST_SCANS = 32  # scans whose patches are compared with the hits of others
MOST_HITS = 200_000  # that are drawn for this, over all these scans
WIDE = 0.3  # variances of a patch in its plane: the smaller relative to the larger, at least
FAR = 0.5  # [m] farther from its plane, a hit lies on another surface
DEVIATIONS_PER_MEDIAN = 1.4826  # normal distribution: standard deviation by median magnitude
MEDIAN_ERROR = (
    1.86  # standard error of such a median: times the median, over the root of the number
)


class Offsets(NamedTuple):
    """(Q,) distances of hits from the planes of patches [m], and (Q,) numbers of these patches."""

    distances: Tensor
    patches: Tensor


def scan_disagreement(scans: Scans, *, seed: int = 0) -> float:
    """Standard deviation of the surfaces of one scan about those of another [m].

    Half of the hits of a scan are divided into patches. Two medians of distances from the planes of the
    flat ones are compared: of the other half of its hits, and of the hits of other scans; both of the
    same patches, each of which has the same weight. The disagreement is what the second variance has
    more than the first. If scans are registered with independent errors, it is sqrt(2) times the error
    of one.

    Args:
        scans: range scans, world frame.
        seed: of the random choice of hits.

    Returns:
        The disagreement, for ``FitConfig(hit_noise=...)``; 0 if there is only one scan, or if none is
        significant on the flat surfaces that scans have in common.
    """
    found = list(_compared(scans, seeded_generator(seed, "disagreement", scans.ends.device)))
    if not found:
        return 0.0
    same, cross = (
        Offsets(*map(torch.cat, zip(*part, strict=True))) for part in zip(*found, strict=True)
    )
    common = same.patches[torch.isin(same.patches, cross.patches)].unique()
    noise, apart = (_median(part, common) for part in (same, cross))
    doubt = MEDIAN_ERROR * math.hypot(noise, apart) / max(1, len(common)) ** 0.5
    if apart - noise <= 2 * doubt:
        return 0.0
    return DEVIATIONS_PER_MEDIAN * math.sqrt(apart**2 - noise**2)


def _compared(scans: Scans, rng: torch.Generator) -> Iterator[list[Offsets]]:
    """Of some scans: offsets from their patches, of their own other hits and of hits of other scans."""
    config = SamplingConfig()
    is_hit = usable_rays(scans, config)[0] & scans.is_return & (scans.ranges <= config.max_range)
    rays = is_hit.nonzero().squeeze(1)
    numbers = scans.scan_id[rays].unique()
    numbers = numbers[:: -(-max(1, len(numbers)) // MOST_SCANS)]
    count, begin = min(len(rays), MOST_HITS // max(1, len(numbers))), 0
    for number in numbers:
        own = rays[scans.scan_id[rays] == number]
        others = rays[spread_rows(len(rays), count, rng)]
        others = others[scans.scan_id[others] != number]
        if len(own) < 2 * PATCH_HITS or len(others) == 0:
            continue
        own = own[torch.randperm(len(own), generator=rng, device=rng.device)]
        origin = scans.origins[number]
        patches = find_patches(scans.ends[own[::2]] - origin)
        pair = [patch_offsets(scans, part, origin, patches) for part in (own[1::2], others)]
        yield [part._replace(patches=part.patches + begin) for part in pair]
        begin += len(patches.means)


def patch_offsets(scans: Scans, rays: Tensor, origin: Tensor, patches: Patches) -> Offsets:
    """Distances of hits from the plane of the nearest patch, if it is flat and the hit is beside it.

    Hits that were seen from the other side of the plane are left out: walls have two surfaces.

    Args:
        scans: range scans.
        rays: (Q,) rows of the rays whose hits are compared.
        origin: (D,) sensor position of the patches' scan [m], from which these are measured.
        patches: L patches.
    """
    variances = torch.linalg.eigvalsh(patches.covariances)
    is_plane = patches.is_flat & (variances[:, 1] > WIDE * variances[:, -1])
    hits = scans.ends[rays] - origin
    owner = native.nearest_centers(hits, patches.means, 1).squeeze(1)
    rows = is_plane[owner].nonzero().squeeze(1)
    hits, owner, sensors = (
        hits[rows],
        owner[rows],
        scans.origins[scans.scan_id[rays[rows]]] - origin,
    )
    means, normals = patches.means[owner], patches.normals[owner]
    heights = ((hits - means) * normals).sum(dim=1)
    along = hits - means - heights[:, None] * normals
    squared = (along * (patches.precisions[owner] @ along[:, :, None]).squeeze(2)).sum(dim=1)
    sides = ((sensors - means) * normals).sum(dim=1) * -(means * normals).sum(dim=1)
    kept = (squared < 1) & (heights.abs() < FAR) & (sides > 0)
    return Offsets(heights[kept].abs(), owner[kept])


def _median(offsets: Offsets, chosen: Tensor) -> float:
    """Median of the distances from the chosen patches, all of which have the same weight."""
    sizes = torch.bincount(offsets.patches)
    weights = torch.isin(offsets.patches, chosen) / sizes[offsets.patches].double()
    distances, order = offsets.distances.sort()
    total = weights[order].cumsum(0)
    return float(distances[torch.searchsorted(total, total[-1] / 2)]) if len(chosen) else 0.0
