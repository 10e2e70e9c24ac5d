"""Maps to grids that other programs read: NumPy arrays and OctoMap trees."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.channels import CLASS
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.numpy_files import array_name
from lardhm_torch.io.octrees import new_tree, to_array
from lardhm_torch.maps import OccupancyMap, TensorLike, reads_copy
from lardhm_torch.queries.channels import check_channel
from lardhm_torch.queries.distance import signed_distance
from lardhm_torch.queries.grids import (
    BLOCK_POINTS,
    LOG_ODDS_MARGIN,
    cluster_boxes,
    grid_axes,
    map_bounds,
    query_grid,
)
from lardhm_torch.queries.memory import check_memory
from lardhm_torch.surfaces.channel_colors import channel_values, class_labels
from lardhm_torch.surfaces.lattice import BLOCK_CELLS, Lattice, blocks_near_boxes

GRID_SUFFIXES = (".bt", ".npz", ".ot")
_COARSE_CELLS = 800  # along the longest axis, to estimate the size of a tree
_TREE_BYTES = 8  # for each cell near a cluster: most are unknown or merged
_TREE_CELLS = 1 << 15  # an OctoMap tree has so many cells on either side of zero


@reads_copy
def save_grid(
    model: OccupancyMap,
    path: str | os.PathLike[str],
    resolution: float = 0.1,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    *,
    distance: bool = False,
    sparse: bool = False,
    channel: str | None = None,
) -> int:
    """Write the map as a grid of cells, in the format of the extension.

    Cells lie at whole multiples of the resolution.

    | extension | content |
    |---|---|
    | ``.npz`` | ``probability`` (nx, ny, nz) float32 at the centers, ``lower`` (D,), ``resolution`` |
    | ``.npz``, with ``distance`` | ``distance`` (nx, ny, nz) float32: `signed_distance` of the centers |
    | ``.bt`` | OctoMap: occupied and free cells, the rest unknown |
    | ``.ot`` | OctoMap: log-odds, clamped as OctoMap does (-2 and 3.511), pruned |

    A sparse ``.npz`` contains only blocks of 8 x 8 x 8 cells that touch the box of a cluster (three
    standard deviations): ``probability`` (B, 8, 8, 8) float32 and ``blocks`` (B, 3), the index of the
    first cell of each block, relative to the cell at ``lower``. All other cells are unknown. The file is
    written block by block, so memory does not grow with the map.

    A ``channel`` of the map is written to the ``.npz`` as another array of the same shape, named
    ``color``, ``intensity``, ``class`` or ``channel_NAME``: float32, (..., C) for C values, NaN where
    unknown; for ``class``, the most likely class of each cell, int32, -1 where unknown.

    An OctoMap cell has the highest log-odds of the centers of its eight octants, because surfaces are
    thinner than cells and OctoMap also prefers occupied. A cell is unknown if its log-odds are between
    -1 and 1 (probability 0.27 and 0.73).

    Args:
        model: a map; for OctoMap a 3-D one.
        path: a file that ends in .npz, .bt or .ot; an existing file is replaced atomically.
        resolution: edge of a cell [m].
        bounds: lower and upper corner of the part to write, world frame [m]; None: all of it.
        distance: write signed distances to the nearest surface instead of probabilities.
        sparse: write a sparse ``.npz``, of a 3-D map.
        channel: name of a channel to write to the ``.npz`` in addition to the probability.

    Returns:
        The number of cells written.

    Raises:
        ValueError: the extension is unknown (for distances: not .npz), the map is empty or has the
            wrong dimension or no such channel, the map exceeds the range of an OctoMap of this
            resolution, or the grid would not fit in memory.
        ImportError: OctoMap output is requested and octomap-python is not installed.
        FileNotFoundError: the folder of path does not exist.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in GRID_SUFFIXES:
        known = ", ".join(GRID_SUFFIXES)
        raise ValueError(f"path must end in one of {known} for a grid; got {Path(path).name!r}")
    if (distance or channel is not None) and suffix != ".npz":
        what = "of distances" if distance else "with a channel"
        raise ValueError(f"path must end in .npz for a grid {what}; got {Path(path).name!r}")
    if channel is not None:
        check_channel(model, channel)
    if sparse and distance:
        raise ValueError("distances cannot be sparse; give distance or sparse")
    if sparse and (suffix != ".npz" or model.dim != 3):
        raise ValueError(
            f"sparse needs a path that ends in .npz and a 3-D map; got {Path(path).name!r} and "
            f"{model.dim}-D. OctoMap trees are sparse anyway"
        )
    lower, upper = map_bounds(model) if bounds is None else bounds
    lower, upper = (torch.as_tensor(end, dtype=torch.float64).cpu() for end in (lower, upper))
    grid_axes(lower, upper, resolution)  # raises for what is no resolution and no corners
    first, last = (lower / resolution).floor(), (upper / resolution).ceil() - 1
    first_center, last_center = ((end + 0.5) * resolution for end in (first, last.maximum(first)))
    if sparse:
        return _save_sparse(model, path, resolution, first_center, last_center, channel)
    if suffix == ".npz":
        ask = _distance_grid if distance else query_grid
        values = ask(model, first_center, last_center, resolution)
        arrays: dict[str, Any] = {
            "distance" if distance else "probability": values.float().cpu().numpy(),
            "lower": (first * resolution).numpy(),
            "resolution": np.float64(resolution),
        }
        if channel is not None:
            name = array_name(channel)
            arrays[name] = _channel_grid(model, first_center, last_center, resolution, channel)
        with replaced_file(path) as unfinished, open(unfinished, "wb") as file:
            np.savez(file, **arrays)
        return values.numel()
    tree, count = _octomap_of(model, first_center, last_center, resolution)
    content = tree.writeBinary() if suffix == ".bt" else tree.write()  # OctoMap ignores full disks
    with replaced_file(path) as partial:
        partial.write_bytes(content)
    return count


@torch.no_grad()
def _distance_grid(model: OccupancyMap, first: Tensor, last: Tensor, resolution: float) -> Tensor:
    """Signed distances at all points of a `grid`."""
    axes = grid_axes(first, last, resolution)
    slabs = axes[0].split(max(1, BLOCK_POINTS // math.prod(len(axis) for axis in axes[1:])))
    return torch.cat(
        [
            signed_distance(model, torch.stack(torch.meshgrid(slab, *axes[1:], indexing="ij"), -1))
            for slab in slabs
        ]
    )


def cell_values(model: OccupancyMap, points: Tensor, channel: str) -> np.ndarray:
    """(..., D) world positions [m] -> (...) or (..., C) values of a channel, or the likely classes."""
    flat = points.reshape(-1, points.shape[-1]).cpu().numpy()
    ask = class_labels if channel == CLASS else partial(channel_values, name=channel)
    values = ask(model, flat)
    kind = np.int32 if channel == CLASS else np.float32
    return values.astype(kind).reshape(*points.shape[:-1], *values.shape[1:])


def _channel_grid(
    model: OccupancyMap, first: Tensor, last: Tensor, resolution: float, channel: str
) -> np.ndarray:
    """Values of a channel at all points of a `grid`, which must fit in memory."""
    axes = grid_axes(first, last, resolution)
    example = cell_values(model, torch.stack([axis[:1] for axis in axes], dim=1), channel)
    cells = math.prod(len(axis) for axis in axes)
    what = f"a channel of {cells / 1e6:.3g} million cells"
    check_memory(what, resolution, float(example.nbytes) * cells, power=len(axes))
    slabs = axes[0].split(max(1, BLOCK_POINTS * len(axes[0]) // max(1, cells)))
    points = (torch.stack(torch.meshgrid(s, *axes[1:], indexing="ij"), -1) for s in slabs)
    return np.concatenate([cell_values(model, part, channel) for part in points])


@torch.no_grad()
def _save_sparse(
    model: OccupancyMap,
    path: str | os.PathLike[str],
    resolution: float,
    first: Tensor,
    last: Tensor,
    channel: str | None,
) -> int:
    """Write the cells of all blocks near clusters; returns how many."""
    lattice, places = _blocks_of_cells(model, first, last, resolution)
    axes = torch.cartesian_prod(*[torch.arange(BLOCK_CELLS)] * 3)
    shape = (len(places), *[BLOCK_CELLS] * 3)

    def blocks() -> Iterator[Tensor]:
        for some in places.split(BLOCK_POINTS // len(axes)):
            yield first + resolution * (some[:, None] + axes).double()

    def probability(points: Tensor) -> np.ndarray:
        return model(points.to(model.origin.device)).float().cpu().numpy()

    answers: dict[str, Callable[[Tensor], np.ndarray]] = {"probability": probability}
    if channel is not None:
        answers[array_name(channel)] = partial(cell_values, model, channel=channel)
    small = {
        "blocks": places.numpy(),
        "lower": (first - 0.5 * resolution).numpy(),
        "resolution": np.float64(resolution),
        "cells": lattice.cells,
    }
    with (
        replaced_file(path) as unfinished,
        zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as file,
    ):
        for name, array in small.items():
            with file.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asanyarray(array))
        for name, ask in answers.items():
            example = ask(first[None])
            descr = "<" + example.dtype.str[1:]
            header = {"descr": descr, "fortran_order": False, "shape": shape + example.shape[1:]}
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for points in blocks():
                    member.write(ask(points).astype(descr).tobytes())
    return math.prod(shape)


def _blocks_of_cells(
    model: OccupancyMap, first: Tensor, last: Tensor, resolution: float
) -> tuple[Lattice, Tensor]:
    """Cells between two centers as a lattice, and the first cells (B, 3) of blocks near clusters."""
    cells = ((last - first) / resolution).round().long() + 1
    corner = (first / resolution - 0.5).round().long()
    lattice = Lattice(corner.numpy(), cells.numpy(), resolution)
    near = blocks_near_boxes(lattice, *cluster_boxes(model))
    return lattice, torch.from_numpy(lattice.place(near))


def _octomap_of(
    model: OccupancyMap, first: Tensor, last: Tensor, resolution: float
) -> tuple[Any, int]:
    """An OctoMap tree of the known cells between two centers, and their number."""
    if model.dim != 3:
        raise ValueError(f"an OctoMap needs a 3-D map; got {model.dim}-D. Use .npz")
    reach = float(torch.cat([first, last]).abs().max())
    if reach > _TREE_CELLS * resolution:
        raise ValueError(
            f"an OctoMap of {resolution} m cells spans {_TREE_CELLS * resolution:.0f} m on either "
            f"side of zero; the map reaches {reach:.0f} m. Use a larger resolution, or subtract "
            "model.origin from the scans"
        )
    _check_tree_memory(model, first, last, resolution)
    tree, count = new_tree(resolution), 0
    for centers, log_odds in _known_cells(model, first, last, resolution):
        for center, value in zip(to_array(centers), log_odds.tolist(), strict=True):
            tree.updateNode(center, value, False)  # not lazy: equal cells are pruned
        count += len(centers)
    return tree, count


def _check_tree_memory(model: OccupancyMap, first: Tensor, last: Tensor, resolution: float) -> None:
    """Raise a ValueError if the known cells would not fit in memory, by the volume near clusters."""
    coarse = float((last - first).max()) / _COARSE_CELLS + resolution
    corner = (first / coarse).floor().long()
    cells = (last / coarse).floor().long() - corner + 1
    lattice = Lattice(corner.numpy(), cells.numpy(), coarse)
    blocks = blocks_near_boxes(lattice, *cluster_boxes(model))
    volume = float(lattice.marched_cells(blocks).prod(axis=1).sum()) * coarse**3
    count = volume / resolution**3
    what = f"the tree would have up to {count / 1e6:.3g} million cells"
    check_memory(what, resolution, _TREE_BYTES * count, power=3)


@torch.no_grad()
def _known_cells(
    model: OccupancyMap, first: Tensor, last: Tensor, resolution: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """Centers (n, 3) and log-odds (n,) of the known cells, some blocks that hold clusters a time."""
    lattice, places = _blocks_of_cells(model, first, last, resolution)
    cells = torch.from_numpy(lattice.cells)
    local = torch.cartesian_prod(*[torch.arange(BLOCK_CELLS)] * 3)
    parts = (torch.cartesian_prod(*[torch.tensor([-0.25, 0.25])] * 3) * resolution).double()
    for some in places.split(BLOCK_POINTS // (8 * len(local))):
        index = (some[:, None] + local).reshape(-1, 3)
        centers = first + resolution * index[(index < cells).all(dim=1)].double()
        points = (centers[:, None] + parts).to(model.origin.device)
        log_odds = model.log_odds(points).float().amax(dim=1).cpu()
        known = log_odds.abs() >= LOG_ODDS_MARGIN
        yield centers[known], log_odds[known]
