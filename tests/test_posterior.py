import math

import pytest
import small_maps
import torch
from test_gaussian_process import wall

from lardhm_torch import LardHilbertMap
from lardhm_torch.learning.posterior import (
    PRIOR_VARIANCE,
    latent_variance,
    logistic_curvature,
    moderate,
    posterior_log_odds,
    posterior_scales,
    weight_variances,
)

F64 = torch.float64


def small_problem(count, num_weights, seed=0, overlap=0.2):
    """Dense features of a few weights, and labels drawn from a logistic model of known weights."""
    rng = torch.Generator().manual_seed(seed)
    values = overlap * torch.rand(count, num_weights, generator=rng, dtype=F64)
    own = torch.arange(count) % num_weights
    values[torch.arange(count), own] = 0.5 + 0.5 * torch.rand(count, generator=rng, dtype=F64)
    truth = torch.linspace(-1.5, 1.5, num_weights, dtype=F64)
    labels = (torch.rand(count, generator=rng, dtype=F64) < torch.sigmoid(values @ truth)).to(F64)
    return torch.arange(num_weights).repeat(count, 1), values, labels


def exact_moments(values, labels, prior_variance):
    """Mean and covariance of the posterior of two weights, summed over a fine grid."""
    axis = torch.linspace(-6, 6, 241, dtype=F64)
    weights = torch.cartesian_prod(axis, axis)
    log_odds = weights @ values.T
    log_posterior = -0.5 * weights.square().sum(dim=1) / prior_variance
    log_posterior += torch.nn.functional.logsigmoid(log_odds * (2 * labels - 1)).sum(dim=1)
    mass = torch.softmax(log_posterior, dim=0)
    mean = mass @ weights
    offsets = weights - mean
    return mean, (mass[:, None] * offsets).T @ offsets, weights, mass


@pytest.mark.parametrize(("count", "prior_variance"), [(20, 1.0), (200, 1.0), (60, 4.0)])
def test_variances_are_those_of_the_exact_posterior(count, prior_variance):
    indices, values, labels = small_problem(count, 2)
    mean, covariance, _, _ = exact_moments(values, labels, prior_variance)
    ours = weight_variances(indices, values, values @ mean, 2, prior_variance)
    # the variational bound is a bound, and weights are taken as independent: 20 %
    torch.testing.assert_close(ours, covariance.diagonal(), rtol=0.2, atol=0)


def test_moderated_probability_is_the_exact_expectation():
    indices, values, labels = small_problem(30, 2)
    mean, _, weights, mass = exact_moments(values, labels, 1.0)
    variances = weight_variances(indices, values, values @ mean, 2, 1.0)
    queries = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.7, 0.1], [0.5, 0.5]], dtype=F64)
    exact = torch.sigmoid(weights @ queries.T).T @ mass
    pairs = torch.arange(2).repeat(len(queries), 1)
    spread = (queries.square() * variances[pairs]).sum(dim=1)
    torch.testing.assert_close(moderate(queries @ mean, spread), exact, rtol=0, atol=0.01)
    assert (torch.sigmoid(queries @ mean) - exact).abs().max() > 0.01  # without it: farther off


def test_without_points_the_variance_is_the_prior():
    none = torch.zeros(0, 2, dtype=F64)
    got = weight_variances(none.long(), none, torch.zeros(0, dtype=F64), 3, 0.7)
    torch.testing.assert_close(got, torch.full((3,), 0.7, dtype=F64))


def test_more_points_never_raise_a_variance():
    indices, values, _ = small_problem(50, 4)
    mean = torch.linspace(-1, 1, 4, dtype=F64)
    few = weight_variances(indices[:25], values[:25], values[:25] @ mean, 4)
    many = weight_variances(indices, values, values @ mean, 4)
    assert (many < few).all()
    assert (few < PRIOR_VARIANCE).all()


def test_curvature_by_hand():
    xi = torch.tensor([0.0, 2.0, 1e3], dtype=F64)
    expected = torch.tensor([0.25, math.tanh(1.0) / 4, 1 / 2e3], dtype=F64)
    torch.testing.assert_close(logistic_curvature(xi), expected, rtol=1e-6, atol=0)


def test_latent_variance_by_hand():
    indices, values = torch.tensor([[0, 1]]), torch.tensor([[1.0, 0.5], [0.0, 0.0]], dtype=F64)
    variances = torch.tensor([0.1, 0.4], dtype=F64)
    got = latent_variance(indices.expand(2, 2), values, variances, prior_variance=2.0)
    torch.testing.assert_close(got, torch.tensor([0.2, 2.0], dtype=F64))


def test_half_trained_weights_are_scaled_up_and_overconfident_ones_are_not():
    indices, values, labels = small_problem(4000, 2)
    mean, *_ = exact_moments(values[:500], labels[:500], 1.0)
    scales = []
    for factor in (0.4, 1.0, 3.0):
        log_odds = factor * (values @ mean)
        variances = weight_variances(indices, values, log_odds, 2)
        scales.append(posterior_scales(indices, values, log_odds, labels, variances))
    neutral = scales[2]  # overconfident weights are not made more so
    assert (scales[0] > 1.2 * neutral).all()
    assert (scales[1] < 1.1 * neutral).all()
    assert (neutral < 1.05).all()


def test_either_side_of_the_log_odds_has_its_own_factor():
    mean = torch.tensor([-2.0, -1.0, 0.0, 1.0], dtype=F64)
    got = posterior_log_odds(mean, torch.tensor([3.0, 2.0], dtype=F64))
    torch.testing.assert_close(got, torch.tensor([-6.0, -3.0, 0.0, 2.0], dtype=F64))


# --- the map ---


def doubting_map():
    points, labels = wall(1000)  # 100 clusters of 20 points
    model = LardHilbertMap().double().fit(points, labels)
    return model.fit_uncertainty(points, labels), points, labels


def test_the_maps_own_answers_stay_as_they_were():
    points, labels = wall()
    model = LardHilbertMap().fit(points, labels)
    before = model(points)
    assert torch.equal(model.fit_uncertainty(points, labels)(points), before)


def test_variance_is_small_at_data_and_the_priors_far_away():
    model, points, _ = doubting_map()
    far = torch.full((1, 3), 40.0, dtype=F64)
    torch.testing.assert_close(model.variance(far), torch.tensor([PRIOR_VARIANCE], dtype=F64))
    assert float(model.bayesian_probability(far)) == 0.5
    assert (model.posterior_variances < 0.9 * PRIOR_VARIANCE).all()
    assert model.variance(points).median() < PRIOR_VARIANCE


def test_contradictory_space_is_told_apart_from_space_never_observed():
    points, labels = wall(4000)
    coin = torch.Generator().manual_seed(0)
    torn = points[:, 1] > 0.6
    labels[torn] = (torch.rand(int(torn.sum()), generator=coin) < 0.5).float()
    model = LardHilbertMap().fit(points, labels, num_clusters=100)
    model.fit_uncertainty(points, labels)
    deep = points[(points[:, 1] > 0.7) & (points[:, 0] < 0.7)]
    nowhere = deep + torch.tensor([0.0, 5.0, 0.0])
    for places in (deep, nowhere):  # both undecided
        assert (model.bayesian_probability(places) - 0.5).abs().median() < 0.15
    assert model.variance(deep).median() < 0.5 * model.variance(nowhere).median()


def test_variance_keeps_the_shape_of_the_points_and_of_none():
    model, points, _ = doubting_map()
    block = points[:6].reshape(2, 3, 3)
    torch.testing.assert_close(model.variance(block).reshape(-1), model.variance(points[:6]))
    assert model.variance(points[:0]).shape == (0,)


def test_the_posterior_is_saved_and_loaded(tmp_path):
    model, points, _ = doubting_map()
    model.save(tmp_path / "map.pt")
    again = LardHilbertMap.load(tmp_path / "map.pt")
    assert torch.equal(again.variance(points), model.variance(points))


def test_a_new_fit_forgets_the_posterior():
    model, points, labels = doubting_map()
    with pytest.raises(RuntimeError, match="call fit_uncertainty"):
        model.fit(points, labels).bayesian_probability(points)


def test_moving_and_cropping_keep_the_variance():
    points, labels = small_maps.wall()
    model = small_maps.wall_map().fit_uncertainty(points, labels)
    before = model.variance(points)
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=F64)
    shift = torch.tensor([3.0, 4.0, 5.0], dtype=F64)
    model.transform(turn, shift)
    moved = points @ turn.T + shift
    torch.testing.assert_close(model.variance(moved), before)
    model.crop(moved.mean(dim=0), 9.0)
    torch.testing.assert_close(model.variance(moved), before)
    model.crop(moved[0], 0.8)
    assert 0 < len(model) < 40
    assert (model.posterior_variances > 0).all()


def test_an_empty_map_has_no_uncertainty():
    with pytest.raises(ValueError, match="must be fitted before its uncertainty"):
        LardHilbertMap().fit_uncertainty(*wall(5))
    with pytest.raises(RuntimeError, match="call fit_uncertainty"):
        LardHilbertMap().variance(torch.zeros(1, 3))
