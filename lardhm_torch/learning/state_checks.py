"""Validation of the values in a state dict, before a map takes them over."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from lardhm_torch.features import Kernel
from lardhm_torch.learning.map_state import MapState

NOT_NEGATIVE = ("counts", "losses", "doubts", "fresh", "posterior_variances", "posterior_scales")
ROUNDING = 1 / 16  # of a length scale: more than that must not be lost by rounding a center
MOST_NEIGHBORS = 1 << 30  # as many as the native kernel can index


def check_settings(
    dim: int, num_neighbors: int, covariance_scale: float, min_lengthscale: float
) -> None:
    """Raise a ValueError if a setting of a map is out of range."""
    for name, value in {"dim": dim, "num_neighbors": num_neighbors}.items():
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} must be a whole number, 1 or more; got {value!r}")
        if value > MOST_NEIGHBORS:
            raise ValueError(f"{name} must be at most {MOST_NEIGHBORS}; got {value}")
    if not covariance_scale > 0 or not min_lengthscale > 0:
        raise ValueError(
            "covariance_scale and min_lengthscale must be > 0; "
            f"got {covariance_scale} and {min_lengthscale}"
        )
    if not math.isfinite(covariance_scale) or not math.isfinite(min_lengthscale):
        raise ValueError(
            "covariance_scale and min_lengthscale must be finite; "
            f"got {covariance_scale} and {min_lengthscale}"
        )


def check_max_age(max_age: float | None) -> None:
    """Raise a ValueError if ``max_age`` is neither None nor a time [s] above 0."""
    if max_age is None:
        return
    number = isinstance(max_age, (int, float)) and not isinstance(max_age, bool)
    if not number or not 0 < max_age < math.inf:
        raise ValueError(f"max_age must be > 0 s and finite, or None; got {max_age!r}")


def check_values(tensors: Mapping[str, Tensor]) -> None:
    """Raise a ValueError if a value of a map's tensors is impossible; the message names the tensor.

    Args:
        tensors: tensors of a map by name, of the right shapes. Evidence may be infinite: no point.
    """
    for name, tensor in tensors.items():
        if tensor.is_meta:  # without values yet
            continue
        if tensor.is_complex() or tensor.layout != torch.strided:
            raise ValueError(
                f"{name} must be a dense tensor of real numbers; got {tensor.layout}, {tensor.dtype}"
            )
        bad = tensor.isnan() | (tensor == -math.inf) if name == "evidence" else ~tensor.isfinite()
        if bool(bad.any()):
            raise ValueError(f"{name} must be finite; got {tensor[bad][0].item()}")
        if name in NOT_NEGATIVE and bool((tensor < 0).any()):
            raise ValueError(f"{name} must be 0 or more; got {tensor.min().item()}")
        if name == "raw_scale_tril":
            _check_factors(tensor)


def _check_factors(raw_scale_tril: Tensor) -> None:
    """Raise a ValueError if a logarithm on a diagonal is that of no length scale."""
    logs = raw_scale_tril.diagonal(dim1=-2, dim2=-1)
    most = math.log(torch.finfo(torch.promote_types(logs.dtype, torch.float32)).max)
    if bool((logs > most).any()):
        raise ValueError(
            f"raw_scale_tril must be at most {most:.4g} on its diagonals, which are logarithms of "
            f"length scales; got {logs.max().item():g}"
        )


def check_reach(state: MapState, kernel: Kernel) -> None:
    """Raise a ValueError if clusters are so far from the origin that rounding would move surfaces.

    The spacing of floating point numbers at a center must be below `ROUNDING` of the smallest
    length scale of the cluster.

    Args:
        state: M clusters, map frame [m].
        kernel: settings of the map.
    """
    logs = state.raw_scale_tril.diagonal(dim1=-2, dim2=-1)
    scales = kernel.covariance_scale**0.5 * logs.exp().clamp(min=kernel.min_lengthscale)
    lost = state.centers.abs() * torch.finfo(state.centers.dtype).eps / scales
    if bool((lost > ROUNDING).any()):
        worst = divmod(int(lost.argmax()), lost.shape[1])
        raise ValueError(
            "clusters must be near the origin of the map for their size; got one of "
            f"{float(scales[worst]):.3g} m at {float(state.centers[worst]):.3g} m, which "
            f"{str(state.centers.dtype).removeprefix('torch.')} cannot represent. Use a float64 map, or "
            "one map for each place"
        )
