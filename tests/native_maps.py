"""Random maps and points, and brute-force float64 answers, for the tests of the native kernel."""

import pytest
import torch
from torch import Tensor

from lardhm_torch.features import Kernel, kernel_factors, raw_factors

ULPS = 4
CENTER_COUNTS = (1, 2, 7, 60, 500)


def make_map(count: int, dim: int, dtype: torch.dtype, seed: int = 0) -> tuple[Tensor, ...]:
    """Random centers, raw factors and weights; some axes are thinner than the floor."""
    rng = torch.Generator().manual_seed(seed)
    centers = 2 * torch.randn(count, dim, generator=rng, dtype=dtype)
    scale_tril = torch.randn(count, dim, dim, generator=rng, dtype=dtype).tril()
    scale_tril.diagonal(dim1=1, dim2=2).abs_().add_(0.3)
    return centers, raw_factors(scale_tril), torch.randn(count, generator=rng, dtype=dtype)


def kernel(num_neighbors: int) -> Kernel:
    """The settings of the maps here."""
    return Kernel(num_neighbors, covariance_scale=1.7, min_lengthscale=0.4)


def make_points(count: int, dim: int, dtype: torch.dtype, seed: int = 1) -> Tensor:
    """Random points, many of them outside the centers' box."""
    rng = torch.Generator().manual_seed(seed)
    points = 3 * torch.randn(count, dim, generator=rng, dtype=dtype)
    points[::5] *= 4
    return points


def true_distances(points: Tensor, centers: Tensor) -> Tensor:
    """(N, M) in float64."""
    return (points.double()[:, None] - centers.double()).square().sum(dim=2).sqrt()


def true_neighbors(points: Tensor, centers: Tensor, k: int) -> Tensor:
    """(N, k) rows of the centers, ascending, ties to the lower."""
    order = true_distances(points, centers).sort(dim=1, stable=True).indices
    return order[:, :k].sort(dim=1).values


def true_terms(
    points: Tensor, parameters: tuple[Tensor, ...], indices: Tensor, dtype: torch.dtype
) -> Tensor:
    """(N, k) weight times kernel value."""
    points = points.to(dtype)
    centers, raw, weights = (tensor.to(dtype) for tensor in parameters)
    scale_tril = kernel_factors(raw, kernel(1))
    offsets = (points[:, None] - centers[indices])[..., None]
    whitened = torch.linalg.solve_triangular(scale_tril[indices], offsets, upper=False)
    values = torch.exp(-0.5 * whitened.square().sum(dim=(2, 3)))
    return weights[indices] * values * true_fade(points, centers, indices)


def true_fade(points: Tensor, centers: Tensor, indices: Tensor) -> Tensor:
    """(N, k) what is left of each kernel: 3 u^2 - 2 u^3, u = 2 (1 - t), t of the k-th's distance^2."""
    distances = (points[:, None] - centers[indices]).square().sum(dim=2)
    if not 1 < indices.shape[1] < len(centers):
        return torch.ones_like(distances)
    u = (2 * (1 - distances / distances.max(dim=1, keepdim=True).values)).clamp(0, 1)
    return 3 * u**2 - 2 * u**3


def assert_neighbors_exact(points: Tensor, centers: Tensor, k: int, found: Tensor) -> None:
    """Distinct, ascending, and the k-th distance right to a few units in the last place."""
    k = min(k, len(centers))
    assert found.shape == (len(points), k)
    assert (found.diff(dim=1) > 0).all()
    distances = true_distances(points, centers)
    farthest = distances.gather(1, found).max(dim=1).values
    expected = distances.kthvalue(k, dim=1).values
    assert (farthest - expected <= ULPS * torch.finfo(centers.dtype).eps * expected).all()


dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
dims = pytest.mark.parametrize("dim", [2, 3])
