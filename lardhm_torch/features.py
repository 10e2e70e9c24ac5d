"""Reference implementation: k nearest centers, the LARD kernel and the sparse feature matrix.

This module is plain torch and works on any device, dtype and dimension. `native` computes the same
values faster.
"""

from __future__ import annotations

import importlib.util
from typing import Any, NamedTuple

import torch
from torch import Tensor

CHUNK_ENTRIES = 1 << 23  # number of distances in memory at a time in the exhaustive search
KDTREE_MIN_CENTERS = 64  # with fewer centers the exhaustive search is as fast
QUERY_CHUNK = 1 << 17  # number of query points processed at a time
FADING = 0.5  # neighbors fade out over this fraction of the k-th squared distance
SPARE_CANDIDATES = 4  # additional neighbors searched, to detect ties at rank k


class Kernel(NamedTuple):
    """Settings of a map that determine its features, in addition to the tensors of the clusters.

    Args:
        num_neighbors: k, the number of nearest clusters used per point.
        covariance_scale: factor on the clusters' covariances.
        min_lengthscale: lower bound on the standard deviation of a kernel along each axis [m],
            before ``covariance_scale`` is applied.
    """

    num_neighbors: int
    covariance_scale: float = 1.0
    min_lengthscale: float = 0.0


PLAIN = Kernel(1)  # neither scale nor floor: `kernel_factors` undoes `raw_factors`


def kernel_factors(raw_scale_tril: Tensor, kernel: Kernel) -> Tensor:
    """(M, D, D) factors with log-transformed diagonals -> (M, D, D) kernel factors [m].

    Any raw value gives a valid lower Cholesky factor, so the raw factors can be optimized without
    constraints.
    """
    diagonal = raw_scale_tril.diagonal(dim1=-2, dim2=-1).exp()
    diagonal = torch.diag_embed(diagonal.clamp(min=kernel.min_lengthscale))
    return kernel.covariance_scale**0.5 * (raw_scale_tril.tril(-1) + diagonal)


def raw_factors(scale_tril: Tensor) -> Tensor:
    """(M, D, D) lower factors -> the same factors with log-transformed diagonals."""
    diagonal = scale_tril.diagonal(dim1=-2, dim2=-1)
    return scale_tril.tril(-1) + torch.diag_embed(diagonal.log())


def squared_distances(points: Tensor, centers: Tensor) -> Tensor:
    """(..., D) and (..., D), broadcast, -> (...) squared Euclidean distance [m^2].

    Squared differences are summed axis by axis, because the expanded form |x|^2 - 2xc + |c|^2
    suffers from catastrophic cancellation far from the origin.
    """
    total = (points[..., 0] - centers[..., 0]).square()
    for axis in range(1, points.shape[-1]):
        total = total + (points[..., axis] - centers[..., axis]).square()
    return total


def nearest_centers(points: Tensor, centers: Tensor, num_neighbors: int) -> Tensor:
    """Exact k nearest centers of each point. Ties are resolved in favor of the lower index.

    The search uses a k-d tree on the CPU, torch-cluster on other devices if it is installed, and
    otherwise an exhaustive search in chunks. The (N, M) distance matrix is never stored as a whole.

    Args:
        points: (N, D) positions [m].
        centers: (M, D) cluster centers [m], same frame, dtype and device.
        num_neighbors: number of neighbors per point; values above M are reduced to M.

    Returns:
        (N, K) int64 indices of centers, ascending in each row, K = min(num_neighbors, M).

    Source: Guizilini & Ramos 2016, Section II-B.
    """
    return torch.ops.lardhm.plain_nearest(points.detach(), centers.detach(), num_neighbors)


@torch.library.custom_op("lardhm::plain_nearest", mutates_args=())
def _plain_nearest(points: Tensor, centers: Tensor, num_neighbors: int) -> Tensor:
    k = min(num_neighbors, len(centers))
    if len(points) == 0 or k == 0:
        return torch.empty(len(points), k, dtype=torch.long, device=points.device)
    if k == len(centers):
        return torch.arange(k, device=points.device).repeat(len(points), 1)
    candidates = None
    if k + SPARE_CANDIDATES < len(centers) and len(centers) >= KDTREE_MIN_CENTERS:
        if points.device.type == "cpu":
            candidates = _kdtree_candidates(points, centers, k + SPARE_CANDIDATES)
        elif importlib.util.find_spec("torch_cluster") is not None:
            candidates = _torch_cluster_candidates(points, centers, k + SPARE_CANDIDATES)
    if candidates is None:
        return _exhaustive_nearest(points, centers, k)
    indices, exact = _closest_candidates(points, centers, candidates, k)
    if not bool(exact.all()):
        indices[~exact] = _exhaustive_nearest(points[~exact], centers, k)
    return indices


@_plain_nearest.register_fake
def _(points: Tensor, centers: Tensor, num_neighbors: int) -> Tensor:
    k = min(num_neighbors, centers.shape[0])
    return points.new_empty((points.shape[0], k), dtype=torch.long)


@_plain_nearest.register_vmap
def _(
    info: Any, in_dims: tuple[int | None, ...], points: Tensor, centers: Tensor, num_neighbors: int
) -> tuple[Tensor, int]:
    """Batches of points are searched together; batches of centers, as of several maps, in turn."""
    if in_dims[0] is not None:
        points = points.movedim(in_dims[0], 0)
    if in_dims[1] is None:
        flat = nearest_centers(points.flatten(0, 1), centers, num_neighbors)
        return flat.unflatten(0, points.shape[:2]), 0
    maps = centers.movedim(in_dims[1], 0)
    batches = [points] * len(maps) if in_dims[0] is None else points
    found = [nearest_centers(*pair, num_neighbors) for pair in zip(batches, maps, strict=True)]
    return torch.stack(found), 0


def _kdtree_candidates(points: Tensor, centers: Tensor, count: int) -> Tensor:
    from scipy.spatial import cKDTree

    tree = cKDTree(centers.double())
    finite = torch.where(points.isfinite(), points, 0).double()
    _, indices = tree.query(finite, k=count, workers=torch.get_num_threads())
    return torch.as_tensor(indices, dtype=torch.long)


def _torch_cluster_candidates(points: Tensor, centers: Tensor, count: int) -> Tensor:
    import torch_cluster

    return torch_cluster.knn(centers, points, count)[1].reshape(len(points), count)


def _closest_candidates(
    points: Tensor, centers: Tensor, candidates: Tensor, k: int
) -> tuple[Tensor, Tensor]:
    """The k nearest candidates of each row, and a mask of the rows that are guaranteed to be exact.

    Ties are resolved in favor of the lower index. A row is exact if its farthest candidate is
    clearly farther than its k-th: then no center outside the candidates can be among the k nearest.
    """
    candidates = candidates.sort(dim=1).values
    distances = squared_distances(points[:, None], centers[candidates])
    order = distances.sort(dim=1, stable=True)
    chosen = candidates.gather(1, order.indices[:, :k]).sort(dim=1).values
    exact = order.values[:, k - 1] * (1 + 1e-5) < order.values[:, -1]
    return chosen, exact


def _exhaustive_nearest(points: Tensor, centers: Tensor, k: int) -> Tensor:
    rows = max(1, CHUNK_ENTRIES // len(centers))
    parts = []
    for chunk in points.split(rows):
        distances = squared_distances(chunk[:, None], centers[None])
        nearest = distances.topk(k + 1, dim=1, largest=False, sorted=True)
        indices = nearest.indices[:, :k].sort(dim=1).values
        tied = ~(nearest.values[:, k - 1] < nearest.values[:, k])
        if bool(tied.any()):
            indices[tied] = distances[tied].sort(dim=1, stable=True).indices[:, :k].sort(1).values
        parts.append(indices)
    return torch.cat(parts)


def lard_kernel(points: Tensor, centers: Tensor, scale_tril: Tensor, indices: Tensor) -> Tensor:
    """Kernel values between points and their neighbors: 1 at a center, decreasing to 0.

    phi_m(x) = exp(-|inv(L_m) (x - c_m)|^2 / 2), with covariance L_m L_m^T. The triangular
    system is solved by forward substitution; no matrix is inverted.

    Args:
        points: (N, D) positions [m].
        centers: (M, D) cluster centers [m].
        scale_tril: (M, D, D) lower Cholesky factors of the covariances [m].
        indices: (N, K) clusters to evaluate for each point.

    Returns:
        (N, K) values in [0, 1], no unit.

    Source: Guizilini & Ramos 2016, eq. (8).
    """
    offsets = points[:, None] - centers[indices]  # (N, K, D)
    factors = scale_tril[indices]  # (N, K, D, D)
    whitened: list[Tensor] = []
    squared = torch.zeros_like(offsets[..., 0])
    for row in range(points.shape[1]):
        rest = offsets[..., row]
        for column, solved in enumerate(whitened):
            rest = rest - factors[..., row, column] * solved
        whitened.append(rest / factors[..., row, row])
        squared = squared + whitened[-1].square()
    return torch.exp(-0.5 * squared)


def neighbor_fade(points: Tensor, centers: Tensor, indices: Tensor) -> Tensor:
    """Factor on each neighbor's kernel value: 1 for near neighbors, 0 for the farthest of the k.

    Let t be the squared distance of a neighbor divided by that of the farthest neighbor, and
    u = min(1, (1 - t) / FADING). The factor is 3 u^2 - 2 u^3. It is 0 where a neighbor is replaced
    by another one, so features and their gradients are continuous. The paper truncates the sum to
    k neighbors without such a factor (Section II-B), which makes the probability discontinuous.

    All factors are 1 if k = 1 or if all clusters are neighbors.

    Args:
        points: (N, D) positions [m].
        centers: (M, D) cluster centers [m].
        indices: (N, K) the K nearest clusters of each point.

    Returns:
        (N, K) factors in [0, 1], no unit.
    """
    squared = squared_distances(points[:, None], centers[indices])
    if not 1 < indices.shape[1] < len(centers):
        return torch.ones_like(squared)
    tiny = torch.finfo(squared.dtype).tiny
    left = 1 - squared / (squared.amax(dim=1, keepdim=True) + tiny)
    left = (left / FADING).clamp(max=1)
    return left.square() * (3 - 2 * left)


def nearest_features(
    points: Tensor, centers: Tensor, scale_tril: Tensor, num_neighbors: int
) -> tuple[Tensor, Tensor]:
    """(N, K) ascending indices of the nearest clusters, and (N, K) kernel values times the fade.

    Source: Guizilini & Ramos 2016, eq. (9) with Section II-B: all other values are zero.
    """
    indices = nearest_centers(points, centers, num_neighbors)
    values = lard_kernel(points, centers, scale_tril, indices)
    return indices, values * neighbor_fade(points, centers, indices)


def feature_matrix(indices: Tensor, values: Tensor, num_clusters: int) -> Tensor:
    """(N, K) indices and values -> coalesced sparse COO matrix (N, M), for `torch.sparse.mm`."""
    rows = torch.arange(len(indices), device=indices.device)[:, None].expand_as(indices)
    coordinates = torch.stack([rows.reshape(-1), indices.reshape(-1)])
    return torch.sparse_coo_tensor(
        coordinates,
        values.reshape(-1),
        (len(indices), num_clusters),
        is_coalesced=True,
        check_invariants=False,
    )


def log_odds(
    points: Tensor, centers: Tensor, scale_tril: Tensor, weights: Tensor, num_neighbors: int
) -> Tensor:
    """(N, D) positions [m] -> (N,) log-odds of occupied, w^T Phi(x); NaN for non-finite points.

    Source: Guizilini & Ramos 2016, eq. (1).
    """
    chunks = []
    whole = torch.compiler.is_compiling()  # the exported graph must accept any number of points
    for chunk in [points] if whole else points.split(QUERY_CHUNK):
        indices, values = nearest_features(chunk, centers, scale_tril, num_neighbors)
        total = (values * weights[indices]).sum(dim=1)
        chunks.append(total.where(chunk.isfinite().all(dim=1), total.new_tensor(torch.nan)))
    return torch.cat(chunks)


def mixture(
    points: Tensor,
    centers: Tensor,
    scale_tril: Tensor,
    table: Tensor,
    indices: Tensor,
    *,
    sharp: bool,
) -> Tensor:
    """Sums of affine functions over the neighbors of each point, weighted by the features.

    The functions of cluster m are t_mc + g_mc . (x - c_m).

    Args:
        points: (N, D) positions [m].
        centers: (M, D) cluster centers [m].
        scale_tril: (M, D, D) lower Cholesky factors of the covariances [m].
        table: (M, C, 1 + D) values t and gradients g [1/m], or (M, C, 1) values alone.
        indices: (N, K) the K nearest clusters of each point.
        sharp: weight by the fourth power of the features, whose kernel has half the length scales.

    Returns:
        (N, C) sums; NaN for points that are not finite.
    """
    values = lard_kernel(points, centers, scale_tril, indices)
    values = values * neighbor_fade(points, centers, indices)
    if sharp:
        values = values.square().square()
    answers = table[indices]  # (N, K, C, 1 + D)
    if table.shape[2] > 1:  # the center only is where the function is written down
        offsets = points[:, None] - centers.detach()[indices]
        answers = answers[..., :1] + answers[..., 1:] @ offsets[..., None]
    total = (values[:, :, None] * answers[..., 0]).sum(dim=1)
    return total.where(points.isfinite().all(dim=1, keepdim=True), total.new_tensor(torch.nan))
