"""How far a cluster speaks: beyond its reach nothing of it is left in any answer."""

from __future__ import annotations

import torch
from torch import Tensor

NEGLIGIBLE = 1e-10  # log-odds of one cluster; keeps gradients [1/m] of 1 cm kernels below 1e-6, too


def cluster_reach(weights: Tensor, scale_tril: Tensor) -> Tensor:
    """(M,) distance from the center beyond which |weight| * kernel stays below `NEGLIGIBLE` [m].

    A kernel falls slowest along its longest axis, where it is exp(-(d / s)^2 / 2) with s the largest
    singular value of its factor: so d = s sqrt(2 log(|w| / NEGLIGIBLE)). Weights count as 1 at least:
    then the kernel values themselves are negligible, too, and variances are as exact as log-odds.

    Args:
        weights: (M,).
        scale_tril: (M, D, D) the kernels' lower Cholesky factors [m].

    Returns:
        (M,) float64.
    """
    size = weights.detach().double().abs().clamp(min=1)
    longest = torch.linalg.matrix_norm(scale_tril.detach().double(), ord=2)
    return longest * (2 * (size / NEGLIGIBLE).log()).sqrt()
