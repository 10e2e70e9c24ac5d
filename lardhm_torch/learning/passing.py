"""What the rays of a scan show about clusters that they pass through.

The free samples of a ray are far apart, so few of them lie in a thin cluster that the ray crosses, and
samples of the same seed miss it every time. Here each crossing of an occupied cluster gives one free
point, where its kernel is largest on the ray. Unknown points in cells that a ray crosses are removed.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lardhm_torch.learning.evidence import (
    following,
    keep_points,
    keeps_points,
    kept_counts,
    kept_points,
)
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.native.crossings import Lines, never_crossed, passages_through
from lardhm_torch.sampling import SamplingConfig, usable_rays
from lardhm_torch.scans import Scans

FEW_RAYS = 4096  # of many rays, fewer than twice as many are compared with unknown points


def check_rays(scans: Scans | None, dim: int) -> None:
    """Raise a ValueError if there are rays, and they are not scans of the dimension of the map."""
    if scans is None:
        return
    if not isinstance(scans, Scans):
        raise ValueError(f"rays must be the Scans of the points; got {type(scans).__name__}")
    if scans.dim != dim:
        raise ValueError(f"rays must have the {dim} dimensions of the map; got {scans.dim}")


def lines_of(scans: Scans | None, origin: Tensor) -> Lines | None:
    """The rays of scans in the frame of a map, as far as they were seen to go.

    Args:
        scans: later returns and rays that are not sampled are left out. None: no rays, None.
        origin: (D,) float64, the map's origin [m].

    Raises:
        ValueError: the scans do not have the dimension of the map.
    """
    check_rays(scans, len(origin))
    if scans is None:
        return None
    limits = SamplingConfig()
    rays = (usable_rays(scans, limits)[0] & (scans.target_index == 1)).nonzero().squeeze(1)
    starts, ends = (part[rays].to(origin) for part in (scans.ray_origins, scans.ends))
    ranges = torch.linalg.vector_norm(ends - starts, dim=1)
    reach = ranges.clamp(max=limits.max_range)
    return Lines(starts - origin, (ends - starts) / ranges[:, None], reach)


def passed_clusters(known: MapState, rays: Lines) -> tuple[Tensor, Tensor]:
    """(P,) occupied clusters that rays pass through, one for each ray, and (P, D) where [m].

    Args:
        known: M clusters.
        rays: in the map's frame; space is free before their ``reach``.
    """
    rows = known.is_occupied.nonzero().squeeze(1)
    means, covariances = known.means[rows].double(), known.clusters.covariances[rows].double()
    margin = SamplingConfig().near_margin
    clusters, found = passages_through(means, covariances, rays, rays.reach - margin, margin)
    places = rays.starts_of(found.rays) + found.depths[:, None] * rays.ahead[found.rays]
    return rows[clusters], places.to(known.means)


def still_unknown(known: MapState, rays: Lines, floor: float) -> MapState:
    """The clusters without the unknown points in cells that rays cross.

    Args:
        known: M clusters.
        rays: in the map's frame.
        floor: smallest standard deviation [m].
    """
    unknown = (known.kinds == 2).nonzero().squeeze(1)
    points, owners = kept_points(known.evidence, unknown)
    limits, every = SamplingConfig(), max(1, len(rays.reach) // FEW_RAYS)
    starts = rays.starts if len(rays.starts) == 1 else rays.starts[::every]
    free = (starts, rays.ahead[::every], rays.reach[::every] - limits.near_margin)
    kept = never_crossed(points.double(), *free, limits.cell_edge)
    touched = owners[~kept].unique()
    if len(touched) == 0:
        return known
    left = keep_points(points[kept], owners[kept], len(known)).index_select(0, touched)
    known = replace(
        known,
        evidence=known.evidence.index_copy(0, touched, left),
        fresh=known.fresh.index_copy(0, touched, kept_counts(left).to(known.fresh)),
    )
    some = keeps_points(left)
    return following(known, touched[some], left[some], len(known), floor)
