"""The native ridge search and neighbor means against their definitions."""

import numpy as np
import pytest
import torch
from small_maps import wall_map

from lardhm_torch.native import available
from lardhm_torch.surfaces import ridge
from lardhm_torch.surfaces.ridge import (
    mean_with_neighbors,
    plain_mean_with_neighbors,
    ridge_positions,
)

pytestmark = pytest.mark.skipif(not available(), reason="no compiler: the kernel is not built")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lines_end_on_the_ridge_of_the_definition(dtype, monkeypatch):
    model, rng = wall_map(dtype=dtype), torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=rng, dtype=torch.float64) * 2
    points[:, 0] = 0.7 + 0.5 * points[:, 0] / 2
    strides = 0.02 * torch.randn(3000, 3, generator=rng, dtype=torch.float64)
    strides[:2000, 0] = -0.03
    found = ridge_positions(model, points, strides)
    monkeypatch.setattr(ridge, "native_map", lambda _: None)
    expected = ridge_positions(model, points, strides)
    assert 500 < expected.isfinite().sum() < 2900
    assert (found.isnan() == expected.isnan()).double().mean() > 0.999  # float32: ties at an end
    both = found.isfinite() & expected.isfinite()
    tolerance = 1e-9 if dtype == torch.float64 else 0.02
    assert ((found - expected)[both].abs() <= tolerance).double().mean() > 0.995


def test_lines_without_a_map_or_without_points_have_no_ridge():
    from lardhm_torch import LardHilbertMap

    nowhere = ridge_positions(
        LardHilbertMap(), torch.zeros(2, 3).double(), torch.ones(2, 3).double()
    )
    assert nowhere.isnan().all()
    assert (
        len(ridge_positions(wall_map(), torch.zeros(0, 3).double(), torch.zeros(0, 3).double()))
        == 0
    )


def test_means_over_neighbors_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(300, 3))
    values[rng.integers(0, 300, 60), 1] = np.nan
    faces = rng.integers(0, 300, (400, 3))
    found, expected = (f(values, faces) for f in (mean_with_neighbors, plain_mean_with_neighbors))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.isnan(found).any()


def test_faces_that_name_no_vertex_are_refused():
    with pytest.raises(RuntimeError, match="faces must hold rows of the values"):
        mean_with_neighbors(np.zeros((2, 1)), np.array([[0, 1, 2]]))
