"""Uncertainty of a map by Bayesian logistic regression of the weights.

The paper leaves this open (Section IV-A: "can be extended to provide this variance information by
substituting the LR classifier with a Bayesian regression technique"). The posterior of the weights is
a Gaussian with diagonal covariance, so the cost is O(N k). The two kinds of uncertainty can be
distinguished: where data are contradictory, the probability is near 1/2 and the variance is small;
where there are no data, the probability is near 1/2 and the variance is that of the prior.

This is a calibrated heuristic, not one Bayesian model. The weights are trained with the prior of the
L2 term of `FitConfig`, which is wider than `PRIOR_VARIANCE`, and covariances between them are
neglected. `PRIOR_VARIANCE`, `VARIANCE_FACTOR` and `DAMPING_EXPONENTS` compensate for that. They were
chosen by the log-loss of `bayesian_probability` on held-out rays of the data sets of the benchmarks,
so figures on these sets are not independent of that choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.learning.class_balance import balance_classes

FeaturesAt = Callable[[Tensor], tuple[Tensor, Tensor]]

PRIOR_VARIANCE = 0.3  # of a weight, and of the log-odds far from all clusters (empirical)
QUERY_CHUNK = 1 << 17  # number of points processed at a time
# Factor on the variance in `moderate`. The diagonal posterior ignores that the weights of overlapping
# clusters are negatively correlated, so it overestimates the variance. Empirical.
VARIANCE_FACTOR = 1 / 3
ROUNDS = 3  # of the variational bound; the third round changes variances by less than 2 %
SCALES = (0.5, 4.0, 43)  # search grid of factors on the log-odds: first, last, number
SCALE_POINTS = 50_000  # approximate number of points used to choose the factors
# Exponents that damp the factors found by leave-one-out: effect of the factor of occupied log-odds on
# the free ones (in addition to the second), on both, and of the free ones on themselves. Chosen
# empirically on held-out rays of all data sets.
DAMPING_EXPONENTS = (0.3, 0.3, 0.04)
MAX_LEVERAGE = 0.8  # upper bound on the leverage term, beyond which the expansion is invalid


def weight_variances(
    indices: Tensor,
    values: Tensor,
    log_odds: Tensor,
    num_clusters: int,
    prior_variance: float = PRIOR_VARIANCE,
) -> Tensor:
    """(M,) posterior variances of the weights, given their training points.

    1 / v_m = 1 / v_0 + sum_i 2 lambda(xi_i) phi_im^2, with lambda(xi) = tanh(xi / 2) / (4 xi) and
    xi_i^2 the expected square of the log-odds at point i. This is the variational bound on the
    logistic function. The curvature p (1 - p) of the Laplace approximation vanishes where the map is
    confident, so it would give the largest variances to the best observed places. Covariances
    between weights are neglected.

    Args:
        indices: (N, K) nearest clusters of each training point.
        values: (N, K) their kernel values.
        log_odds: (N,) log-odds of the trained map at these points.
        num_clusters: M.
        prior_variance: v_0, prior variance of every weight.

    Source: Jaakkola & Jordan 2000, "Bayesian parameter estimation via variational methods", eq.
    (8) and (10), with independent weights.
    """
    flat, squares = indices.reshape(-1), values.square()
    variances = values.new_full((num_clusters,), prior_variance)
    for _ in range(ROUNDS):
        expected = log_odds.square() + (squares * variances[indices]).sum(dim=1)
        curvature = logistic_curvature(expected.sqrt())
        evidence = (curvature[:, None] * squares).reshape(-1)
        total = torch.zeros_like(variances).index_add_(0, flat, evidence)
        variances = 1 / (1 / prior_variance + total)
    return variances


def logistic_curvature(xi: Tensor) -> Tensor:
    """2 lambda(xi) = tanh(xi / 2) / (2 xi): 1/4 at 0, asymptotically 1 / (2 xi)."""
    xi = xi.clamp(min=1e-4)
    return torch.tanh(xi / 2) / (2 * xi)


def latent_variance(
    indices: Tensor, values: Tensor, variances: Tensor, prior_variance: float = PRIOR_VARIANCE
) -> Tensor:
    """(N,) variance of the log-odds, from the weights near clusters and from the prior elsewhere.

    sum_m phi_m^2 v_m + v_0 prod_m (1 - phi_m^2). The first term alone would vanish far from all
    clusters, where the uncertainty is largest. The second term is the contribution of an additional
    basis function at the query point, whose weight has the prior variance.

    Args:
        indices: (N, K) nearest clusters of each point.
        values: (N, K) their kernel values.
        variances: (M,) posterior variances of the weights.
        prior_variance: v_0, prior variance of every weight.

    Source: the augmentation is that of Rasmussen & Quinonero-Candela 2005, "Healing the relevance
    vector machine through augmentation"; the product in place of their per-point posterior is ours.
    """
    squares = values.square()
    explained = (squares * variances[indices]).sum(dim=1)
    return explained + prior_variance * (1 - squares).prod(dim=1)


def moderate(log_odds: Tensor, variance: Tensor) -> Tensor:
    """Expected probability under Gaussian log-odds: sigmoid(f / sqrt(1 + pi v / 8)).

    Source: MacKay 1992, "The evidence framework applied to classification networks".
    """
    return torch.sigmoid(log_odds / (1 + math.pi / 8 * variance).sqrt())


def posterior_log_odds(mean: Tensor, scales: Tensor) -> Tensor:
    """(N,) log-odds of the trained map and (2,) `posterior_scales` -> (N,) posterior mean."""
    return torch.where(mean < 0, scales[0], scales[1]) * mean


def posterior_scales(
    indices: Tensor, values: Tensor, log_odds: Tensor, labels: Tensor, variances: Tensor
) -> Tensor:
    """Factors on free (negative) and occupied (positive) log-odds, from leave-one-out predictions.

    Regularization and early stopping have already shrunk the weights toward 0, and moderation would
    shrink the log-odds again. For each sign of the log-odds, the factor sqrt(1 + pi v / 8), with the
    median over the points, compensates for this. It is multiplied by powers of the ratio between the
    factor with the smallest balanced log-loss of moderated leave-one-out predictions and the
    compensating factor, with the exponents `DAMPING_EXPONENTS`. The ratio of the occupied points
    affects both factors, that of the free points has little effect. Training points leave a gap in
    front of each hit, so free training points are easier to classify than those of unseen rays.

    To first order, leaving out point i changes its log-odds by h_i (p_i - y_i) / (1 - h_i c_i), with
    leverage h_i = `VARIANCE_FACTOR` * sum_m phi_im^2 v_m and curvature c_i.

    Args:
        indices: (N, K) nearest clusters of each training point.
        values: (N, K) their kernel values.
        log_odds: (N,) log-odds of the trained map at these points.
        labels: (N,) 1 occupied, 0 free.
        variances: (M,) posterior variances of the weights.

    Returns:
        (2,) factors on free and on occupied log-odds.
    """
    some = slice(None, None, 1 + len(labels) // SCALE_POINTS)
    indices, values, log_odds, labels = (t[some] for t in (indices, values, log_odds, labels))
    residuals = torch.sigmoid(log_odds) - labels
    leverage = VARIANCE_FACTOR * (values.square() * variances[indices]).sum(dim=1)
    expected = (log_odds.square() + leverage).sqrt()
    damping = 1 - (leverage * logistic_curvature(expected)).clamp(max=MAX_LEVERAGE)
    left_out = log_odds + leverage * residuals / damping
    variance = VARIANCE_FACTOR * latent_variance(indices, values, variances)
    points = torch.stack([left_out, variance, labels, balance_classes(labels)])
    neutral, excess = torch.stack(
        [_scale_of_side(points[:, side]) for side in (left_out < 0, left_out >= 0)]
    ).T
    free, both, free_itself = DAMPING_EXPONENTS
    powers = excess.new_tensor([[free_itself, both + free], [0.0, both]])
    return neutral * (excess.log() * powers).sum(dim=1).exp()


def _scale_of_side(points: Tensor) -> Tensor:
    """(2,) compensating factor, and ratio (at least 1) of the best factor to it; ones if no points.

    Args:
        points: (4, S) leave-one-out log-odds, their variances, labels and loss factors.
    """
    left_out, variance, labels, factors = points
    if not len(labels):
        return points.new_ones(2)
    neutral = (1 + math.pi / 8 * variance).sqrt().median()
    first, last, count = SCALES
    tried = first * (last / first) ** (torch.arange(count) / (count - 1))
    loss = torch.nn.functional.binary_cross_entropy
    losses = [loss(moderate(scale * left_out, variance), labels, factors) for scale in tried]
    best = tried[int(torch.stack(losses).argmin())].to(neutral)
    return torch.stack([neutral, (best / neutral).clamp(min=1)])


class Posterior(NamedTuple):
    """Posterior of the weights: (M,) means, (M,) variances, and (2,) `posterior_scales`."""

    means: Tensor
    variances: Tensor
    scales: Tensor


def fit_posterior(indices: Tensor, values: Tensor, weights: Tensor, labels: Tensor) -> Posterior:
    """Posterior of trained weights, given the features and labels of their training points.

    Args:
        indices: (N, K) nearest clusters of each training point.
        values: (N, K) their kernel values.
        weights: (M,) weights of the map.
        labels: (N,) 1 occupied, 0 free.
    """
    log_odds = (values * weights[indices]).sum(dim=1)
    variances = weight_variances(indices, values, log_odds, len(weights))
    scales = posterior_scales(indices, values, log_odds, labels.to(values.dtype), variances)
    return Posterior(weights.detach().clone(), variances, scales)


def predict(features_of: FeaturesAt, points: Tensor, posterior: Posterior) -> tuple[Tensor, Tensor]:
    """(N,) mean and (N,) variance of the log-odds at (N, D) points, computed in chunks.

    Args:
        features_of: function of (B, D) points that returns (B, K) indices and kernel values.
        points: (N, D) positions in the frame of ``features_of`` [m].
        posterior: posterior of the weights.
    """
    parts = []
    for chunk in points.split(QUERY_CHUNK):
        indices, values = features_of(chunk)
        mean = posterior_log_odds((values * posterior.means[indices]).sum(dim=1), posterior.scales)
        parts.append(torch.stack([mean, latent_variance(indices, values, posterior.variances)]))
    mean, variance = torch.cat(parts, dim=1)
    return mean, variance
