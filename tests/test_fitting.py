import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression

from lardhm_torch import native
from lardhm_torch.features import Kernel, kernel_factors, nearest_features
from lardhm_torch.learning import fitting
from lardhm_torch.learning.class_balance import balance_classes
from lardhm_torch.learning.fitting import (
    FitConfig,
    batch_gradient,
    fit_weights,
    logistic_loss,
    stratified_batches,
)

F64 = torch.float64


def problem(points=600, clusters=12, seed=0, share=0.3):
    """Overlapping classes with K = 3 features a point."""
    rng = torch.Generator().manual_seed(seed)
    indices = torch.rand(points, clusters, generator=rng).topk(3).indices.sort(dim=1).values
    values = torch.rand(points, 3, generator=rng, dtype=F64)
    truth = torch.randn(clusters, generator=rng, dtype=F64) * 2
    logit = (values * truth[indices]).sum(dim=1) + np.log(share / (1 - share))
    labels = (torch.rand(points, generator=rng, dtype=F64) < torch.sigmoid(logit)).to(F64)
    return indices, values, labels


def dense(indices, values, clusters):
    return torch.zeros(len(indices), clusters, dtype=F64).scatter_(1, indices, values)


def fit(indices, values, labels, clusters, **settings):
    start = torch.zeros(clusters, dtype=F64)
    features_of = lambda rows: (indices[rows], values[rows])  # noqa: E731
    return fit_weights(features_of, labels, start, FitConfig(**settings))


@pytest.mark.parametrize("balance", [True, False])
def test_weights_reach_scikit_learns_optimum_with_the_classes_in_the_shares_asked(balance):
    indices, values, labels = problem()
    ours = fit(
        indices,
        values,
        labels,
        12,
        passes=600,
        batch_size=600,
        l2=0.5,
        balance=balance,
        occupied_share=0.6,
    )
    occupied, total = int(labels.sum()), len(labels)
    shares = {0: 0.4 * total / (total - occupied), 1: 0.6 * total / occupied}
    exact = LogisticRegression(
        C=1.0, fit_intercept=False, class_weight=shares if balance else None, tol=1e-10
    ).fit(dense(indices, values, 12), labels)
    np.testing.assert_allclose(ours, exact.coef_[0], atol=2e-3)


def test_l1_reaches_scikit_learns_optimum_and_makes_weights_exactly_zero():
    indices, values, labels = problem()
    ours = fit(
        indices, values, labels, 12, passes=800, batch_size=600, l2=0.0, l1=12.0, balance=False
    )
    exact = LogisticRegression(
        C=1 / 12.0, l1_ratio=1.0, solver="saga", fit_intercept=False, tol=1e-8, max_iter=20000
    ).fit(dense(indices, values, 12), labels)
    np.testing.assert_allclose(ours, exact.coef_[0], atol=2e-2)
    assert torch.equal(ours == 0, torch.as_tensor(exact.coef_[0] == 0))
    assert (ours == 0).any()


def test_the_papers_sgd_is_one_step_a_point_against_the_gradient():
    indices, values, labels = problem(points=5, clusters=4)
    paper = {"passes": 1, "batch_size": 1, "learning_rate": 0.1, "decay": False}
    ours = fit(indices, values, labels, 4, **paper, preconditioner=False, l2=0, balance=False)
    weights = torch.zeros(4, dtype=F64)
    for row in range(5):
        phi = dense(indices[row : row + 1], values[row : row + 1], 4)[0]
        weights = weights - 0.1 * (torch.sigmoid(phi @ weights) - labels[row]) * phi
    torch.testing.assert_close(ours, weights)


def test_the_gradient_equals_autograd():
    indices, values, labels = problem()
    weights = torch.randn(12, dtype=F64, requires_grad=True)
    factors = balance_classes(labels)
    logistic_loss((values * weights[indices]).sum(dim=1), labels, factors).backward()
    ours = batch_gradient(indices, values, labels, factors, weights.detach())
    torch.testing.assert_close(ours, weights.grad)


def test_the_default_is_within_a_percent_of_the_optimum():
    indices, values, labels = problem(points=20000, clusters=200)
    factors = balance_classes(labels, FitConfig().occupied_share)

    def loss(weights):
        return float(logistic_loss((values * weights[indices]).sum(dim=1), labels, factors))

    default = loss(fit(indices, values, labels, 200))
    assert default <= 1.01 * loss(fit(indices, values, labels, 200, passes=100))


def test_both_classes_weigh_the_same_however_rare_one_is():
    labels = torch.tensor([1.0] + [0.0] * 16)
    factors = balance_classes(labels)
    torch.testing.assert_close(factors[labels == 1].sum(), factors[labels == 0].sum())
    torch.testing.assert_close(factors.mean(), torch.tensor(1.0))
    assert torch.equal(balance_classes(torch.ones(4)), torch.ones(4))
    leaning = balance_classes(labels, occupied_share=0.6)
    torch.testing.assert_close(leaning[labels == 1].sum() / leaning.sum(), torch.tensor(0.6))


def test_the_start_is_left_alone():
    indices, values, labels = problem()
    start = torch.ones(12, dtype=F64)
    features_of = lambda rows: (indices[rows], values[rows])  # noqa: E731
    assert not torch.equal(fit_weights(features_of, labels, start, FitConfig()), start)
    assert torch.equal(start, torch.ones(12, dtype=F64))


def test_features_are_computed_once_where_kept_and_else_anew_for_every_two_passes(monkeypatch):
    indices, values, labels = problem()
    calls = []

    def features_of(rows):
        calls.append(rows.stop - rows.start)
        return indices[rows], values[rows]

    def fit_in_chunks():
        calls.clear()
        start = torch.zeros(12, dtype=F64)
        return fit_weights(features_of, labels, start, FitConfig(passes=4, batch_size=50))

    whole = fit_in_chunks()
    assert calls == [600]
    monkeypatch.setattr(fitting, "CHUNK_ROWS", 120)  # two whole batches
    torch.testing.assert_close(fit_in_chunks(), whole)
    assert calls == [100] * 6
    monkeypatch.setattr(fitting, "CACHE_BYTES", 3 * 100 * (3 * 8 + 3 * 8))
    torch.testing.assert_close(fit_in_chunks(), whole, atol=0.2, rtol=0)  # another order of steps
    assert calls == [100] * (3 + 3 * 2)


@pytest.mark.parametrize(("count", "batch_size"), [(1, 5), (97, 10), (600, 7), (600, 1000)])
def test_stratified_batches_hold_every_sample_once_and_each_batch_covers_all_of_them(
    count, batch_size
):
    rows = torch.arange(count)
    batched, twice = stratified_batches(
        (rows, 2.0 * rows), batch_size, torch.Generator().manual_seed(0)
    )
    torch.testing.assert_close(twice, 2.0 * batched)
    torch.testing.assert_close(batched.sort().values, rows)
    batches = -(-count // batch_size)
    descents = (batched.diff() < 0).nonzero().squeeze(1) + 1
    parts = batched.tensor_split(descents)  # a batch ascends
    assert len(parts) == batches
    for part in parts:
        edges = torch.cat([torch.tensor([-1]), part, torch.tensor([count])])
        assert (edges.diff() <= 2 * batches).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"passes": 0}, "passes must be 1 or more, or None; got 0"),
        ({"batch_size": 0}, "batch_size must be 1 or more; got 0"),
        ({"learning_rate": 0.0}, "learning_rate must be > 0; got 0"),
        ({"l1": -1.0}, "l1 must be 0 or more; got -1"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        FitConfig(**settings)


@pytest.mark.skipif(not native.available(), reason="the native kernel is not available")
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize(
    "settings",
    [{}, {"l1": 5.0, "balance": False}, {"preconditioner": False, "decay": False, "batch_size": 7}],
)
def test_the_fused_passes_equal_the_plain_ones(dtype, settings):
    indices, values, labels = problem(points=2000)
    values, labels = values.to(dtype), labels.to(dtype)
    config, start = FitConfig(**settings), torch.zeros(12, dtype=dtype)
    fused, plain = (
        fit_weights(
            lambda rows, given=given: (given[rows], values[rows]),
            labels, start, config,
        )
        for given in (indices.int(), indices)
    )  # fmt: skip
    # float32 sums of a batch are added in another order
    tolerance = 1e-3 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(fused, plain, atol=tolerance, rtol=tolerance)


@pytest.mark.skipif(not native.available(), reason="the native kernel is not available")
def test_the_fused_pass_refuses_rows_that_are_not_there():
    indices, values, labels = problem()
    start, wrong = torch.zeros(12, dtype=F64), indices.int() + 5
    with pytest.raises(RuntimeError, match="index out of range"):
        fit_weights(lambda rows: (wrong[rows], values[rows]), labels, start, FitConfig())


@pytest.mark.skipif(not native.available(), reason="the native kernel is not available")
@pytest.mark.parametrize("dim", [2, 3])
def test_native_training_features_equal_the_definition(dim):
    rng = torch.Generator().manual_seed(0)
    points, centers = (torch.randn(n, dim, generator=rng, dtype=F64) for n in (500, 60))
    raw = torch.randn(60, dim, dim, generator=rng, dtype=F64)
    kernel = Kernel(5, covariance_scale=3.0, min_lengthscale=0.5)
    expected = nearest_features(points, centers, kernel_factors(raw, kernel), 5)
    found = native.nearest_features(points, centers, raw, kernel, native.build_index(centers, 5))
    assert torch.equal(found[0].long(), expected[0])
    torch.testing.assert_close(found[1], expected[1])


@given(count=st.integers(1, 100_000), asked=st.one_of(st.none(), st.integers(1, 5000)))
def test_all_batches_of_a_pass_are_about_equally_large(count, asked):
    size = FitConfig(batch_size=asked).rows_per_batch(count)
    batches = -(-count // size)
    last = count - (batches - 1) * size
    assert size <= (asked or max(256, count // 128))
    assert size - last < batches  # by less than one point a batch


def test_few_points_get_as_many_steps_as_many():
    assert FitConfig().passes_over(10**6) == 4
    for count in (1, 50, 300, 5000):
        batches = -(-count // FitConfig().rows_per_batch(count))
        assert FitConfig().passes_over(count) * batches >= 256
    assert FitConfig(passes=1).passes_over(50) == 1
