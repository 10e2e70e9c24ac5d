"""Space that nothing was seen of: where the map is taught to say 1/2.

A sum of kernels says something wherever its kernels reach, and they reach across walls and out of
all that was seen. Data of two classes cannot forbid it, for there is none where it happens. So
there is a third kind: points of label 1/2, behind hits where no ray ever was (`never_crossed`) and
in the tails of the clusters (`draw_tails`). They get clusters of their own, whose weights stay
near 0 and cancel what reaches across, so that no cluster of a surface or of free space is spent on
it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.clustering import Clusters, factor_covariances

UNKNOWN = 0.5  # the label
TABLE_BITS = 24  # of a table of cells: a place shares its entry with few others
PRIMES = (73856093, 19349669, 83492791)  # of the hash; Teschner et al. 2003
INSIDE = 6.0  # standard deviations from a surface's cluster: nothing there is unknown ...
SURFACE = 0.25  # [m] ... nor farther than this from its plane: wider clusters are no surfaces
TAILS = (2.0, 5.0)  # standard deviations from a cluster: where its tail is
TAIL_FEATURE = 0.4  # no cluster holds a place where no feature is larger
TAILS_PER_CLUSTER = 3


def table_entry(cells: Tensor) -> Tensor:
    """(..., D) positions in units of a cell -> (...) entry of the table that its cell has, int64."""
    whole = cells.floor().long()
    entry = whole[..., 0] * PRIMES[0]
    for axis in range(1, cells.shape[-1]):
        entry = entry ^ (whole[..., axis] * PRIMES[axis % len(PRIMES)])
    return entry & ((1 << TABLE_BITS) - 1)


def never_crossed(
    points: Tensor, starts: Tensor, ahead: Tensor, reach: Tensor, edge: float
) -> Tensor:
    """(N, D) positions -> (N,) bool: no ray went through the cell.

    Cells that a ray cuts by less than a corner may be missed, and a place that shares its entry of
    the table with a crossed cell is held to be crossed: that is rare, and costs a sample.

    Args:
        points: (N, D) positions [m].
        starts: (R, D), or (1, D) where all are one, origins of the rays [m].
        ahead: (R, D) their directions, of length 1.
        reach: (R,) how far each was seen to go [m].
        edge: of the cells [m].
    """
    crossed = torch.zeros(1 << TABLE_BITS, dtype=torch.bool, device=points.device)
    corner = starts.mean(dim=0)  # float32 serves near the origin
    order = reach.argsort()
    ends = reach[order]
    ways = ahead[order].float()
    begins = (((starts if len(starts) == 1 else starts[order]) - corner) / edge).float()
    steps = int(ends[-1] / edge) + 1 if len(ends) else 0
    first = torch.searchsorted(ends, torch.arange(steps, device=ends.device) * edge)
    for step, begin in enumerate(first.tolist()):
        start = begins if len(begins) == 1 else begins[begin:]
        crossed[table_entry(torch.add(start, ways[begin:], alpha=step + 0.5))] = True
    return ~crossed[table_entry(((points - corner) / edge).float())]


def off_surfaces(points: Tensor, surfaces: Clusters, floor: float) -> Tensor:
    """(N, D) positions -> (N,) bool: not inside the nearest cluster of hits.

    Inside is within `INSIDE` standard deviations, and within `SURFACE` of its plane. At grazing
    incidence a place behind a hit still lies within the surface.

    Args:
        points: (N, D) positions [m].
        surfaces: occupied clusters; none: every point is off them.
        floor: smallest standard deviation [m].
    """
    if len(surfaces) == 0 or len(points) == 0:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    covariances = surfaces.covariances
    factors = factor_covariances(covariances, floor)
    normals = torch.linalg.eigh(covariances).eigenvectors[:, :, 0]
    owner = native.nearest_centers(points, surfaces.means, 1).squeeze(1)
    offsets = points - surfaces.means[owner]
    whitened = torch.linalg.solve_triangular(factors[owner], offsets[:, :, None], upper=False)
    inside = whitened.squeeze(2).square().sum(dim=1) < INSIDE**2
    return ~(inside & ((offsets * normals[owner]).sum(dim=1).abs() < SURFACE))


def draw_tails(
    clusters: Clusters, is_occupied: Tensor, floor: float, rng: torch.Generator
) -> Tensor:
    """(N, D) positions in the tails of the clusters [m], more where these are large.

    Places are spread over space, not over clusters: a cluster is drawn as often as its volume says,
    half of them from the occupied ones, which are smaller.
    """
    count, dim = TAILS_PER_CLUSTER * len(clusters), clusters.means.shape[1]
    covariances = clusters.covariances
    sizes = covariances.diagonal(dim1=1, dim2=2).sum(dim=1).sqrt() + floor
    volumes = sizes**dim
    for kind in (is_occupied, ~is_occupied):
        volumes[kind] /= volumes[kind].sum()
    chosen = torch.multinomial(volumes, count, replacement=True, generator=rng)
    factors = factor_covariances(covariances, floor)[chosen]
    shape = (count, dim)
    way = torch.randn(shape, generator=rng, device=rng.device).to(factors)
    low, high = TAILS
    far = low + (high - low) * torch.rand(count, 1, generator=rng, device=rng.device).to(factors)
    way *= far / torch.linalg.vector_norm(way, dim=1, keepdim=True)
    return clusters.means[chosen] + (factors @ way[:, :, None]).squeeze(2)
