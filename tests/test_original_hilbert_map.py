import pytest
import torch
from test_gaussian_process import wall

from lardhm_torch.evaluation.baselines.original_hilbert_map import (
    SUPPORT_RADIUS,
    KernelApproximationMap,
    OriginalHilbertMap,
)

F64 = torch.float64


def fitted(**settings):
    return OriginalHilbertMap(0.2, dtype=F64, **settings).fit(*wall())


def nodes(model):
    """(M, D) positions of all nodes [m], in the order of the weights."""
    axes = [torch.arange(n, dtype=F64) * model.spacing for n in model.shape.tolist()]
    return torch.cartesian_prod(*axes) + model.origin


def test_features_are_the_kernel_at_all_nodes_in_reach():
    model = fitted()
    points = wall(10, seed=1)[0]
    index, values = model.features(points)
    dense = torch.zeros(len(points), len(nodes(model)), dtype=F64)
    dense.scatter_(1, index.long(), values)
    distances = torch.cdist(points, nodes(model)) / 0.2
    expected = torch.exp(-0.5 * distances**2)
    inner = distances < SUPPORT_RADIUS - 1  # of the nearest node, which is at most sqrt(3) / 2 away
    torch.testing.assert_close(dense[inner], expected[inner])
    assert ((dense == 0) | (dense - expected).abs().lt(1e-12)).all()


def test_it_maps_a_wall_and_knows_nothing_outside_its_lattice():
    model = fitted()
    unseen, truth = wall(seed=1)
    assert ((model(unseen) > 0.5) == (truth > 0.5)).double().mean() > 0.97
    assert float(model(torch.full((1, 3), 50.0))) == 0.5


def test_two_dimensions_work_as_well():
    points, labels = wall()
    model = OriginalHilbertMap(0.2).fit(points[:, :2], labels)
    assert ((model(points[:, :2]) > 0.5) == (labels > 0.5)).double().mean() > 0.97


def test_moving_the_world_by_whole_cells_changes_nothing():
    points, labels = wall(60)
    shift = torch.tensor([2e4, 6e4, 100.0], dtype=F64)
    here = OriginalHilbertMap(0.25, dtype=F64).fit(points, labels)(points)
    there = OriginalHilbertMap(0.25, dtype=F64).fit(points + shift, labels)(points + shift)
    torch.testing.assert_close(there, here)


def test_the_same_seed_gives_the_same_weights():
    assert torch.equal(fitted(seed=3).weights, fitted(seed=3).weights)
    assert not torch.equal(fitted(seed=3).weights, fitted(seed=4).weights)


def test_a_lattice_too_large_is_refused():
    points = torch.tensor([[0.0, 0.0, 0.0], [1e4, 1e4, 1e4]])
    with pytest.raises(
        ValueError, match=r"spacing must give at most.*for 0.2 m. Raise the spacing"
    ):
        OriginalHilbertMap(0.2).fit(points, torch.tensor([0.0, 1.0]))


@pytest.mark.parametrize("method", ["fourier", "nystroem"])
def test_global_features_map_a_wall(method):
    model = KernelApproximationMap(method, 400, 0.3).fit(*wall())
    unseen, truth = wall(seed=1)
    answer = model(unseen)
    assert ((answer > 0.5) == (truth > 0.5)).double().mean() > 0.97
    assert answer.shape == (len(unseen),)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="spacing and lengthscale must be > 0; got 0"):
        OriginalHilbertMap(0.0)
    with pytest.raises(RuntimeError, match="call fit"):
        OriginalHilbertMap()(torch.zeros(1, 3))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\)"):
        fitted()(torch.zeros(1, 2))
    with pytest.raises(ValueError, match="method must be one of fourier, nystroem; got 'sparse'"):
        KernelApproximationMap("sparse")
    with pytest.raises(ValueError, match="num_features must be 1 or more"):
        KernelApproximationMap(num_features=0)
    with pytest.raises(ValueError, match="labels must hold both classes"):
        KernelApproximationMap().fit(torch.zeros(2, 3), torch.zeros(2))
    with pytest.raises(RuntimeError, match="call fit"):
        KernelApproximationMap()(torch.zeros(1, 3))
