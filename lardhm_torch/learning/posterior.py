"""How sure a map is: the weights as a Bayesian logistic regression, on functions of tensors.

The paper leaves this open (Section IV-A: "can be extended to provide this variance information by
substituting the LR classifier with a Bayesian regression technique"). The posterior of the weights
is a Gaussian with one variance for each, so everything costs a multiple of N k. Two kinds of doubt
become two numbers: where data contradict each other the probability is near 1/2 and the variance
small; where nothing was observed both say so, the variance being that of the prior.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.learning.fitting import balance_classes

FeaturesAt = Callable[[Tensor], tuple[Tensor, Tensor]]

PRIOR_VARIANCE = 0.3  # of a weight, and of the log-odds where no cluster reaches; by measurement
QUERY_CHUNK = 1 << 17  # points whose features are held at a time
# Of a variance, what moderates a probability: variances of single weights leave out that the weights
# of overlapping clusters make up for each other, and overstate the doubt. By measurement.
OWN_SHARE = 1 / 3
ROUNDS = 3  # of the variational bound; the third changes the variances by less than 2 %
SCALES = (0.5, 4.0, 43)  # first, last and number of the factors on the log-odds that are tried
SCALE_POINTS = 50_000  # about as many points choose the factors, evenly taken
# Powers of the factors that left-out points ask for: of the occupied side's, more on the free side
# and on both; of the free side's on itself. By measurement on held-out rays of all sets.
TRUST = (0.3, 0.3, 0.04)
MAX_LEVERAGE = 0.8  # of one point on its own prediction, beyond which the expansion is not trusted


def weight_variances(
    indices: Tensor,
    values: Tensor,
    log_odds: Tensor,
    num_clusters: int,
    prior_variance: float = PRIOR_VARIANCE,
) -> Tensor:
    """(M,) posterior variance of every weight, given the points the weights were trained on.

    1 / v_m = 1 / v_0 + sum_i 2 lambda(xi_i) phi_im^2, with lambda(xi) = tanh(xi / 2) / (4 xi) and
    xi_i^2 the expected square of the log-odds at point i: the variational bound on the logistic
    function. Laplace's p (1 - p) in its place vanishes where the map is sure, and would call the
    best observed places the least known. Covariances of weights are left out.

    Args:
        indices: (N, K) clusters that answer for each training point.
        values: (N, K) their kernel values.
        log_odds: (N,) of the trained map at these points.
        num_clusters: M.
        prior_variance: v_0 of every weight.

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
    """2 lambda(xi) = tanh(xi / 2) / (2 xi): 1/4 at 0, falling as 1 / (2 xi)."""
    xi = xi.clamp(min=1e-4)
    return torch.tanh(xi / 2) / (2 * xi)


def latent_variance(
    indices: Tensor, values: Tensor, variances: Tensor, prior_variance: float = PRIOR_VARIANCE
) -> Tensor:
    """(N,) variance of the log-odds: that of the weights, and the prior's where none reaches.

    sum_m phi_m^2 v_m + v_0 prod_m (1 - phi_m^2). The first part alone vanishes far from all
    clusters, as if a map were surest where it knows nothing; the second is the remedy of an
    imagined basis function at the query that no data have touched.

    Args:
        indices: (N, K) clusters that answer for each point.
        values: (N, K) their kernel values.
        variances: (M,) of the weights.
        prior_variance: v_0.

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
    """(N,) log-odds of the trained map and (2,) factors, see `posterior_scales` -> posterior mean."""
    return torch.where(mean < 0, scales[0], scales[1]) * mean


def posterior_scales(
    indices: Tensor, values: Tensor, log_odds: Tensor, labels: Tensor, variances: Tensor
) -> Tensor:
    """Factors on free (negative) and on occupied (positive) log-odds, by predicting left-out points.

    Regularized, early-stopped weights are pulled toward 0 already; moderating them again would
    shrink twice. On either side the median of sqrt(1 + pi v / 8) over the points undoes the
    moderation of a typical point. Beyond it the factor grows with the one that has the least
    balanced log-loss over the moderated leave-one-out predictions, by the powers of `TRUST`: that of
    the occupied side raises both, that of the free side hardly counts, because training points
    keep a gap in front of each hit, which makes them easier to tell apart than those of unseen rays.

    Leaving point i out moves its log-odds by h_i (p_i - y_i) / (1 - h_i c_i) to first order, with
    leverage h_i = sum_m phi_im^2 v_m (its `OWN_SHARE`) and curvature c_i.

    Args:
        indices: (N, K) clusters that answer for each training point.
        values: (N, K) their kernel values.
        log_odds: (N,) of the trained map at these points.
        labels: (N,) 1 occupied, 0 free.
        variances: (M,) of the weights.

    Returns:
        (2,) free, occupied.
    """
    some = slice(None, None, 1 + len(labels) // SCALE_POINTS)
    indices, values, log_odds, labels = (t[some] for t in (indices, values, log_odds, labels))
    residuals = torch.sigmoid(log_odds) - labels
    leverage = OWN_SHARE * (values.square() * variances[indices]).sum(dim=1)
    expected = (log_odds.square() + leverage).sqrt()
    damping = 1 - (leverage * logistic_curvature(expected)).clamp(max=MAX_LEVERAGE)
    left_out = log_odds + leverage * residuals / damping
    variance = OWN_SHARE * latent_variance(indices, values, variances)
    points = torch.stack([left_out, variance, labels, balance_classes(labels)])
    neutral, excess = torch.stack(
        [_scale_of_side(points[:, side]) for side in (left_out < 0, left_out >= 0)]
    ).T
    free, both, free_itself = TRUST
    powers = excess.new_tensor([[free_itself, both + free], [0.0, both]])
    return neutral * (excess.log() * powers).sum(dim=1).exp()


def _scale_of_side(points: Tensor) -> Tensor:
    """(2,) neutral factor, and how many times larger the best is; 1 and 1 without points.

    Args:
        points: (4, S) left-out log-odds, their variance, labels and loss factors.
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
    """What is known of a map's weights: (M,) means, (M,) variances, and (2,) `posterior_scales`."""

    means: Tensor
    variances: Tensor
    scales: Tensor


def fit_posterior(indices: Tensor, values: Tensor, weights: Tensor, labels: Tensor) -> Posterior:
    """Posterior of trained weights, given the features and labels of their training points.

    Args:
        indices: (N, K) nearest clusters of each training point.
        values: (N, K) their kernel values.
        weights: (M,) of the map.
        labels: (N,) 1 occupied, 0 free.
    """
    log_odds = (values * weights[indices]).sum(dim=1)
    variances = weight_variances(indices, values, log_odds, len(weights))
    scales = posterior_scales(indices, values, log_odds, labels.to(values.dtype), variances)
    return Posterior(weights.detach().clone(), variances, scales)


def predict(features_of: FeaturesAt, points: Tensor, posterior: Posterior) -> tuple[Tensor, Tensor]:
    """(N,) mean and (N,) variance of the log-odds at (N, D) points, some at a time.

    Args:
        features_of: (B, D) points -> indices and kernel values (B, K).
        points: (N, D) positions in the frame of ``features_of`` [m].
        posterior: of the map's weights.
    """
    parts = []
    for chunk in points.split(QUERY_CHUNK):
        indices, values = features_of(chunk)
        mean = posterior_log_odds((values * posterior.means[indices]).sum(dim=1), posterior.scales)
        parts.append(torch.stack([mean, latent_variance(indices, values, posterior.variances)]))
    mean, variance = torch.cat(parts, dim=1)
    return mean, variance
