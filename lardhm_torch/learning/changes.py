"""What functions that change a map have in common: full precision, and tensors that can be trained."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec, TypeVar

import torch
from torch import nn

P = ParamSpec("P")
R = TypeVar("R")
DTYPES = (torch.float32, torch.float64)  # of maps that can be changed, and of all computation


def changes_map(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that trains or moves a map, its first argument.

    Other threads that change the map wait for it, and those that read it for what it writes in the end.
    Inside, `torch.inference_mode` is off, so that the map can still be trained afterwards, and so is
    `torch.autocast`. A map of half precision or without values is refused with a ValueError.
    """

    @functools.wraps(function)
    def change(*args: P.args, **kwargs: P.kwargs) -> R:
        model: Any = args[0] if args else next(iter(kwargs.values()))
        if model.centers.dtype not in DTYPES:
            raise ValueError(
                f"the map must be float32 or float64 for {function.__name__}; "
                f"got {model.centers.dtype}. Call map.float() first"
            )
        device = model.centers.device.type
        if device == "meta":
            raise ValueError(
                f"the map must have values for {function.__name__}; it is on the meta device. "
                "Call map.to_empty(device=...) first"
            )
        with model.lock.changing(), normal_tensors(), torch.autocast(device, enabled=False):
            _replace_inference_tensors(model)
            return function(*args, **kwargs)

    return change


def _replace_inference_tensors(model: Any) -> None:
    """Copies of tensors that were made in inference mode, as by `copy.deepcopy`, take their place."""
    for name, tensor in list(model.state_tensors()):
        if tensor.is_inference():
            is_parameter = isinstance(tensor, nn.Parameter)
            copy = tensor.detach().clone()
            setattr(model, name, nn.Parameter(copy, tensor.requires_grad) if is_parameter else copy)


def normal_tensors() -> AbstractContextManager[Any]:
    """A context without inference mode: the tensors made in it can be trained."""
    return torch.inference_mode(False) if torch.is_inference_mode_enabled() else nullcontext()
