"""Rays that a new map ends early: the clusters that stop them get other shapes.

A flat cluster at an edge, or one of a few hits in foliage, reaches into space that rays crossed between
their free samples. More free samples there would cost hits, because the weight is all that can change.
Here, the map is asked about its own rays. Where it ends one early, the clusters that stop it and their
neighbors move and shrink, by the steps of fine-tuning on the samples around them and on places of the
ray. Then the weights of all clusters are trained again, without these places.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch import features, native
from lardhm_torch.features import Kernel
from lardhm_torch.learning.fine_tuning import TuneConfig, tuned_table
from lardhm_torch.learning.fitting import (
    CHUNK_ROWS,
    Batched,
    FitTask,
    balance_classes,
    fit_weights,
)
from lardhm_torch.learning.map_state import MapState
from lardhm_torch.learning.passing import lines_of
from lardhm_torch.learning.points import at_most
from lardhm_torch.learning.tuning_steps import Batches, Moving, Plan, to_rows, tuning_steps
from lardhm_torch.native.crossings import Lines
from lardhm_torch.scans import Scans

MAX_RAYS = 20_000  # the map is asked about so many rays, drawn at random
STEP, OCCUPIED = 0.05, 1.0  # [m] steps along a ray; it ends where log-odds exceed this
EARLY = 0.5  # [m] before its hit a ray ends early
AROUND, SPACING = 0.4, 0.1  # [m] places of the ray, up to so far from its end, so far apart
MARGIN = 0.3  # [m] before the hit, where these places end
SHARE = 0.3  # of the positive log-odds where a ray ends: clusters with more stop it
NEIGHBORS = 8  # the nearest clusters change shape with them
FEATURE = 0.2  # of one of these clusters at the samples that they are trained on
PASSES, BATCHES = 3, 16  # of the shapes, over these samples
SHAPES = TuneConfig(center_rate=0.05, scale_rate=0.05)
WEIGHT_PASSES, WEIGHT_RATE = 2, 0.1  # of the weights, afterwards


class Pierced(NamedTuple):
    """Where the map ends R rays early."""

    ends: Tensor  # (R, D) [m]
    places: Tensor  # (P, D) on these rays, around their ends [m]


def ray_lines(scans: Scans | None, origin: Tensor, task: FitTask) -> Lines | None:
    """The rays of scans in the frame of a map, see `passing.lines_of`. None: no rays, None.

    Raises:
        ValueError: the map would have fewer clusters, whose shapes are trained anyway; or the scans do
            not have its dimension.
    """
    if scans is not None and task.config.shape_passes:
        raise ValueError("rays must be None if config.shape_passes is not 0; got both")
    return lines_of(scans, origin)


def cleared(state: MapState, samples: Batched, task: FitTask, rays: Lines) -> MapState:
    """The clusters, of which those that stop rays early have other shapes.

    Args:
        state: M clusters with trained weights.
        samples: that these were trained on, in batches; of many, some are used.
        task: kernel, settings, random generator.
        rays: in the map's frame; space is free before their ``reach``.
    """
    found = pierced(state, rays, task)
    changed = stopping(state, found.ends, task.kernel)
    if len(changed) == 0:
        return state
    config = task.config
    size = config.rows_per_batch(len(samples.points))
    rows = slice(0, min(len(samples.points), size * max(1, CHUNK_ROWS // size)))
    points, labels = samples.points[rows], samples.labels[rows]
    factors = balance_classes(labels, config.occupied_share, config.unknown_share)
    indices, values = samples.features_of(rows)
    moves = torch.zeros_like(state.is_occupied).index_fill_(0, changed, True)
    close = moves.index_select(0, indices.reshape(-1)).view_as(values) & (values > FEATURE)
    close = close.any(dim=1).nonzero().squeeze(1)
    batches = Batches(points[close], labels[close], factors[close])
    state = _reshaped(state, moves, batches, indices[close], found.places, task)
    index = native.build_index(state.centers, task.kernel.num_neighbors)
    shapes = (state.centers, state.raw_scale_tril, task.kernel, index)
    new_indices, new_values = native.nearest_features(batches.points, *shapes)
    indices = indices.index_copy(0, close, new_indices.to(indices.dtype))
    values = values.index_copy(0, close, new_values)
    config = replace(config, passes=WEIGHT_PASSES, learning_rate=WEIGHT_RATE, batch_size=size)
    weights = fit_weights(
        lambda part: (indices[part], values[part]), labels, state.weights, config, factors=factors
    )
    return replace(state, weights=weights)


def pierced(state: MapState, rays: Lines, task: FitTask) -> Pierced:
    """Where the map ends some of the rays early, see `cleared`."""
    every = torch.arange(len(rays.reach), device=rays.reach.device)
    asked = at_most(every, MAX_RAYS, task.rng)
    rays = Lines(rays.starts_of(asked).expand(len(asked), -1), rays.ahead[asked], rays.reach[asked])
    depths = end_depths(state, rays, task.kernel)
    rows = (depths < rays.reach - EARLY).nonzero().squeeze(1)
    starts, ahead, depths = rays.starts[rows], rays.ahead[rows], depths[rows, None]
    count = round(AROUND / SPACING)
    along = depths + SPACING * torch.arange(-count, count + 1, device=depths.device)
    inside = (along > 0) & (along < rays.reach[rows, None] - MARGIN)
    places = starts[:, None] + along[:, :, None] * ahead[:, None]
    like = state.centers
    return Pierced((starts + depths * ahead).to(like), places[inside].to(like))


def end_depths(state: MapState, rays: Lines, kernel: Kernel) -> Tensor:
    """(R,) depths of the first steps where the log-odds exceed `OCCUPIED` [m]; infinite if none."""
    if len(rays.reach) == 0:
        return rays.reach
    index = native.build_index(state.centers, kernel.num_neighbors)
    parameters = (state.centers, state.raw_scale_tril, state.weights)
    farthest = float(rays.reach.max())
    if native.supports(state.centers):
        march = (STEP, farthest, OCCUPIED, OCCUPIED, False)
        return native.raycast((rays.starts, rays.ahead), march, parameters, kernel, index)
    steps = STEP * torch.arange(int(farthest / STEP) + 1, device=rays.reach.device).to(rays.reach)
    size = max(1, features.QUERY_CHUNK // len(steps))
    ends = []
    for starts, ahead in zip(rays.starts.split(size), rays.ahead.split(size), strict=True):
        points = starts[:, None] + steps[:, None] * ahead[:, None]
        odds = native.occupancy(
            points.flatten(0, 1).to(state.centers), *parameters, kernel, probability=False
        )
        occupied = odds.view(points.shape[:2]) > OCCUPIED
        first = steps[occupied.to(torch.uint8).argmax(dim=1)]
        ends.append(torch.where(occupied.any(dim=1), first, torch.inf))
    return torch.cat(ends)


def stopping(state: MapState, ends: Tensor, kernel: Kernel) -> Tensor:
    """Rows of the occupied clusters that stop rays at (R, D) ends, and of those close to them."""
    index = native.build_index(state.centers, kernel.num_neighbors)
    shapes = (state.centers, state.raw_scale_tril, kernel, index)
    indices, values = native.nearest_features(ends, *shapes)
    indices = indices.long()
    parts = (values * state.weights[indices]).clamp(min=0)
    most = parts > SHARE * parts.sum(dim=1, keepdim=True)
    rows = indices[most & state.is_occupied[indices]].unique()
    near = native.nearest_centers(state.centers[rows], state.centers, NEIGHBORS, index).flatten()
    return torch.cat([rows, near[state.is_occupied[near]]]).unique()


def _reshaped(
    state: MapState, moves: Tensor, batches: Batches, near: Tensor, places: Tensor, task: FitTask
) -> MapState:
    """The clusters with other centers and length scales where ``moves``; the weights stay.

    Args:
        state: M clusters.
        moves: (M,) bool.
        batches: samples close to these clusters.
        near: (N, K) the clusters nearest to them.
        places: (P, D) on rays that were stopped [m].
        task: kernel, random generator.
    """
    index = native.build_index(state.centers, task.kernel.num_neighbors)
    around = native.nearest_centers(places, state.centers, near.shape[1], index).to(near)
    free = batches.factors[batches.labels == 0]
    factor = float(free[0]) if len(free) else 1.0
    columns = (
        torch.cat([batches.points, places]),
        torch.cat([batches.labels, batches.labels.new_zeros(len(places))]),
        torch.cat([batches.factors, batches.factors.new_full((len(places),), factor)]),
        torch.cat([near, around]),
    )
    count, rng = len(columns[0]), task.rng
    order = torch.randperm(count, generator=rng, device=rng.device)
    *mixed, near = (column[order] for column in columns)
    start = to_rows(state.weights, state.centers, state.raw_scale_tril)
    table = tuned_table(start, SHAPES, task.kernel)
    unit = table.unit.clone()
    unit[~moves, 1:] = 0
    table = table._replace(unit=unit)
    size = max(256, -(-count // BATCHES))
    plan, moving = Plan(count, size, PASSES * -(-count // size)), Moving.at_start(start)
    for passed in range(PASSES):
        step = passed * -(-count // size)
        moving = tuning_steps(Batches(*mixed), near, table, moving, step, plan)
    _, centers, raw = table.parameters(moving.offsets)
    return replace(state, centers=centers.contiguous(), raw_scale_tril=raw)
