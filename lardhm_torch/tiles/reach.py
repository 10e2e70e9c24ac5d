"""How far a cluster speaks: beyond its reach nothing of it is left in any answer."""

from __future__ import annotations

import torch
from torch import Tensor

NEGLIGIBLE = 1e-10  # log-odds of one cluster; keeps gradients [1/m] of 1 cm kernels below 1e-6, too


def largest_reach(weights: Tensor, scale_tril: Tensor) -> float:
    """Distance from its center beyond which every cluster's |weight| * kernel is below `NEGLIGIBLE` [m].

    A kernel falls slowest along its longest axis, where it is exp(-(d / s)^2 / 2) with s the largest
    singular value of its factor: so d = s sqrt(2 log(|w| / NEGLIGIBLE)). Weights count as 1 at least:
    then the kernel values themselves are negligible, too, and variances are as exact as log-odds.

    Args:
        weights: (M,), M at least 1.
        scale_tril: (M, D, D) the kernels' lower Cholesky factors [m].
    """
    factors = scale_tril.detach().double()
    size = weights.detach().double().abs().clamp(min=1)
    lengths = (2 * (size / NEGLIGIBLE).log()).sqrt()
    # |(L^T L)^2|^(1/4) in the Frobenius norm is s to 3^(1/8) s in three dimensions: few clusters can
    # be the one, and need the singular value itself.
    gram = factors.mT @ factors
    bounds = lengths * torch.linalg.vector_norm(gram @ gram, dim=(1, 2)) ** 0.25
    rows = bounds * factors.shape[1] ** 0.125 >= bounds.max()
    longest = torch.linalg.matrix_norm(factors[rows], ord=2)
    return float((lengths[rows] * longest).max())
