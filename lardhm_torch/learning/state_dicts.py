"""State dicts of maps: validated when they are loaded, compact when they are made."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.channels import CLASS
from lardhm_torch.io import map_files
from lardhm_torch.learning.channel_sums import Layout, check_layout, num_rows
from lardhm_torch.learning.map_state import (
    CHANNELS,
    HISTORY,
    PER_MAP,
    fitting_evidence,
    no_evidence,
    no_times,
)
from lardhm_torch.learning.map_tensors import MapTensors
from lardhm_torch.learning.resizing import resize, set_channels
from lardhm_torch.learning.state_checks import check_values


def make_room(model: MapTensors, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Pre-hook of `load_state_dict`: validate the state dict and adopt its number of clusters."""
    extra = map_files.check_settings(state.get(prefix + "_extra_state"))
    differing = {k: (v, extra[k]) for k, v in model.settings.items() if extra[k] != v}
    if differing:
        name, (ours, theirs) = next(iter(differing.items()))
        raise ValueError(
            f"state_dict must be of a map with {name} = {ours}; got {theirs}. "
            f"Make the map with LardHilbertMap({name}={theirs}), or read the file with "
            "LardHilbertMap.load"
        )
    _fill_evidence(state, prefix)
    own = {name: t for name, t in model.state_tensors() if name not in CHANNELS}
    missing = [name for name in own if not isinstance(state.get(prefix + name), Tensor)]
    if missing:
        raise ValueError(f"state_dict must hold the tensors of a map; missing: {missing}")
    num_clusters = len(torch.atleast_1d(state[prefix + "weights"]))
    shapes: dict[str, tuple[int, ...]] = {
        name: tensor.shape if name in PER_MAP else (num_clusters, *tensor.shape[1:])
        for name, tensor in own.items()
    }
    spread_sums(state, prefix, num_clusters)
    layout, own_shapes = channel_shapes(state, prefix, model.dim)
    shapes.update({name: (num_clusters, *shape) for name, shape in own_shapes.items()})
    for name, shape in shapes.items():
        if state[prefix + name].shape != torch.Size(shape):
            raise ValueError(
                f"{prefix + name} must be {tuple(shape)} in a map of {num_clusters} clusters; "
                f"got {tuple(state[prefix + name].shape)}"
            )
    check_values({name: state[prefix + name] for name in (*own, *own_shapes)})
    resize(model, num_clusters)
    model.class_scale = _class_scale(state, prefix)
    set_channels(model, layout, has_class_weights="class_weights" in own_shapes)


def channel_shapes(
    state: dict[str, Any], prefix: str, dim: int
) -> tuple[Layout, dict[str, tuple[int, ...]]]:
    """The layout of the channels, and the shape of a row of each of their tensors."""
    layout = check_layout(state[prefix + "_extra_state"].get("channels", {}))
    present = [name for name in CHANNELS if isinstance(state.get(prefix + name), Tensor)]
    if ("channel_sums" in present) != bool(layout) or (present and not layout):
        raise ValueError(
            f"state_dict must have channel_sums of the channels in its settings, {list(layout)}; "
            f"got {present or 'none'}"
        )
    shapes = {
        "channel_sums": (num_rows(layout, dim), 1 + dim),
        "class_weights": (len(layout.get(CLASS, ())),),
    }
    return layout, {name: shapes[name] for name in present}


def file_state(state: dict[str, Any], evidence: bool) -> dict[str, Any]:
    """What a map file holds of a state dict; without ``evidence``, nothing that only updates need."""
    kept = {name: value for name, value in state.items() if evidence or name not in HISTORY}
    return occupied_sums(kept)


def occupied_sums(state: dict[str, Any]) -> dict[str, Any]:
    """The state dict of a map with the channel sums of its occupied clusters alone: others have none."""
    if "channel_sums" not in state:
        return state
    return {**state, "channel_sums": state["channel_sums"][state["is_occupied"]]}


def spread_sums(state: dict[str, Any], prefix: str, num_clusters: int) -> None:
    """Undo `occupied_sums` in the state dict of a file."""
    sums, rows = state.get(prefix + "channel_sums"), state[prefix + "is_occupied"]
    if not isinstance(sums, Tensor) or sums.ndim != 3 or rows.dtype != torch.bool:
        return
    if len(rows) == num_clusters and len(sums) == int(rows.sum()) < num_clusters:
        spread = sums.new_zeros(num_clusters, *sums.shape[1:])
        spread[rows] = sums
        state[prefix + "channel_sums"] = spread


def _class_scale(state: dict[str, Any], prefix: str) -> float:
    """The scale of the class log-odds; 1 for a map without channels."""
    scale = state[prefix + "_extra_state"].get("class_scale", 1.0)
    if not isinstance(scale, float) or not 0 < scale < math.inf:
        raise ValueError(f"class_scale must be a finite number above 0; got {scale!r}")
    return scale


def _fill_evidence(state: dict[str, Any], prefix: str) -> None:
    """Add evidence to the state dict of a map that was saved without it or with fewer points."""
    centers = state.get(prefix + "centers")
    if not isinstance(centers, Tensor) or centers.ndim != 2:
        return
    for name in HISTORY:
        if len(state.get(prefix + name, ())) == 0:
            zeros = centers.new_zeros(len(centers))
            empty = {"evidence": no_evidence(centers), "times": no_times(zeros)}
            state[prefix + name] = empty.get(name, zeros)
    kept = state[prefix + "evidence"]
    if isinstance(kept, Tensor) and kept.ndim == 3:
        state[prefix + "evidence"] = fitting_evidence(kept)


def drop_spare_rows(model: MapTensors, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Post-hook of `state_dict`: copy tensors with spare capacity, which would be saved otherwise."""
    for name, _tensor in model.state_tensors():
        state[prefix + name] = map_files.without_spare_memory(state[prefix + name])
