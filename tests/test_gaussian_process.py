import math

import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from lardhm_torch.evaluation.baselines.gaussian_process import (
    Hyperparameters,
    condition,
    learn_hyperparameters,
    learn_squash,
    leave_one_out,
    predict,
    squared_exponential,
    squash,
    thin_plate,
)
from lardhm_torch.evaluation.baselines.gp_implicit_surface import GPImplicitSurface
from lardhm_torch.evaluation.baselines.gp_occupancy_map import MAX_POINTS, GPOccupancyMap

F64 = torch.float64
SCALE = Hyperparameters(*torch.tensor([0.4, 1.5, 0.05], dtype=F64))


def random_problem(count=30, seed=0):
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 2, generator=rng, dtype=F64)
    return points, (points[:, 0] > 0.5).to(F64) * 2 - 1, torch.ones(count, dtype=torch.bool)


def wall(count=300, seed=0):
    """Points of a wall at x = 1 and of the free space before it, in 3-D."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(2 * count, 3, generator=rng, dtype=F64)
    points[:count, 0] = 1 + 0.01 * torch.randn(count, generator=rng, dtype=F64)
    points[count:, 0] *= 0.8
    labels = (torch.arange(2 * count) < count).float()
    return points, labels


def test_mean_and_variance_are_those_of_scikit_learn():
    points, targets, present = random_problem()
    queries = random_problem(10, seed=1)[0]
    kernel = ConstantKernel(1.5) * RBF(0.4)
    oracle = GaussianProcessRegressor(kernel, alpha=0.05, optimizer=None).fit(points, targets)
    expected, spread = oracle.predict(queries, return_std=True)
    posterior = condition(points[None], targets[None], present[None], squared_exponential, SCALE)
    mean, variance = predict(posterior, queries[None], squared_exponential, SCALE)
    torch.testing.assert_close(mean[0], torch.as_tensor(expected))
    torch.testing.assert_close(variance[0], torch.as_tensor(spread**2))


def test_padding_changes_nothing():
    points, targets, present = random_problem()
    padded = torch.cat([points, points.new_full((7, 2), 0.5)])
    more = torch.cat([targets, targets.new_full((7,), 9.0)])
    which = torch.cat([present, torch.zeros(7, dtype=torch.bool)])
    queries = random_problem(10, seed=1)[0][None]
    plain = condition(points[None], targets[None], present[None], squared_exponential, SCALE)
    with_padding = condition(padded[None], more[None], which[None], squared_exponential, SCALE)
    for ours, expected in zip(
        predict(with_padding, queries, squared_exponential, SCALE),
        predict(plain, queries, squared_exponential, SCALE),
        strict=True,
    ):
        torch.testing.assert_close(ours, expected)


def test_leave_one_out_is_what_leaving_out_gives():
    points, targets, present = random_problem(12)
    full = condition(points[None], targets[None], present[None], squared_exponential, SCALE)
    mean, variance = leave_one_out(full, targets[None], SCALE)
    for row in range(len(points)):
        rest = torch.arange(len(points)) != row
        few = condition(
            points[None, rest], targets[None, rest], present[None, rest], squared_exponential, SCALE
        )
        expected = predict(few, points[None, row : row + 1], squared_exponential, SCALE)
        torch.testing.assert_close(mean[0, row], expected[0][0, 0])
        torch.testing.assert_close(variance[0, row], expected[1][0, 0])


def test_learning_raises_the_marginal_likelihood():
    points, targets, present = (tensor[None] for tensor in random_problem(60))

    def evidence(scale):
        posterior = condition(points, targets, present, squared_exponential, scale)
        diagonal = posterior.factor.diagonal(dim1=-2, dim2=-1)
        return float(-0.5 * (targets * posterior.coefficients).sum() - diagonal.log().sum())

    start = Hyperparameters(*torch.tensor([0.05, 1.0, 0.5], dtype=F64))
    learned = learn_hyperparameters(points, targets, present, squared_exponential, start)
    assert evidence(learned) > evidence(start) + 1
    kept = learn_hyperparameters(points, targets, present, squared_exponential, start, False)
    assert float(kept.lengthscale) == 0.05


def test_thin_plate_by_hand():
    distances = torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=F64)
    size = torch.tensor(2.0, dtype=F64)
    torch.testing.assert_close(
        thin_plate(distances, size), torch.tensor([1.0, 0.5, 0.0, 0.0], dtype=F64)
    )


def test_squash_is_the_expected_probit():
    mean, variance = torch.tensor([0.7], dtype=F64), torch.tensor([2.0], dtype=F64)
    steepness = torch.tensor(1.5, dtype=F64)
    grid = torch.linspace(-12, 12, 4001, dtype=F64)
    density = torch.exp(-0.5 * (grid - 0.7) ** 2 / 2) / math.sqrt(4 * math.pi)
    expected = torch.trapezoid(torch.special.ndtr(1.5 * grid) * density, grid)
    torch.testing.assert_close(squash(mean, variance, steepness)[0], expected)


def test_overlapping_classes_give_a_flatter_squash():
    rng = torch.Generator().manual_seed(0)
    labels = (torch.arange(400) % 2).to(F64)
    variance = torch.full((400,), 0.1, dtype=F64)
    noise = torch.randn(400, generator=rng, dtype=F64)
    apart, mixed = 2 * labels - 1 + 0.1 * noise, 2 * labels - 1 + 2 * noise
    assert learn_squash(mixed, variance, labels) < learn_squash(apart, variance, labels)


@pytest.mark.parametrize("method", [GPOccupancyMap, GPImplicitSurface])
def test_exact_processes_map_a_wall(method):
    points, labels = wall()
    model = method().fit(points, labels)
    unseen, truth = wall(seed=1)
    right = ((model(unseen) > 0.5) == (truth > 0.5)).double().mean()
    assert right > 0.97
    far = torch.tensor([[50.0, 50.0, 50.0]], dtype=F64)
    torch.testing.assert_close(model(far), torch.tensor([0.5], dtype=F64))
    assert model.variance(far) > 10 * model.variance(unseen).median()


@pytest.mark.parametrize("method", [GPOccupancyMap, GPImplicitSurface])
def test_exact_processes_ignore_where_the_world_origin_is(method):
    points, labels = wall(60)
    shift = torch.tensor([5e5, 4e6, 100.0], dtype=F64)
    here, there = method().fit(points, labels), method().fit(points + shift, labels)
    torch.testing.assert_close(there(points + shift), here(points), atol=1e-5, rtol=1e-5)


def test_what_an_exact_process_cannot_do_is_refused():
    with pytest.raises(ValueError, match=f"at most {MAX_POINTS}.*cubic.*got {MAX_POINTS + 1}"):
        GPOccupancyMap().fit(torch.zeros(MAX_POINTS + 1, 3), torch.zeros(MAX_POINTS + 1))
    with pytest.raises(RuntimeError, match="call fit"):
        GPOccupancyMap()(torch.zeros(1, 3))
    model = GPOccupancyMap().fit(*wall(20))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\); got \(1, 2\)"):
        model(torch.zeros(1, 2))
    with pytest.raises(ValueError, match="labels must be 0 or 1"):
        GPOccupancyMap().fit(torch.zeros(2, 3), torch.tensor([-1.0, 1.0]))
