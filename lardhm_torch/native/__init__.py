"""The native version of `features`: the same values and gradients on the CPU, in one fused pass.

It is optional: if `supports` returns False, the functions here call the definition. Every operator
checks that its index belongs to the given centers and builds a new one otherwise, so a stale index
costs time but never gives a wrong result.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import features
from lardhm_torch.features import Kernel
from lardhm_torch.native import surfaces
from lardhm_torch.native.build import available as library_available
from lardhm_torch.native.operators import DTYPES, definition, fits, transformed

_registered = False


def available() -> bool:
    """Whether the native library is loaded; the first call builds it if necessary, and loads it."""
    global _registered
    if not library_available():
        return False
    if not _registered:
        _registered = True
        _register()
    return True


def supports(*tensors: Tensor) -> bool:
    """Whether the native library supports tensors like these; the first is (N, D).

    It does for the CPU, float32 and float64, 2-D and 3-D, but not under the transforms of `torch.func`
    nor for dual tensors: the definition batches itself and pushes tangents forward.
    """
    return fits(tensors[0]) and available() and not transformed(*tensors)


def build_index(centers: Tensor, num_neighbors: int) -> Tensor:
    """What the search knows of (M, D) centers, as one opaque tensor; empty where it knows nothing."""
    if not supports(centers):
        return torch.empty(0, dtype=torch.uint8, device=centers.device)
    return torch.ops.lardhm.build_index(centers.detach(), num_neighbors)


def index_matches(index: Tensor, centers: Tensor, num_neighbors: int) -> bool:
    """Whether an index was made from exactly these centers."""
    if index.device != centers.device:
        return False
    if not supports(centers):
        return len(index) == 0
    return torch.ops.lardhm.index_matches(index, centers.detach(), num_neighbors)


def nearest_centers(
    points: Tensor, centers: Tensor, num_neighbors: int, index: Tensor | None = None
) -> Tensor:
    """As `features.nearest_centers`; an index saves the time to make one."""
    if not supports(points):
        return features.nearest_centers(points, centers, num_neighbors)
    index = build_index(centers, num_neighbors) if index is None else index
    return torch.ops.lardhm.nearest(points.detach(), centers.detach(), num_neighbors, index)


def occupancy(
    points: Tensor,
    centers: Tensor,
    raw_scale_tril: Tensor,
    weights: Tensor,
    kernel: Kernel,
    *,
    probability: bool,
    index: Tensor | None = None,
) -> Tensor:
    """As `features.log_odds` of `features.kernel_factors`, or its sigmoid.

    An index saves the time to make one.
    """
    tensors = (points, centers, raw_scale_tril, weights)
    if not supports(*tensors):
        return definition(tensors, kernel, probability)
    index = build_index(centers, kernel.num_neighbors) if index is None else index
    return torch.ops.lardhm.occupancy(*tensors, *kernel, index, probability)


def lattice_occupancy(
    axes: list[Tensor],
    centers: Tensor,
    raw_scale_tril: Tensor,
    weights: Tensor,
    kernel: Kernel,
    *,
    probability: bool,
    index: Tensor,
) -> Tensor:
    """As `occupancy` of all points of a lattice, without gradients, in the shape of the lattice.

    ``axes`` are D lists of finite coordinates [m]; all their combinations are the points.
    """
    shape = [len(axis) for axis in axes]
    parameters = (centers.detach(), raw_scale_tril.detach(), weights.detach())
    if supports(centers):
        return torch.ops.lardhm.lattice_occupancy(
            torch.cat(axes), shape, *parameters, *kernel, index, probability
        )
    slabs = []
    for slab in axes[0].split(max(1, features.QUERY_CHUNK // max(1, math.prod(shape[1:])))):
        lattice = torch.meshgrid(slab, *axes[1:], indexing="ij")
        points = torch.stack(lattice, dim=-1).reshape(-1, len(axes))
        answer = occupancy(points, *parameters, kernel, probability=probability, index=index)
        slabs.append(answer.reshape(len(slab), *shape[1:]))
    return torch.cat(slabs)


def raycast(
    rays: tuple[Tensor, Tensor],
    march: tuple[float, float, float, float, bool],
    parameters: tuple[Tensor, Tensor, Tensor],
    kernel: Kernel,
    index: Tensor,
) -> Tensor:
    """As `raycasting.raycast`, for a map that `supports` says yes to.

    Args:
        rays: (R, D) origins in the map's frame and (R, D) directions of length 1, float64 [m].
        march: step and largest range [m], log-odds of the threshold and of a clear obstacle, and
            whether to go on to the ridge; where both log-odds are equal, the first step above
            them is the answer.
        parameters: centers, raw factors, weights of the map.
        kernel: its settings.
        index: of the centers.
    """
    origins, directions = rays
    return torch.ops.lardhm.raycast(origins, directions, *march, *parameters, *kernel, index)


def expected_ranges(
    rays: tuple[Tensor, Tensor],
    march: tuple[float, float, float, float, float],
    parameters: tuple[Tensor, Tensor, Tensor],
    kernel: Kernel,
    index: Tensor,
) -> Tensor:
    """As `collision.expected_range` of a point, for a map that `supports` says yes to.

    Args:
        rays: (R, D) origins in the map's frame and (R, D) directions of length 1, float64 [m].
        march: step, largest range and length of the hazard [m]; log-odds that may count as 0 where
            they are not exceeded, and probability below which nothing is reached.
        parameters: centers, raw factors, weights of the map.
        kernel: its settings.
        index: of the centers.
    """
    origins, directions = rays
    given = (*march, *parameters, *kernel, index)
    return torch.ops.lardhm.expected_ranges(origins, directions, *given)


def nearest_features(
    points: Tensor, centers: Tensor, raw_scale_tril: Tensor, kernel: Kernel, index: Tensor
) -> tuple[Tensor, Tensor]:
    """As `features.nearest_features`, without gradients; indices are int32 where that is native."""
    if supports(points):
        given = (points, centers, raw_scale_tril, index)
        return torch.ops.lardhm.nearest_features(*(t.detach() for t in given), *kernel)
    factors = features.kernel_factors(raw_scale_tril, kernel)
    chunks = [
        features.nearest_features(chunk, centers, factors, kernel.num_neighbors)
        for chunk in points.split(features.QUERY_CHUNK)
    ]
    return torch.cat([chunk[0] for chunk in chunks]), torch.cat([chunk[1] for chunk in chunks])


def mixture(
    points: Tensor,
    centers: Tensor,
    raw_scale_tril: Tensor,
    table: Tensor,
    kernel: Kernel,
    index: Tensor,
    *,
    sharp: bool,
) -> Tensor:
    """As `features.mixture` of `features.kernel_factors`."""
    given = (points, centers, raw_scale_tril, table)
    needs_gradient = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given)
    if supports(points) and not needs_gradient:
        return torch.ops.lardhm.mixture(
            *(tensor.detach() for tensor in given), *kernel, index, sharp
        )
    parts = []
    whole = torch.compiler.is_compiling()  # the exported graph must accept any number of points
    for chunk in [points] if whole else points.split(features.QUERY_CHUNK):
        indices = nearest_centers(chunk, centers, kernel.num_neighbors, index)
        factors = features.kernel_factors(raw_scale_tril, kernel)
        parts.append(features.mixture(chunk, centers, factors, table, indices, sharp=sharp))
    return torch.cat(parts)


def symmetric_axes(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """(M, D, D) symmetric matrices -> (M, D) eigenvalues, ascending, and (M, D, D) axes as columns."""
    if supports(matrices[:, 0]):
        return torch.ops.lardhm.symmetric_axes(matrices.detach())
    values, axes = torch.linalg.eigh(matrices)
    return values, axes


def assign(
    points: Tensor, centers: Tensor, *, scatter: bool = True
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Every point to its nearest center, and the moments of the offsets, in one pass.

    Args:
        points: (N, D) positions [m]; one that is not finite belongs to no center.
        centers: (M, D) cluster centers [m], at least one.
        scatter: whether to sum the products of the offsets, too.

    Returns:
        (N,) int64 labels, -1 for a point that is not finite; (M,) counts; (M, D) sums of the
        offsets from the own center [m]; (M, D, D) sums of their outer products [m^2], or
        (0, D, D) without ``scatter``. Sums are taken in float64.
    """
    if supports(points):
        index = build_index(centers, 1)
        return torch.ops.lardhm.assign(points.detach(), centers.detach(), index, scatter)
    finite = points.isfinite().all(dim=1)
    owners = features.nearest_centers(points[finite], centers, 1).squeeze(1)
    offsets = (points[finite] - centers[owners]).double()
    sums = torch.zeros_like(centers, dtype=torch.float64).index_add_(0, owners, offsets)
    scatters = sums.new_zeros(len(centers) if scatter else 0, *centers.shape[1:] * 2)
    if scatter:
        scatters.index_add_(0, owners, offsets[:, :, None] * offsets[:, None])
    labels = torch.full((len(points),), -1, dtype=torch.long, device=points.device)
    labels[finite] = owners
    counts = torch.bincount(owners, minlength=len(centers))
    dtype = centers.dtype
    return labels, counts.to(dtype), sums.to(dtype), scatters.to(dtype)


def face_tree(centers: Tensor, axes: Tensor, half: Tensor, thickness: Tensor) -> Tensor:
    """What the search knows of F faces (see `faces.Faces`); empty where it is not available."""
    if not supports(centers):
        return torch.empty(0, dtype=torch.uint8, device=centers.device)
    return torch.ops.lardhm.face_tree(centers, axes, half, thickness)


def has_tree(tree: Tensor) -> bool:
    """Whether `nearest_face` can search with this tree."""
    return len(tree) > 0


def nearest_face(
    points: Tensor, faces: Any, max_distance: float, gradient: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """As `distance.nearest_faces` and `distance.face_distances`, for (N, D) float64 points.

    Returns:
        (N,) signed distances [m], (N, D) gradients (or none at all), (N,) faces.
    """
    given = (faces.tree, faces.centers, faces.axes, faces.half, faces.thickness)
    return torch.ops.lardhm.nearest_face(points.detach(), *given, max_distance, gradient)


def descends(indices: Tensor, values: Tensor) -> bool:
    """Whether `torch.ops.lardhm.descent` can train on these features."""
    fits = values.device.type == "cpu" and values.dtype in DTYPES
    return fits and indices.dtype == torch.int32 and available()


def _register() -> None:
    """Shapes for `torch.compile` and `torch.export`."""
    library = torch.library

    @library.register_fake("lardhm::build_index")
    def _(centers: Tensor, k: int) -> Tensor:
        size = library.get_ctx().new_dynamic_size()
        return centers.new_empty(size, dtype=torch.uint8)

    @library.register_fake("lardhm::nearest")
    def _(points: Tensor, centers: Tensor, k: int, index: Tensor) -> Tensor:
        return points.new_empty((points.shape[0], min(k, centers.shape[0])), dtype=torch.long)

    @library.register_fake("lardhm::nearest_features")
    def _(points: Tensor, centers: Tensor, raw: Tensor, index: Tensor, k: int, *_: Any) -> Any:
        shape = (points.shape[0], min(k, centers.shape[0]))
        return points.new_empty(shape, dtype=torch.int32), points.new_empty(shape)

    @library.register_fake("lardhm::mixture")
    def _(points: Tensor, centers: Tensor, raw: Tensor, table: Tensor, *_: Any) -> Tensor:
        return points.new_empty(points.shape[0], table.shape[1])

    @library.register_fake("lardhm::lattice_occupancy")
    def _(axes: Tensor, shape: list[int], *_: Any) -> Tensor:
        return axes.new_empty(shape)

    @library.register_fake("lardhm::expected_ranges")
    @library.register_fake("lardhm::raycast")
    def _(origins: Tensor, *_: Any) -> Tensor:
        return origins.new_empty(origins.shape[0])

    @library.register_fake("lardhm::occupancy_backward")
    def _(grad: Tensor, points: Tensor, centers: Tensor, raw: Tensor, weights: Tensor,
          *settings: Any) -> tuple[Tensor, ...]:  # fmt: skip
        inputs, wanted = (points, centers, raw, weights), settings[-1]
        return tuple(
            torch.empty_like(t) if wanted >> bit & 1 else t.new_empty(0)
            for bit, t in enumerate(inputs)
        )

    @library.register_fake("lardhm::assign")
    def _(points: Tensor, centers: Tensor, index: Tensor, scatter: bool) -> tuple[Tensor, ...]:
        count, dim = centers.shape
        labels = points.new_empty(points.shape[0], dtype=torch.long)
        scatters = centers.new_empty(count if scatter else 0, dim, dim)
        return labels, centers.new_empty(count), torch.empty_like(centers), scatters

    @library.register_fake("lardhm::kmeans")
    def _(points: Tensor, start: Tensor, *_: Any) -> Tensor:
        return torch.empty_like(start)

    @library.register_fake("lardhm::z_order")
    def _(points: Tensor) -> Tensor:
        return points.new_empty(points.shape[0], dtype=torch.long)

    @library.register_fake("lardhm::in_cells_around")
    @library.register_fake("lardhm::unmarked_cells")
    def _(points: Tensor, *_: Any) -> Tensor:
        return points.new_empty(points.shape[0], dtype=torch.bool)

    @library.register_fake("lardhm::neighbors_of")
    def _(points: Tensor, centers: Tensor, *_: Any) -> Tensor:
        return centers.new_empty(centers.shape[0], dtype=torch.bool)

    @library.register_fake("lardhm::balanced_order")
    def _(points: Tensor, levels: int) -> Tensor:
        return points.new_empty(points.shape[0], dtype=torch.long)

    @library.register_fake("lardhm::keep_points")
    def _(points: Tensor, owners: Tensor, num_clusters: int, size: int) -> Tensor:
        return points.new_empty(num_clusters, size, points.shape[1])

    @library.register_fake("lardhm::few_per_cell")
    def _(points: Tensor, groups: Tensor, edge: float, most: int) -> Tensor:
        return groups.new_empty(library.get_ctx().new_dynamic_size())

    @library.register_fake("lardhm::add_points")
    def _(evidence: Tensor, cleared: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
        count = cleared.shape[0]
        new = cleared.new_empty(count, dtype=torch.long)
        return evidence.new_empty(count, *evidence.shape[1:]), new

    @library.register_fake("lardhm::descent")
    def _(indices: Tensor, values: Tensor, labels: Tensor, factors: Tensor, weights: Tensor,
          *_: Any) -> tuple[Tensor, ...]:  # fmt: skip
        return tuple(torch.empty_like(weights) for _ in range(3))

    @library.register_fake("lardhm::halves")
    def _(evidence: Tensor) -> tuple[Tensor, Tensor]:
        return torch.empty_like(evidence), torch.empty_like(evidence)

    @library.register_fake("lardhm::errors")
    def _(indices: Tensor, values: Tensor, labels: Tensor, weights: Tensor, stride: int,
          losses: bool) -> Tensor:  # fmt: skip
        return labels.new_empty(-(-labels.shape[0] // stride))

    @library.register_fake("lardhm::tuning_steps")
    def _(points: Tensor, indices: Tensor, labels: Tensor, factors: Tensor, start: Tensor,
          *_: Any) -> tuple[Tensor, ...]:  # fmt: skip
        return tuple(torch.empty_like(start) for _ in range(3))

    @library.register_fake("lardhm::tuned_features")
    def _(points: Tensor, indices: Tensor, *_: Any) -> Tensor:
        return points.new_empty(indices.shape)

    @library.register_fake("lardhm::nearest_clusters")
    def _(points: Tensor, *_: Any) -> Tensor:
        return points.new_empty(points.shape[0], dtype=torch.int32)

    @library.register_fake("lardhm::reaching")
    def _(centers: Tensor, *_: Any) -> Tensor:
        return centers.new_empty(centers.shape[0], dtype=torch.bool)

    @library.register_fake("lardhm::ordered_features")
    def _(points: Tensor, order: Tensor, centers: Tensor, raw: Tensor, index: Tensor, k: int,
          *_: Any) -> tuple[Tensor, Tensor]:  # fmt: skip
        shape = (points.shape[0], min(k, centers.shape[0]))
        return points.new_empty(shape, dtype=torch.int32), points.new_empty(shape)

    @library.register_fake("lardhm::pool")
    def _(counts: Tensor, means: Tensor, scatters: Tensor, raw: Tensor, *_: Any) -> Any:
        return tuple(torch.empty_like(t) for t in (counts, means, scatters, means, raw))

    surfaces.register()
