"""Cells of space that rays crossed, and surfaces of other hits that rays passed through.

A ray that leaves through a door shows that the wall has an opening there. Its free samples rarely lie
in the plane of the wall, so the clusters of the wall would close the door. `passages` finds such
places: hits are divided into patches of neighbors, and a ray passes through a patch if it comes within
a few standard deviations of it, from one side of its plane to the other.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import native

TABLE_BITS = 24  # of a table of cells: a place shares its entry with few others
PRIMES = (73856093, 19349669, 83492791)  # of the hash; Teschner et al. 2003
PATCH_HITS = 16  # a patch has so many hits, and fewer than twice as many
NEAR = 2.5  # standard deviations of a patch: nearer rays pass through it
CORE = 1.5  # standard deviations of a cluster: rays that come so near pass through it
THIN = 0.002  # [m] smallest standard deviation of a cluster: rays pass beside thin poles
FLOOR = 0.01  # [m] smallest standard deviation of a patch
FLAT = 0.3  # thickness of a flat patch, relative to its second largest extent
ROUGH_PATCHES = 1024  # number of patches from which the scatter of hits is estimated
ROUGH = (1 / 400, 1 / 30)  # usual scatter, relative to the reach of samples near surfaces
SLOW = 1e-30  # components of directions that are smaller count as this
CHUNK_RAYS = 1 << 14  # number of rays that are followed at a time, in plain torch


Spectra = tuple[Tensor, Tensor]  # of matrices: eigenvalues, ascending, and axes as columns


class Lines(NamedTuple):
    """What rays saw: (R, D) or (1, D) starts [m], (R, D) directions, (R,) how far [m]."""

    starts: Tensor
    ahead: Tensor
    reach: Tensor

    def starts_of(self, rays: Tensor) -> Tensor:
        """(P, D) or (1, D) starts of some rays."""
        return self.starts if len(self.starts) == 1 else self.starts[rays]


class Passages(NamedTuple):
    """Places where rays pass through patches, by ray."""

    rays: Tensor  # (P,) row of the ray, ascending
    depths: Tensor  # (P,) depth along the ray where the kernel of the patch is largest [m]
    widths: Tensor  # (P,) standard deviation of that kernel along the ray [m]
    is_flat: Tensor  # (P,) bool, whether the patch is flat


class Patches(NamedTuple):
    """L groups of neighboring hits, L a power of two: the leaves of a k-d tree, in order."""

    means: Tensor  # (L, D) [m]
    covariances: Tensor  # (L, D, D) [m^2]
    precisions: Tensor  # (L, D, D) [1/m^2]
    normals: Tensor  # (L, D) direction of smallest spread, of length 1
    thickness: Tensor  # (L,) standard deviation along the normal [m]
    is_flat: Tensor  # (L,) bool


def balanced_order(points: Tensor, levels: int) -> Tensor:
    """(N,) rows of the points, sorted into the 2^levels leaves of a balanced k-d tree.

    Leaf i has the rows from i N / 2^levels to (i + 1) N / 2^levels, rounded down. A node is divided
    in the middle of its points along the axis of its largest extent; ties are resolved, and rows in
    a leaf ordered, by row.

    Args:
        points: (N, D) positions [m].
        levels: number of divisions.
    """
    if native.supports(points):
        return torch.ops.lardhm.balanced_order(points, levels)
    order = torch.arange(len(points), device=points.device)
    for level in range(levels):
        owners = _owners(len(points), level, points.device)
        here, index = points[order], owners[:, None].expand(-1, points.shape[1])
        highest = here.new_full((1 << level, points.shape[1]), -torch.inf)
        extent = highest.scatter_reduce(0, index, here, "amax")
        extent += highest.scatter_reduce(0, index, -here, "amax")
        keys = here.gather(1, extent.argmax(dim=1)[owners][:, None]).squeeze(1)
        place = keys.argsort(stable=True)  # rows of a node ascend: ties by row
        order = order[place[owners[place].argsort(stable=True)]]
        order = _ascending(order, _owners(len(points), level + 1, points.device))
    return order


def _ascending(order: Tensor, owners: Tensor) -> Tensor:
    """Rows ordered within each of the (N,) ascending groups."""
    return (owners * len(order) + order).sort().values % max(1, len(order))


def _owners(count: int, levels: int, device: torch.device) -> Tensor:
    """(count,) leaf of each place in the order of a tree."""
    bounds = torch.arange((1 << levels) + 1, device=device) * count >> levels
    leaves = torch.arange(1 << levels, device=device)
    return torch.repeat_interleave(leaves, bounds.diff(), output_size=count)


def find_patches(hits: Tensor) -> Patches:
    """Patches of (N, D) hits [m], N > 0."""
    levels = max(0, (len(hits) // PATCH_HITS).bit_length() - 1)
    here = hits[balanced_order(hits, levels)]
    owners, (count, dim) = _owners(len(hits), levels, hits.device), (1 << levels, hits.shape[1])
    sizes = torch.bincount(owners, minlength=count).to(hits.dtype)
    means = here.new_zeros(count, dim).index_add_(0, owners, here) / sizes[:, None]
    offsets = here - means[owners]
    scatters = here.new_zeros(count, dim, dim)
    scatters.index_add_(0, owners, offsets[:, :, None] * offsets[:, None])
    return patches_of(means, scatters / (sizes - 1).clamp(min=1)[:, None, None])


def patches_of(
    means: Tensor, covariances: Tensor, floor: float = FLOOR, spectra: Spectra | None = None
) -> Patches:
    """Patches with (L, D) means [m] and (L, D, D) covariances [m^2], to which ``floor``^2 is added."""
    found, axes = native.symmetric_axes(covariances) if spectra is None else spectra
    variances = found.clamp(min=0) + floor**2
    spread = variances.sqrt()
    precisions = (axes / variances[:, None]) @ axes.mT
    is_flat = spread[:, 0] < FLAT * spread[:, 1]
    covariances = covariances + floor**2 * torch.eye(means.shape[1]).to(means)
    return Patches(means, covariances, precisions, axes[:, :, 0], spread[:, 0], is_flat)


def roughness(patches: Patches) -> float:
    """How far hits typically scatter about planes where the scene is flattest [m].

    This is the first quartile of the thickness of flat patches, of which neighbors are pooled until
    `ROUGH_PATCHES` are left. NaN if there are fewer patches, or hardly a flat one.
    """
    if len(patches.means) < ROUGH_PATCHES:
        return torch.nan
    means = patches.means.unflatten(0, (ROUGH_PATCHES, -1))
    offsets = means - means.mean(dim=1, keepdim=True)
    within = patches.covariances.unflatten(0, (ROUGH_PATCHES, -1)).mean(dim=1)
    pooled = within + offsets.mT @ offsets / means.shape[1]
    spread = (native.symmetric_axes(pooled)[0] - FLOOR**2).clamp(min=0).sqrt()
    flat = spread[:, 0] < FLAT * spread[:, 1]
    few = int(flat.sum()) < ROUGH_PATCHES // 16
    return torch.nan if few else float(spread[flat, 0].quantile(0.25))


def warn_of_units(patches: Patches, margin: float, one_scan: bool) -> None:
    """Warn if hits scatter much more or less than the distances of samples from surfaces allow for.

    Registered scans of lidars and depth cameras scatter by 3 to 11 mm. A single scan may scatter less,
    and exact planes of a simulation do not scatter at all.

    Args:
        patches: of the hits.
        margin: distance from surfaces within which free and unknown points are sampled [m].
        one_scan: whether all hits were seen from one place.
    """
    found = roughness(patches)
    low, high = (factor * margin for factor in ROUGH)
    if found > high or (not one_scan and 1e-2 * low < found < low):
        warnings.warn(
            f"hits scatter by {found:.2g} m about planes; {low:.2g} to {high:.2g} m are usual. "
            "Coordinates must be in meters: scale points and sensor positions. If they are, adapt "
            "near_margin and near_reach of SamplingConfig to this sensor",
            stacklevel=5,
        )


def passages(hits: Tensor, lines: Lines, ends: Tensor, margin: float) -> Passages:
    """Where rays pass through patches of hits.

    A ray passes through a patch if it starts and ends on different sides of its plane, both farther
    from it than `NEAR` standard deviations and ``margin``, and comes within `NEAR` standard deviations
    of the patch before ``ends``. Rays that graze a surface, and those that end on it, do not. Of each
    patch at most `PATCH_HITS` passages are returned, about one for every hit: many rays pass by the edge
    of a dense surface, and more samples there would wear it away.

    Args:
        hits: (H, D) hits of the rays [m].
        lines: R rays, as far as the hit of each, or as it was seen to be free.
        ends: (R,) depths before which space is free [m].
        margin: smallest distance of both ends of a ray from the plane [m].
    """
    if len(hits) < PATCH_HITS or len(ends) == 0:
        return _none(ends)
    corner = lines.starts.mean(dim=0)
    patches = find_patches(hits - corner)
    warn_of_units(patches, margin, len(lines.starts) == 1)
    lines = lines._replace(starts=lines.starts - corner)
    rays, leaves = crossed(patches, lines, ends, NEAR * patches.thickness + margin, NEAR)
    return _places(rays, leaves, lines, patches)


def passages_through(
    means: Tensor, covariances: Tensor, lines: Lines, ends: Tensor, margin: float
) -> tuple[Tensor, Passages]:
    """Where rays pass through the cores of clusters: (P,) clusters and places; see `passages`.

    The core of a cluster is within `CORE` standard deviations. A cluster that is not flat is also passed
    by rays that start and end on one side of it.

    Args:
        means: (M, D) [m].
        covariances: (M, D, D) [m^2].
        lines: R rays.
        ends: (R,) depths before which space is free [m].
        margin: smallest distance of both ends of a ray from the plane of a flat cluster [m].
    """
    if len(means) == 0 or len(ends) == 0:
        found = _none(ends)
        return found.rays, found
    levels = (len(means) - 1).bit_length()
    bounds = torch.arange((1 << levels) + 1, device=means.device) * len(means) >> levels
    order = balanced_order(means, levels)[bounds[:-1]]  # a leaf without a cluster gets the next one
    means, covariances = means[order], covariances[order]
    spectra = native.symmetric_axes(covariances)
    patches = patches_of(means, covariances, FLOOR, spectra)
    clear = torch.where(patches.is_flat, NEAR * patches.thickness + margin, -torch.inf)
    thin = patches_of(means, covariances, THIN, spectra)
    cores = patches._replace(precisions=thin.precisions, covariances=thin.covariances)
    rays, leaves = crossed(cores, lines, ends, clear, CORE)
    depths = _closest(rays, leaves, lines, cores)[0]
    widths = _closest(rays, leaves, lines, patches)[1]
    steep = (lines.ahead[rays] * patches.normals[leaves]).sum(dim=1) / patches.thickness[leaves]
    is_flat = patches.is_flat[leaves]
    through = ~is_flat | ((steep * widths) ** 2 > 0.5)  # else it grazes the plane
    through &= (bounds.diff() > 0)[leaves]
    columns = (rays, depths, widths, is_flat)
    return order[leaves][through], Passages(*(column[through] for column in columns))


def _none(ends: Tensor) -> Passages:
    none = torch.zeros(0, dtype=torch.long, device=ends.device)
    return Passages(none, ends[:0], ends[:0], none.bool())


def crossed(
    patches: Patches, lines: Lines, ends: Tensor, clear: Tensor, near: float
) -> tuple[Tensor, Tensor]:
    """(P,) rays and (P,) patches that they pass through; see `passages`.

    Args:
        patches: a power of two of them, in the order of a tree.
        lines: R rays.
        ends: (R,) depths before which space is free [m].
        clear: (L,) smallest distance of both ends of a ray from the plane of a patch [m]; negative
            infinity: they need not be on different sides.
        near: standard deviations of a patch within which rays pass through it.
    """
    half = near * patches.covariances.diagonal(dim1=1, dim2=2).sqrt()
    boxes = (patches.means - half, patches.means + half)
    if native.supports(patches.means):
        shapes = (patches.means, patches.precisions, patches.normals, clear)
        return torch.ops.lardhm.passing(*lines, ends, *boxes, *shapes, near)
    parts = torch.arange(len(ends), device=ends.device).split(CHUNK_RAYS)
    found = [_passing(part, lines, ends, boxes, patches, clear, near) for part in parts]
    rays, leaves = (torch.cat(part) for part in zip(*found, strict=True))
    return rays, leaves


def _places(rays: Tensor, leaves: Tensor, lines: Lines, patches: Patches) -> Passages:
    """Passages of pairs of a ray and a patch, at most `PATCH_HITS` of each patch."""
    kept = _spread(leaves, PATCH_HITS, len(patches.means))
    rays, leaves = rays[kept], leaves[kept]
    depths, widths, _ = _closest(rays, leaves, lines, patches)
    return Passages(rays, depths, widths, patches.is_flat[leaves])


def _passing(
    rays: Tensor,
    lines: Lines,
    ends: Tensor,
    boxes: tuple[Tensor, Tensor],
    patches: Patches,
    clear: Tensor,
    near: float,
) -> tuple[Tensor, Tensor]:
    """(P,) rays and (P,) patches that they pass through, of some rays; see `passages`."""
    rays, leaves = _boxes_met(rays, lines, ends, boxes)
    depths, _, squared = _closest(rays, leaves, lines, patches)
    start, ahead = lines.starts_of(rays), lines.ahead[rays]
    normals = patches.normals[leaves]
    before = ((start - patches.means[leaves]) * normals).sum(dim=1)
    after = before + lines.reach[rays] * (ahead * normals).sum(dim=1)
    through = (before.minimum(after) < -clear[leaves]) & (before.maximum(after) > clear[leaves])
    through &= (squared < near**2) & (depths > 0) & (depths < ends[rays])
    return rays[through], leaves[through]


def _spread(groups: Tensor, most: int, num_groups: int) -> Tensor:
    """Ascending rows of the (P,) group numbers: at most so many of each group, evenly spaced."""
    order = groups.argsort(stable=True)
    sizes = torch.bincount(groups, minlength=num_groups)
    place = torch.arange(len(groups), device=groups.device)
    place -= (sizes.cumsum(0) - sizes)[groups[order]]
    size = sizes[groups[order]].clamp(min=most)
    first = place * most // size != (place - 1) * most // size
    return order[first].sort().values


def _closest(
    rays: Tensor, leaves: Tensor, lines: Lines, patches: Patches
) -> tuple[Tensor, Tensor, Tensor]:
    """Of pairs: (P,) depths of the largest kernel value, widths there, squared standard deviations."""
    offsets, ahead = patches.means[leaves] - lines.starts_of(rays), lines.ahead[rays]
    precisions = patches.precisions[leaves]
    scaled = (precisions @ ahead[:, :, None]).squeeze(2)
    slopes = (scaled * ahead).sum(dim=1)
    depths = (scaled * offsets).sum(dim=1) / slopes
    apart = offsets - depths[:, None] * ahead
    squared = (apart * (precisions @ apart[:, :, None]).squeeze(2)).sum(dim=1)
    return depths, slopes.rsqrt(), squared


def _boxes_met(
    rays: Tensor, lines: Lines, ends: Tensor, boxes: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """(P,) rays and (P,) boxes that they meet before ``ends``, found level by level of the tree."""
    levels = [boxes]
    while len(levels[0][0]) > 1:
        low, high = (bound.unflatten(0, (-1, 2)) for bound in levels[0])
        levels.insert(0, (low.amin(dim=1), high.amax(dim=1)))
    nodes = torch.zeros_like(rays)
    for level, (low, high) in enumerate(levels):
        if level:
            rays = rays.repeat_interleave(2)
            nodes = (2 * nodes[:, None] + torch.arange(2, device=rays.device)).flatten()
        ahead, start = lines.ahead[rays], lines.starts_of(rays)
        inverse = 1 / ahead.where(ahead.abs() > SLOW, SLOW)
        sides = torch.stack([(low[nodes] - start) * inverse, (high[nodes] - start) * inverse])
        enter = sides.amin(dim=0).amax(dim=1).clamp(min=0)
        met = enter <= sides.amax(dim=0).amin(dim=1).minimum(ends[rays])
        rays, nodes = rays[met], nodes[met]
    return rays, nodes


def table_entry(cells: Tensor) -> Tensor:
    """(..., D) numbers of cells, int64 -> (...) entry of the table that each has, int64."""
    entry = cells[..., 0] * PRIMES[0]
    for axis in range(1, cells.shape[-1]):
        entry = entry ^ (cells[..., axis] * PRIMES[axis % len(PRIMES)])
    return entry & ((1 << TABLE_BITS) - 1)


def never_crossed(
    points: Tensor, starts: Tensor, ahead: Tensor, reach: Tensor, edge: float
) -> Tensor:
    """(N, D) positions -> (N,) bool: no ray went through the cell.

    Each ray is followed in steps of a cell's edge. Cells that a ray cuts by less than a corner may
    be missed, and a place that shares its entry of the table with a crossed cell is held to be
    crossed: that is rare, and costs a sample.

    Args:
        points: (N, D) positions [m].
        starts: (R, D), or (1, D) where all are one, origins of the rays [m].
        ahead: (R, D) their directions, of length 1.
        reach: (R,) how far each was seen to go [m].
        edge: of the cells [m].
    """
    if len(reach) == 0:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    corner = starts.mean(dim=0)
    cells = ((points - corner) / edge).floor().long()
    begins = (starts - corner) / edge
    whole = begins.floor()
    # float32 serves along a ray: it counts from the border of the cell where the ray begins
    rays = (whole.long(), (begins - whole).float(), ahead.float(), (reach / edge).long() + 1)
    if native.supports(points):
        return torch.ops.lardhm.unmarked_cells(cells, *rays)
    return unmarked_cells(cells, *rays)


def unmarked_cells(
    cells: Tensor, starts: Tensor, inside: Tensor, ways: Tensor, steps: Tensor
) -> Tensor:
    """(N, D) numbers of cells -> (N,) bool: no ray marked the cell's entry of the table.

    Args:
        cells: (N, D) int64.
        starts: (R, D) or (1, D) int64, cells where the rays begin.
        inside: of the same shape, float32, where in them, in units of a cell.
        ways: (R, D) float32 directions, of length 1.
        steps: (R,) int64, how many cells on each ray is followed.
    """
    marked = torch.zeros(1 << TABLE_BITS, dtype=torch.bool, device=cells.device)
    order = steps.argsort()
    ends, ways = steps[order], ways[order]
    if len(starts) > 1:
        starts, inside = starts[order], inside[order]
    first = torch.searchsorted(ends, torch.arange(int(ends[-1]), device=ends.device), right=True)
    for step, begin in enumerate(first.tolist()):  # the rays that go farther
        rows = slice(begin if len(starts) > 1 else 0, None)
        along = inside[rows] + ways[begin:] * (step + 0.5)  # two roundings, everywhere the same
        marked[table_entry(starts[rows] + along.floor().long())] = True
    return ~marked[table_entry(cells)]
