"""The operator `lardhm::occupancy`, which computes the queries of a map.

It is defined as soon as the package and torch are imported, so that `torch.export.load` finds it in a
new process. The native library, loaded at the first query, contains the implementation for the CPU.
Elsewhere, under the transforms of `torch.func` and in forward-mode differentiation, the operator is
the definition in `features`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from lardhm_torch import features
from lardhm_torch.features import Kernel
from lardhm_torch.native.build import available

NAME = "lardhm::occupancy"
DIMENSIONS = (2, 3)
DTYPES = (torch.float32, torch.float64)

_library = torch.library.Library("lardhm", "FRAGMENT")
_library.define(
    "occupancy(Tensor points, Tensor centers, Tensor raw_scale_tril, Tensor weights, int k, "
    "float covariance_scale, float min_lengthscale, Tensor index, bool probability) -> Tensor",
)


def fits(points: Tensor) -> bool:
    """Whether (N, D) points have a device, dtype and dimension for which the library is written."""
    on_cpu = points.device.type == "cpu" and points.dtype in DTYPES
    return on_cpu and points.shape[-1] in DIMENSIONS


def transformed(*tensors: Tensor) -> bool:
    """Whether a transform of `torch.func` is active, or one of the tensors is dual."""
    if torch._C._are_functorch_transforms_active():
        return True
    if forward_ad._current_level < 0:  # no tensor is dual outside `forward_ad.dual_level`
        return False
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def definition(tensors: Sequence[Tensor], kernel: Kernel, probability: bool) -> Tensor:
    """`features.log_odds` of points, centers, raw factors and weights, or its sigmoid."""
    points, centers, raw_scale_tril, weights = tensors
    factors = features.kernel_factors(raw_scale_tril, kernel)
    answer = features.log_odds(points, centers, factors, weights, kernel.num_neighbors)
    return torch.sigmoid(answer) if probability else answer


def _without_library(points: Tensor, *arguments: Any) -> Tensor:
    if fits(points) and available():  # once: the library that this loads serves all later calls
        return torch.ops.lardhm.occupancy(points, *arguments)
    *parameters, k, scale, floor, _, probability = arguments
    return definition([points, *parameters], Kernel(k, scale, floor), probability)


@torch.library.register_fake(NAME)
def _shape(points: Tensor, *_: Any) -> Tensor:
    return points.new_empty(points.shape[0])


def _autograd(keys: torch._C.DispatchKeySet, *arguments: Any) -> Tensor:
    tensors, settings = arguments[:4], arguments[4:]
    if transformed(*tensors):
        *kernel, _, probability = settings
        return definition(tensors, Kernel(*kernel), probability)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return _Occupancy.apply(keys, *arguments)
    return _below_autograd(keys, *arguments)


def _below_autograd(keys: torch._C.DispatchKeySet, *arguments: Any) -> Tensor:
    with torch._C._AutoDispatchBelowAutograd():
        below = keys & torch._C._after_autograd_keyset
        return torch.ops.lardhm.occupancy.default.redispatch(below, *arguments)


class _Occupancy(torch.autograd.Function):
    """The operator with its gradient."""

    @staticmethod
    def forward(keys: torch._C.DispatchKeySet, *arguments: Any) -> Tensor:
        return _below_autograd(keys, *arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, *tensors, k, scale, floor, index, ctx.probability = inputs
        ctx.kernel = Kernel(k, scale, floor)
        ctx.save_for_backward(*tensors, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        *inputs, index = ctx.saved_tensors
        needed = ctx.needs_input_grad[1:5]
        if torch.is_grad_enabled() or not (fits(inputs[0]) and available()):
            grads = _gradients_of_definition(grad, inputs, needed, ctx.kernel, ctx.probability)
        else:
            wanted = sum(1 << bit for bit in range(4) if needed[bit])
            computed = torch.ops.lardhm.occupancy_backward(
                grad, *inputs, *ctx.kernel, index, ctx.probability, wanted
            )
            grads = [g if wanted >> bit & 1 else None for bit, g in enumerate(computed)]
        return (None, *grads, None, None, None, None, None)


def _gradients_of_definition(
    grad: Tensor, inputs: list[Tensor], needed: Any, kernel: Kernel, probability: bool
) -> list[Tensor | None]:
    """Gradients that can be differentiated again."""
    again = torch.is_grad_enabled()
    with torch.enable_grad():
        answer = definition(inputs, kernel, probability)
        asked = [tensor for tensor, need in zip(inputs, needed, strict=True) if need]
        found = iter(torch.autograd.grad(answer, asked, grad, create_graph=again))
    return [next(found) if need else None for need in needed]


_library.impl("occupancy", _without_library, "CompositeExplicitAutograd")
_library.impl("occupancy", _autograd, "Autograd", with_keyset=True)
