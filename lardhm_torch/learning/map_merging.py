"""Rigid transform, cropping and merging of complete maps."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.features import PLAIN, Kernel, kernel_factors, lard_kernel, raw_factors
from lardhm_torch.learning.changes import changes_map
from lardhm_torch.learning.channel_sums import Layout, joint_layout, moved_sums, with_layout
from lardhm_torch.learning.cluster_matching import match_clusters, moved_factors
from lardhm_torch.learning.clustering import concatenate_clusters, pool_clusters
from lardhm_torch.learning.evidence import keep_points, kept_counts, kept_points, with_evidence
from lardhm_torch.learning.fitting import FitConfig, FitTask
from lardhm_torch.learning.map_state import NEVER, MapState, factor_covariances
from lardhm_torch.learning.parameters import MapParameters, read_state, write_state
from lardhm_torch.learning.retraining import balanced, evidence_weights, trained
from lardhm_torch.scans import seeded_generator

AnyMap = TypeVar("AnyMap", bound=MapParameters)

ZETA = 1.0  # [m] maximum distance of matching clusters (zeta in Algorithm 2)
REACHED = 1e-3  # feature of a free cluster above which it reaches a position
TOLERANCE = 0.01  # accepted change of a probability by merging


def moved(
    state: MapState, origin: Tensor, rotation: Tensor, translation: Tensor
) -> tuple[MapState, Tensor]:
    """Clusters and origin after the rigid transform x -> rotation x + translation.

    Means become R z + t and covariances R S R^T, so the transformed map is exact.

    Args:
        state: M clusters.
        origin: (D,) float64, world = map + origin [m].
        rotation: (D, D) orthonormal, determinant 1.
        translation: (D,) [m].

    Raises:
        ValueError: a shape is wrong, a value is not finite, or rotation is not a rotation.
    """
    dim = len(origin)
    rotation = torch.as_tensor(rotation, dtype=torch.float64, device=origin.device)
    translation = torch.as_tensor(translation, dtype=torch.float64, device=origin.device)
    if rotation.shape != (dim, dim) or translation.shape != (dim,):
        raise ValueError(
            f"rotation must be ({dim}, {dim}) and translation ({dim},); "
            f"got {tuple(rotation.shape)} and {tuple(translation.shape)}"
        )
    if not bool(translation.isfinite().all()):
        raise ValueError(f"translation must be finite; got {translation.tolist()}")
    eye = torch.eye(dim, dtype=torch.float64, device=origin.device)
    error = float((rotation @ rotation.T - eye).abs().max())
    if not (error < 1e-5 and torch.linalg.det(rotation) > 0):
        raise ValueError(
            "rotation must be orthonormal with determinant 1; "
            f"R R^T differs from the identity by {error:.2g}, "
            f"the determinant is {float(torch.linalg.det(rotation)):.4g}"
        )
    place = rotation @ origin + translation
    new_origin = place.round()  # whole meters, as in `fit`
    shift = place - new_origin

    def transformed(points: Tensor) -> Tensor:
        return (points.double() @ rotation.T + shift).to(points.dtype)

    scatters = rotation @ state.scatters.double() @ rotation.T
    after = replace(
        state,
        centers=transformed(state.centers),
        raw_scale_tril=_rotated_factors(state.raw_scale_tril, rotation),
        means=transformed(state.means),
        evidence=transformed(state.evidence.nan_to_num(posinf=0)).where(
            state.evidence.isfinite(), torch.inf
        ),
        scatters=scatters.to(state.scatters.dtype),
        channel_sums=moved_sums(state.channel_sums, rotation, shift),
    )
    return after, new_origin


def _rotated_factors(raw_scale_tril: Tensor, rotation: Tensor) -> Tensor:
    """Raw Cholesky factors of R L L^T R^T, from the QR decomposition of (R L)^T."""
    factors = kernel_factors(raw_scale_tril.double(), PLAIN)
    upper = torch.linalg.qr((rotation @ factors).mT, mode="r").R
    signs = upper.diagonal(dim1=-2, dim2=-1).sign()
    return raw_factors((signs[..., None] * upper).mT).to(raw_scale_tril.dtype)


def check_sphere(center: Tensor, radius: float, origin: Tensor) -> Tensor:
    """Validate a sphere; return its center as a (D,) float64 tensor, world frame [m].

    Raises:
        ValueError: center is not (D,) and finite, or radius is not > 0.
    """
    center = torch.as_tensor(center, dtype=torch.float64, device=origin.device)
    if center.shape != origin.shape or not bool(center.isfinite().all()):
        raise ValueError(f"center must be ({len(origin)},) and finite; got {center.tolist()}")
    if not radius > 0:
        raise ValueError(f"radius must be > 0 m; got {radius}")
    return center


def within(state: MapState, center: Tensor, radius: float, kernel: Kernel) -> Tensor:
    """(M,) mask of the clusters to keep: within ``radius`` [m] of a position, or bounding those.

    Kernels of free clusters extend beyond the sphere. Clusters outside that are not free and that such
    a kernel reaches are kept, so that walls outside the sphere do not become free space. The position
    is in the map frame.
    """
    near = torch.linalg.vector_norm(state.centers - center, dim=1) <= radius
    return with_limits(state, near, kernel)


def with_limits(state: MapState, kept: Tensor, kernel: Kernel) -> Tensor:
    """(M,) mask of clusters -> the mask with those, not free, that a kernel of a free one reaches."""
    inside = state.rows(kept)
    outside = (~kept & (state.kinds != 1)).nonzero().squeeze(1)
    if len(inside) == 0 or len(outside) == 0:
        return kept
    free = inside.rows(inside.kinds == 1)
    reached = torch.zeros_like(outside, dtype=torch.bool)
    for means in (state.means[outside], *_surroundings(state.rows(outside), kernel)):
        if len(free):
            indices = native.nearest_centers(means, free.centers, kernel.num_neighbors)
            factors = kernel_factors(free.raw_scale_tril, kernel)
            values = lard_kernel(means, free.centers, factors, indices)
            reached |= (values > REACHED).any(dim=1)
    return kept.index_fill(0, outside[reached], True)


def _surroundings(state: MapState, kernel: Kernel) -> Iterator[Tensor]:
    """(M, D) positions one standard deviation from the means, in both directions of every axis."""
    factors = factor_covariances(state.clusters.covariances, kernel.min_lengthscale)
    for axis in range(factors.shape[1]):
        yield state.means + factors[:, :, axis]
        yield state.means - factors[:, :, axis]


def replace_clusters(
    model: MapParameters,
    state: MapState,
    origin: Tensor,
    rows: Tensor | slice,
    layout: Layout | None = None,
) -> None:
    """Write clusters that were ``rows`` of the map and keep their features, with their posterior.

    ``layout`` is that of their channels; None: that of the map.
    """
    means, variances = model.posterior_means[rows].clone(), model.posterior_variances[rows].clone()
    scales = model.posterior_scales.clone()
    with model.lock.writing():
        write_state(model, state, origin, layout)
        model.posterior_means, model.posterior_variances = means, variances
        model.posterior_scales = scales


@changes_map
def merge_maps(first: AnyMap, second: AnyMap, *, seed: int = 0) -> AnyMap:
    """Merge two maps into a new map in the frame of the first. The given maps are not modified.

    Clusters that match by Algorithm 2 are merged, with weights and centers averaged in proportion to
    their numbers of points; all other clusters are copied. Where the probability of the merged map
    deviates from that of the given maps, its weights are trained on the kept points of both
    maps. Maps that do not overlap are combined unchanged, and merging a map with itself does not
    change its probabilities. The posterior of the weights is discarded, because the two maps were
    calibrated separately (see `LardHilbertMap.fit_uncertainty`).

    Args:
        first: a `LardHilbertMap`.
        second: another map with the same settings and world frame (see
            `LardHilbertMap.transform`).
        seed: random seed of the training.

    Returns:
        A new map, in the frame of the first.

    Raises:
        ValueError: the settings differ, a map is packed, a channel has different numbers of values,
            or the maps are too far apart for their dtype.

    Source: Guizilini & Ramos 2016, Algorithm 2, lines 4 to 16, applied to two maps.
    """
    if first.settings != second.settings:
        raise ValueError(
            f"both maps must have the same settings; got {first.settings} and {second.settings}"
        )
    first.check_learns()
    second.check_learns()
    with second.lock.reading():
        second = copy.deepcopy(second)
    joined = copy.deepcopy(first)
    if len(second) == 0:
        return joined
    ours, theirs = read_state(first), read_state(second)
    layout = joint_layout(first.channel_layout, second.channel_layout)
    is_trained = first.class_weights is not None or second.class_weights is not None
    ours = with_layout(ours, first.channel_layout, layout, is_trained)
    theirs = with_layout(theirs, second.channel_layout, layout, is_trained)
    if len(first) == 0:
        taken = MapState(*(t.to(o) for t, o in zip(theirs, ours, strict=True)))
        write_state(joined, taken, second.origin.clone(), layout)
        return joined
    shift = (second.origin - first.origin).to(ours.means)
    theirs = MapState(*(t.to(o) for t, o in zip(theirs, ours, strict=True)))
    theirs = replace(
        theirs,
        centers=theirs.centers + shift,
        means=theirs.means + shift,
        evidence=theirs.evidence + shift,
        channel_sums=moved_sums(theirs.channel_sums, torch.eye(len(shift)), shift),
    )
    rng = seeded_generator(seed, "merge_maps", shift.device)
    pooled = _pooled(ours, theirs, first.kernel)
    state = _retrained(pooled, ours, theirs, first.kernel, rng)
    write_state(joined, state, first.origin.clone(), layout)
    return joined


def _pooled(ours: MapState, theirs: MapState, kernel: Kernel) -> MapState:
    """Merge matching clusters, and append the other clusters of the second map.

    Factors are changed by the change of the biased covariances (scatter / count), because merging two
    equal clusters does not change the biased covariance. A cluster of unknown points (count 0) of the
    second map is dropped where it matches: it adds nothing to what is there.
    """
    floor = kernel.min_lengthscale
    match = match_clusters(ours, theirs.clusters, theirs.is_occupied, ZETA, floor)
    is_matched = match >= 0
    merged = is_matched & (theirs.counts > 0)
    where, groups = match[merged].unique(return_inverse=True)
    before, others = ours.rows(where), theirs.rows(merged)
    rows = torch.cat([torch.arange(len(where), device=groups.device), groups])
    clusters = concatenate_clusters([before.clusters, others.clusters])
    pooled = pool_clusters(clusters, rows, len(where))
    fraction = clusters.counts / pooled.counts[rows]

    def average(mine: Tensor, other: Tensor) -> Tensor:
        values = torch.cat([mine, other])
        shaped = fraction.to(values.dtype).reshape(-1, *[1] * (values.ndim - 1))
        return torch.zeros_like(mine).index_add_(0, rows, shaped * values)

    spreads = [
        factor_covariances(c.scatters / c.counts.clamp(min=1)[:, None, None], floor)
        for c in (before.clusters, pooled)
    ]
    both_sums = torch.cat([before.channel_sums, others.channel_sums])
    after = MapState(
        average(before.weights, others.weights),
        average(before.centers, others.centers),
        moved_factors(before.raw_scale_tril, *spreads),
        before.is_occupied,
        pooled.counts,
        pooled.means,
        pooled.scatters,
        _pooled_evidence(before, others, rows),
        torch.zeros_like(before.losses),
        before.doubts,
        before.fresh,
        torch.maximum(before.times, _latest(others.times, groups, len(where))),
        torch.zeros_like(before.channel_sums).index_add_(0, rows, both_sums),
        average(before.class_weights, others.class_weights),
    )
    rest = theirs.rows(~is_matched)
    tail = MapState(*(torch.cat(pair) for pair in zip(after, rest, strict=True)))
    return ours.put(where, tail)


def _latest(times: Tensor, groups: Tensor, count: int) -> Tensor:
    """(count,) the latest time of each group."""
    return times.new_full((count,), NEVER).scatter_reduce_(0, groups, times, "amax")


def _pooled_evidence(first: MapState, second: MapState, rows: Tensor) -> Tensor:
    """Evidence of merged clusters, from that of all clusters and the merged row of each."""
    points, owners = kept_points(torch.cat([first.evidence, second.evidence]))
    return keep_points(points, rows[owners], len(first))


def _retrained(
    joined: MapState, ours: MapState, theirs: MapState, kernel: Kernel, rng: torch.Generator
) -> MapState:
    """Retrain the weights of the merged map where it deviates from the original maps."""
    parts = [_map_samples(state, kernel, rng) for state in (ours, theirs)]
    points, labels, kinds, strength = map(torch.cat, zip(*parts, strict=True))
    tensors = (joined.centers, joined.raw_scale_tril, joined.weights, kernel)
    index = native.build_index(joined.centers, kernel.num_neighbors)
    probability = native.occupancy(points, *tensors, probability=True, index=index)
    contested = (probability - labels).abs() > TOLERANCE
    if not bool(contested.any()):
        return joined
    near = native.nearest_centers(points[contested], joined.centers, kernel.num_neighbors, index)
    open_rows = torch.zeros_like(joined.is_occupied).index_fill_(0, near.reshape(-1), True)
    config = FitConfig(l2=0.01)
    samples = (points, labels, balanced(kinds, strength, config))
    learned, _ = trained(joined, index, samples, FitTask(kernel, config, rng))
    return replace(joined, weights=torch.where(open_rows, learned, joined.weights))


def _map_samples(
    state: MapState, kernel: Kernel, rng: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Kept points of a map; the probability of the map, class and weight of each."""
    state = replace(state, evidence=with_evidence(state, kernel.min_lengthscale, rng))
    points, owners = kept_points(state.evidence)
    tensors = (state.centers, state.raw_scale_tril, state.weights, kernel)
    labels = native.occupancy(points, *tensors, probability=True)
    strength = evidence_weights(state, kept_counts(state.evidence))
    return points, labels, state.kinds[owners], strength[owners]
