"""Channels of a packed map: the affine functions of its occupied clusters, rounded.

For each channel and each occupied cluster, these are the number of hits n, the value v at the center and
its changes along the columns of the kernel's factor L, u = L^T g with the gradient g, so that one step
of rounding serves them all. A map that is read has channel sums which give the same functions: those of n
hits with mean c, covariance L L^T, and moments that a regression with its ridge turns into v and g.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.channels import CLASS, COLOR
from lardhm_torch.features import PLAIN, kernel_factors
from lardhm_torch.learning.channel_queries import RIDGE, affine_functions
from lardhm_torch.learning.channel_sums import check_layout, num_rows, rows_of
from lardhm_torch.learning.map_tensors import MapTensors

BYTE = 255.0  # steps of a color or a fraction from 0 to 1, and of the range of other values
COUNT_STEPS = 8.0  # of the number of hits, per factor of 2


def rounded_channels(
    model: MapTensors, state: dict[str, Any], weight_steps: int
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Description and tables of the channels, for `packed_blocks.encode_block`.

    Args:
        model: a map with channels.
        state: state dict of the packed map, whose centers and factors will be read.
        weight_steps: steps of class weights, per 1.
    """
    centers, factors = _shapes_of(state)
    steps, tables = {}, []
    for name in model.channel_layout:
        counts, values, slopes = affine_functions(model, name, centers)
        seen = counts > 0
        step = _step(name, values[seen])
        columns = torch.cat([values[..., None], slopes @ factors], dim=2) / step
        columns = columns.where(seen[:, None, None], torch.zeros_like(columns))
        logs = torch.where(seen, 1 + COUNT_STEPS * counts.clamp(min=1).log2(), 0 * counts)
        table = torch.cat([logs[:, None], columns.flatten(1)], dim=1)
        tables.append(table.round().to(torch.int32).numpy())
        steps[name] = step
    description = {"channels": model.channel_layout, "scale": model.class_scale, "steps": steps}
    if model.class_weights is not None:
        weights = model.class_weights.detach().double().cpu() * weight_steps
        tables.append(weights.round().to(torch.int32).numpy())
    return description, tables


def _step(name: str, values: Tensor) -> float:
    """The unit of rounding of a channel."""
    if name in (COLOR, CLASS) or len(values) == 0:
        return 1 / BYTE
    span = float(values.max() - values.min())
    return span / BYTE if span > 0 else 1.0


def _shapes_of(state: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """(S, D) centers and (S, D, D) factors of the occupied clusters, float64 [m]."""
    rows = state["is_occupied"]
    raw = state["raw_scale_tril"][rows].double()
    return state["centers"][rows].double(), kernel_factors(raw, PLAIN)


def with_packed_channels(
    state: dict[str, Any], description: dict[str, Any], tables: list[np.ndarray], weight_steps: int
) -> dict[str, Any]:
    """The state dict of a packed map with its channels.

    Raises:
        ValueError: the tables are not those of the channels of the map.
    """
    layout, steps = check_layout(description["channels"]), description["steps"]
    centers, factors = _shapes_of(state)
    count, dim = centers.shape
    sums = torch.zeros(count, num_rows(layout, dim), 1 + dim, dtype=torch.float64)
    parts = dict(zip(layout, tables, strict=False))
    totals = centers.new_zeros(count)
    found = {}
    for name, rows in rows_of(layout, dim).items():
        width = rows.stop - rows.start - (name != CLASS)
        table = torch.from_numpy(parts[name]).double()
        if table.shape != (count, 1 + width * (1 + dim)):
            raise ValueError(f"channel {name!r} must have a row per occupied cluster; it has not")
        counts = torch.where(table[:, 0] > 0, torch.exp2((table[:, 0] - 1) / COUNT_STEPS), 0.0)
        columns = float(steps[name]) * table[:, 1:].reshape(count, width, 1 + dim)
        slopes = torch.linalg.solve_triangular(factors, columns[..., 1:], upper=False, left=False)
        totals = totals.maximum(counts)
        found[name] = counts, columns[..., 0], slopes
    covariance = factors @ factors.mT
    sums[:, : dim + 1] = _position_sums(totals, centers, covariance)
    ridge = RIDGE**2 + covariance.diagonal(dim1=1, dim2=2).sum(dim=1) / totals.clamp(min=1e-12)
    spread = covariance + torch.diag_embed(ridge[:, None].expand(-1, dim))
    for name, (counts, values, slopes) in found.items():
        rows = rows_of(layout, dim)[name]
        if name != CLASS:  # the constant 1 of the hits with a value
            values = torch.cat([values, torch.ones_like(values[:, :1])], dim=1)
            slopes = torch.cat([slopes, torch.zeros_like(slopes[:, :1])], dim=1)
        first = values[..., None] * centers[:, None] + slopes @ spread
        sums[:, rows] = counts[:, None, None] * torch.cat([values[..., None], first], dim=2)
    extra = {"channels": layout, "class_scale": float(description["scale"])}
    state = {**state, "channel_sums": sums, "_extra_state": {**state["_extra_state"], **extra}}
    if len(tables) > len(layout):
        state["class_weights"] = torch.from_numpy(tables[-1]).float() / weight_steps
    return state


def _position_sums(totals: Tensor, centers: Tensor, covariance: Tensor) -> Tensor:
    """(S, D + 1, 1 + D) sums of the positions of hits with these moments."""
    ones = torch.ones_like(centers[:, :1])
    moments = torch.cat([ones, centers], dim=1)
    products = moments.roll(-1, dims=1)[:, :, None] * moments[:, None]
    products[:, :-1, 1:] += covariance
    return totals[:, None, None] * products


def check_finite(model: MapTensors) -> None:
    """Raise a ValueError if a class scale or a channel sum is not finite."""
    sums = model.channel_sums
    if not math.isfinite(model.class_scale) or (sums is not None and not sums.isfinite().all()):
        raise ValueError("the channels of the map must be finite to be packed; some are not")
