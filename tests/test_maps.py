import numpy as np
import pytest
import torch
from small_maps import GaussianMap, ball, random_map, wall_map

from lardhm_torch.maps import (
    covariance_scale,
    local_parts,
    log_odds_variance,
    num_neighbors,
    pieces,
    snapshot,
    to_tensor,
)


@pytest.mark.parametrize(
    "values", [[[1, 2], [3, 4]], np.array([[1, 2], [3, 4]]), torch.tensor([[1, 2], [3, 4]])]
)
def test_lists_arrays_and_tensors_become_the_same_float64_tensor(values):
    converted = to_tensor(values, "points")
    assert converted.dtype == torch.float64
    assert converted.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_a_list_of_numbers_of_torch_and_numpy_becomes_a_vector():
    third = torch.tensor(1 / 3, dtype=torch.float64)
    assert to_tensor([third, np.float64(1 / 3), 1 / 3], "points").tolist() == [1 / 3] * 3


def test_arrays_are_copied_and_tensors_keep_their_graph():
    array = np.zeros((2, 3))
    array.flags.writeable = False
    to_tensor(array, "points").add_(1)
    assert (array == 0).all()
    points = torch.ones(2, 3, dtype=torch.float32, requires_grad=True)
    to_tensor(points, "points").sum().backward()
    assert torch.equal(points.grad, torch.ones(2, 3))


@pytest.mark.parametrize("values", ["here", [[1.0], [1.0, 2.0]], None, [None], {"x": 1.0}])
def test_other_values_are_refused_by_name(values):
    with pytest.raises(ValueError, match="points must be a tensor, an array or equally long lists"):
        to_tensor(values, "points")


def test_a_map_without_the_optional_members_is_one_piece_with_all_its_clusters():
    model = random_map(seed=0)
    assert list(pieces(model)) == [model]
    ((rows, part),) = local_parts(model, torch.zeros(4, 3), torch.ones(4, 3))
    assert rows.tolist() == [0, 1, 2, 3]
    assert part is model
    assert num_neighbors(model) == len(model.weights)
    assert covariance_scale(model) == 1.0
    with pytest.raises(ValueError, match="model must have a variance; GaussianMap has none"):
        log_odds_variance(model, torch.zeros(1, 3))


def test_the_optional_members_of_a_lard_map_are_used():
    model = wall_map(num_neighbors=3, covariance_scale=2.0)
    assert num_neighbors(model) == 3
    assert covariance_scale(model) == 2.0
    with pytest.raises(RuntimeError, match="call fit_uncertainty"):
        log_odds_variance(model, torch.zeros(1, 3))


class PlainObject:
    """A map that is no torch module."""

    def __init__(self, inner: GaussianMap) -> None:
        self.dim, self.origin = inner.dim, inner.origin
        self.centers, self.scale_tril, self.weights = inner.centers, inner.scale_tril, inner.weights
        self.log_odds, self.__dict__["answer"] = inner.log_odds, inner

    def __call__(self, points):
        return self.answer(points)


@pytest.mark.parametrize("model", [ball(), PlainObject(ball())])
def test_a_snapshot_does_not_follow_the_map(model):
    copied = snapshot(model)
    before = copied.weights.clone()
    with torch.no_grad():
        model.weights.add_(1)
    assert torch.equal(copied.weights, before)
    assert copied(torch.zeros(1, 3).double()).shape == (1,)
