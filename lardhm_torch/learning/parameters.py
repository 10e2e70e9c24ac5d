"""The tensors of a map as a torch module, with in-place changes of the number of clusters."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from lardhm_torch.io import map_files
from lardhm_torch.learning.channel_sums import Layout
from lardhm_torch.learning.map_state import CHANNELS, MapState, no_channels
from lardhm_torch.learning.map_tensors import MapTensors
from lardhm_torch.learning.resizing import extend_channels, resize, set_channels, set_class_weights
from lardhm_torch.learning.state_checks import check_max_age, check_reach
from lardhm_torch.learning.state_dicts import drop_spare_rows, make_room

AnyMap = TypeVar("AnyMap", bound="MapParameters")

# OpenMP hangs in the child of a fork whose parent used it; DataLoader workers have one thread, too.
os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


class MapParameters(MapTensors):
    """Tensors and settings of a map: everything in its state dict.

    Args and attributes: see `LardHilbertMap`.
    """

    def reading(self) -> AbstractContextManager[None]:
        """A context in which all queries see the same map. Threads that change the map wait.

        A single query needs no context: it always sees the map before or after a change by `fit`,
        `update`, `fine_tune` or another function of this package in another thread.
        """
        return self.lock.reading()

    def load_state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """See `torch.nn.Module.load_state_dict`; the map gets as many clusters as the state dict has."""
        with self.lock.changing(), self.lock.writing():
            return super().load_state_dict(*args, **kwargs)

    def _register_hooks(self) -> None:
        self.register_load_state_dict_pre_hook(make_room)
        self.register_state_dict_post_hook(drop_spare_rows)

    @classmethod
    def from_state(cls: type[AnyMap], state: dict[str, Any]) -> AnyMap:
        """A map with the settings and tensors of a state dict."""
        model = cls(**map_files.map_settings(state), dtype=state["centers"].dtype)
        model.load_state_dict(state)
        return model

    def parameter_groups(self, weight_decay: float = 0.0) -> list[dict[str, Any]]:
        """Parameter groups for an optimizer, with weight decay on the weights only.

        Weight decay would pull centers to the map's origin and length scales to 1 m.
        """
        return [
            {"params": [self.weights], "weight_decay": weight_decay},
            {"params": [self.centers, self.raw_scale_tril], "weight_decay": 0.0},
        ]

    def drop_channels(self: AnyMap) -> AnyMap:
        """Remove channels and classes from the map. The occupancy does not change.

        Returns:
            This map.
        """
        with self.lock.writing():
            set_channels(self, {}, has_class_weights=False)
            self.class_scale = 1.0
        return self

    def extra_repr(self) -> str:
        """Number of clusters and settings, for `print(model)`."""
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        return f"num_clusters={len(self)}, {settings}"

    def get_extra_state(self) -> dict[str, Any]:
        """Format version and settings, stored in the state dict with the tensors."""
        state = {"format_version": map_files.FORMAT_VERSION, **self.settings}
        if self.is_packed:
            state["is_packed"] = True
        if self.max_age is not None:
            state["max_age"] = self.max_age
        if self.channel_layout:
            state |= {"channels": self.channel_layout, "class_scale": self.class_scale}
        return state

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Whether the map is packed; `make_room` has already checked that the settings agree."""
        self.is_packed = bool(state.get("is_packed", False))
        check_max_age(state.get("max_age"))
        self.max_age = state.get("max_age")

    def check_learns(self) -> None:
        """Raise a ValueError if the map is packed: it has no points and moments to train from."""
        if self.is_packed:
            raise ValueError(
                "model must not be packed; a packed map supports queries, but no training. "
                "Load the file written by save, or make a new map"
            )


def read_state(model: MapParameters) -> MapState:
    """The tensors of the map, detached but not copied."""
    none = dict(zip(CHANNELS, no_channels(model.centers.detach()), strict=True))
    tensors = {field.name: getattr(model, field.name) for field in fields(MapState)}
    return MapState(
        *(none[name] if tensor is None else tensor.detach() for name, tensor in tensors.items())
    )


def write_state(
    model: MapParameters, state: MapState, origin: Tensor, layout: Layout | None = None
) -> None:
    """Replace the clusters and the origin of a map. If anything fails, the map is unchanged.

    Parameters remain the same objects, so existing optimizers stay valid. If an optimizer holds state
    of the old size, its next step raises an error; see `resize_optimizer`.

    Args:
        model: map, changed in place.
        state: M clusters.
        origin: (D,) float64, world = map + origin [m].
        layout: of the channels of the state; None: that of the map.

    Raises:
        ValueError: a cluster is too far from the origin for the dtype, see `check_reach`.
    """
    check_reach(state, model.kernel)
    old_layout = model.channel_layout
    before = MapState(*(tensor.clone() for tensor in read_state(model)))
    with model.lock.writing():
        try:
            assign_state(model, state, layout)
        except BaseException:
            assign_state(model, before, old_layout)
            raise
        model.origin = origin


def write_rows(
    model: MapParameters, where: Tensor, part: MapState, removed: Tensor, layout: Layout
) -> None:
    """Overwrite rows of a map, append new ones, and remove others. If it fails, nothing changes.

    The cost depends on the number of changed rows, not on the size of the map. The last rows of the
    map take the places of removed ones.

    Args:
        model: a map of M clusters.
        where: (Q,) rows to overwrite.
        part: Q rows to write there, followed by the clusters to append.
        removed: (R,) rows to remove; clusters are only appended if R = 0.
        layout: of the channels of ``part``; it continues that of the map.

    Raises:
        ValueError: a cluster is too far from the origin for the dtype, see `check_reach`.
    """
    check_reach(part, model.kernel)
    old_layout, old = model.channel_layout, read_state(model)
    size = len(model)
    left = size + len(part) - len(where) - len(removed)
    tail = torch.arange(left, max(left, size), device=removed.device)
    holes = removed[removed < left]
    touched = torch.cat([where, holes, tail])
    before = read_state(model).rows(touched)
    with model.lock.writing():
        try:
            extend_channels(model, layout)
            resize(model, size + len(part) - len(where), keep=True)
            assign_rows(model, where, part)
            if len(removed):
                assign_rows(model, holes, read_state(model).rows(tail[~torch.isin(tail, removed)]))
                resize(model, left, keep=True)
        except BaseException:
            if model.channel_layout != old_layout:
                model.channel_layout = old_layout
                model.channel_sums = old.channel_sums if old_layout else None
                set_class_weights(model, old.class_weights)
            resize(model, size, keep=True)
            assign_rows(model, touched, before)
            raise
        model.posterior_variances.zero_()


def assign_rows(model: MapParameters, where: Tensor, part: MapState) -> None:
    """Copy the first ``len(where)`` rows into rows ``where`` of a map, and the others to its end."""
    count, added = len(where), len(part) - len(where)
    for tensor, rows in zip(read_state(model), part, strict=True):
        tensor.index_copy_(0, where, rows[:count])
        tensor[len(tensor) - added :] = rows[count:]


def assign_state(model: MapParameters, state: MapState, layout: Layout | None = None) -> None:
    """Copy the tensors of a state into a map, and reset the posterior of the weights."""
    layout = model.channel_layout if layout is None else layout
    resize(model, len(state.weights))
    model.channel_layout = layout
    model.channel_sums = state.channel_sums.clone() if layout else None
    set_class_weights(model, state.class_weights)
    model.posterior_variances.zero_()
    model.posterior_scales.fill_(1.0)
    with torch.no_grad():
        for field, value in zip(fields(state), state, strict=True):
            if field.name not in CHANNELS:
                getattr(model, field.name).copy_(value)


def resize_optimizer(optimizer: torch.optim.Optimizer, model: MapParameters) -> None:
    """Extend the state of an optimizer to the clusters that `update` appended.

    Adam or SGD with momentum would otherwise fail with a shape mismatch; plain SGD has no state.
    Existing rows keep their state, and new rows start at 0.

    Args:
        optimizer: an optimizer of the map's parameters.
        model: the map, after `update`.

    Raises:
        ValueError: the map has fewer clusters than the state, because `crop` or `fit` removed
            rows. In this case, create a new optimizer.
    """
    for parameter in model.parameters():
        for name, value in optimizer.state.get(parameter, {}).items():
            if not isinstance(value, Tensor) or value.shape[1:] != parameter.shape[1:]:
                continue
            if value.ndim != parameter.ndim or len(value) == len(parameter):
                continue
            if len(value) > len(parameter):
                raise ValueError(
                    f"optimizer must hold at most {len(parameter)} clusters; its {name} holds "
                    f"{len(value)}. Make a new optimizer after crop or fit"
                )
            room = value.new_zeros(len(parameter) - len(value), *value.shape[1:])
            optimizer.state[parameter][name] = torch.cat([value, room])
