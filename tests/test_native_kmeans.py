"""Assignment of points to centers and k-means in the native library."""

import pytest
import torch
from native_maps import (
    dims,
    dtypes,
    make_map,
    make_points,
    true_distances,
)

from lardhm_torch import native
from lardhm_torch.learning.kmeans import mini_batch_kmeans
from lardhm_torch.learning.points import morton_order


@dtypes
@dims
@pytest.mark.parametrize("native_path", [True, False])
def test_assignment_sums_the_moments_of_each_center(dtype, dim, native_path, monkeypatch):
    if native_path and not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    monkeypatch.setattr(native, "supports", lambda points: native_path)
    centers = make_map(30, dim, dtype)[0]
    points = make_points(5000, dim, dtype)
    points[7] = torch.nan
    labels, counts, sums, scatters = native.assign(points, centers)
    kept = torch.arange(5000) != 7
    expected = true_distances(points[kept], centers).argmin(dim=1)
    assert labels[7] == -1
    assert torch.equal(labels[kept], expected)
    offsets = (points[kept] - centers[expected]).double()
    products = offsets[:, :, None] * offsets[:, None]
    zeros = torch.zeros(30, dim, dim, dtype=torch.float64)
    assert torch.equal(counts, torch.bincount(expected, minlength=30).to(dtype))
    torch.testing.assert_close(
        sums, zeros[:, 0].clone().index_add_(0, expected, offsets).to(dtype), rtol=1e-5, atol=1e-4
    )
    torch.testing.assert_close(scatters, zeros.index_add_(0, expected, products).to(dtype))
    assert native.assign(points, centers, scatter=False)[3].shape == (0, dim, dim)


# --- k-means ---


@dims
@dtypes
def test_native_kmeans_equals_the_plain_loop(ops, dim, dtype, monkeypatch):
    points = make_points(3000, dim, dtype)
    fast = mini_batch_kmeans(points, 40, torch.Generator().manual_seed(3))
    monkeypatch.setattr(native, "supports", lambda points: False)
    plain = mini_batch_kmeans(points, 40, torch.Generator().manual_seed(3))
    torch.testing.assert_close(
        fast, plain, rtol=1e-3 if dtype == torch.float32 else 1e-9, atol=1e-3
    )


@dims
@dtypes
def test_the_native_z_order_equals_the_plain_one(ops, dim, dtype, monkeypatch):
    points = torch.cat([make_points(2000, dim, dtype), torch.zeros(50, dim, dtype=dtype)])
    for given in (points, points[:1], points[-50:]):
        fast = morton_order(given)
        with monkeypatch.context() as patch:
            patch.setattr(native, "supports", lambda points: False)
            assert torch.equal(fast, morton_order(given))


def test_rows_that_are_not_there_are_refused(ops):
    points, start = make_points(20, 3, torch.float32), make_map(4, 3, torch.float32)[0]
    for rows in (torch.tensor([3, 20]), torch.tensor([-1])):
        with pytest.raises(RuntimeError, match="row out of range"):
            ops.kmeans(points, start, rows, 1, 5)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axes_of_symmetric_matrices_are_those_of_torch(dim, dtype):
    rows = torch.randn(500, dim, dim, generator=torch.Generator().manual_seed(dim), dtype=dtype)
    rows[:100, :, 0] = 0  # singular
    rows[100:200] = torch.eye(dim, dtype=dtype)
    matrices = rows @ rows.mT
    values, axes = native.symmetric_axes(matrices)
    close = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {}
    torch.testing.assert_close(values, torch.linalg.eigvalsh(matrices), **close)
    torch.testing.assert_close((axes * values[:, None]) @ axes.mT, matrices, **close)
    torch.testing.assert_close(axes.mT @ axes, torch.eye(dim, dtype=dtype).expand_as(axes), **close)
    assert len(native.symmetric_axes(matrices[:0])[0]) == 0
