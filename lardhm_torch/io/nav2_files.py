"""Maps to the files of Nav2's map_server: an image of cells, and a YAML file that describes it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.maps import OccupancyMap, TensorLike, reads_copy, to_tensor
from lardhm_torch.queries.grids import (
    LOG_ODDS_MARGIN,
    cluster_boxes,
    grid_axes,
    lattice_values,
    map_bounds,
)
from lardhm_torch.queries.memory import check_memory
from lardhm_torch.surfaces.lattice import BLOCK_CELLS, Lattice, blocks_near_boxes

MODES = ("trinary", "scale")
OCCUPIED, UNKNOWN, FREE = 0, 205, 254  # shades of map_saver: probability is (255 - shade) / 255
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # 205 is probability .19608: between both
COARSE = 8  # cells along an edge of a lattice cell, so a block has 64
UNSEEN = np.nan  # log-odds of unknown cells


class GroundGrid(NamedTuple):
    """A map seen from above.

    ``log_odds`` (nx, ny) float32, NaN where unknown; cell (0, 0) has its lower corner at ``first``
    (2,), in whole cells of ``resolution`` [m].
    """

    log_odds: np.ndarray
    first: np.ndarray
    resolution: float

    @property
    def corner(self) -> tuple[float, float]:
        """(x, y) of the lower corner of the first cell [m]."""
        x, y = (round(float(i) * self.resolution, 9) for i in self.first)
        return x, y

    def percent(self) -> np.ndarray:
        """(ny, nx) int8 values of nav_msgs/OccupancyGrid: -1 unknown, else probability in percent."""
        probability = 1 / (1 + np.exp(-np.nan_to_num(self.log_odds.T)))
        values = np.round(100 * probability)
        return np.where(np.isnan(self.log_odds.T), -1, values).astype(np.int8)

    def shades(self) -> np.ndarray:
        """(ny, nx, 4) uint8 colors: darker is more occupied, unknown cells are transparent."""
        known = ~np.isnan(self.log_odds.T)
        colors = np.zeros((*known.shape, 4), np.uint8)
        probability = 1 / (1 + np.exp(-self.log_odds.T[known]))
        colors[known, :3] = np.round(255 * (1 - probability))[:, None]
        colors[known, 3] = 255
        return colors


@reads_copy
def save_nav2(
    model: OccupancyMap,
    path: str | os.PathLike[str],
    resolution: float = 0.05,
    *,
    heights: tuple[float, float] | None = None,
    bounds: tuple[TensorLike, TensorLike] | None = None,
    mode: str = "trinary",
) -> tuple[int, int]:
    """Write the map as an occupancy grid for Nav2's map_server.

    The output is a YAML file and an image of the same name: ``.pgm`` in trinary mode, or ``.png`` in
    scale mode, where unknown cells are transparent. Cells lie at whole multiples of the resolution; the
    first row of the image has the largest y.

    As in an OctoMap projected to the ground, a cell is occupied if the log-odds are 1 or more
    (probability 0.73) anywhere in it. Otherwise it is free if they are -1 or less anywhere in it, and
    unknown if not. They are evaluated twice per cell along each axis, within the given heights.

    Args:
        model: a map of 2 or 3 dimensions.
        path: YAML file that ends in .yaml or .yml; existing files are replaced atomically.
        resolution: edge of a cell [m].
        heights: lowest and highest z of obstacles for the robot [m]; required in 3-D. The lowest z
            must be above the floor.
        bounds: lower and upper (x, y) of the grid [m]; further coordinates are ignored. None: all known
            cells.
        mode: "trinary" (occupied, free, unknown) or "scale" (probabilities of known cells).

    Returns:
        Width and height of the image in cells.

    Raises:
        ValueError: the extension or mode is unknown, the map is empty, heights do not match the
            dimension of the map, no cell is known, or the image would not fit in memory.
        FileNotFoundError: the folder of path does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path must end in .yaml or .yml for Nav2; got {target.name!r}")
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}; got {mode!r}")
    found = ground_grid(model, resolution, heights=heights, bounds=bounds)
    if found.log_odds.size == 0:
        raise ValueError(
            "the map must have known cells for Nav2; none is, or none between the heights"
        )
    log_odds = found.log_odds
    image = target.with_suffix(".pgm" if mode == "trinary" else ".png")
    write = _write_trinary if mode == "trinary" else _write_scale
    with replaced_file(image) as partial:
        write(log_odds.T[::-1], partial)
    corner = ", ".join(map(repr, found.corner))
    lines = [
        f"image: {image.name}",
        f"mode: {mode}",
        f"resolution: {resolution!r}",
        f"origin: [{corner}, 0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    ]
    with replaced_file(target) as partial:
        partial.write_text("\n".join([*lines, ""]))
    columns, rows = map(int, log_odds.shape)
    return columns, rows


def ground_grid(
    model: OccupancyMap,
    resolution: float = 0.05,
    *,
    heights: tuple[float, float] | None = None,
    bounds: tuple[TensorLike, TensorLike] | None = None,
) -> GroundGrid:
    """The log-odds that stand for each cell of the ground, as described for `save_nav2`.

    Args:
        model: a map of 2 or 3 dimensions.
        resolution: edge of a cell [m].
        heights: lowest and highest z of obstacles for the robot [m]; needed in 3-D.
        bounds: lower and upper (x, y) of the grid [m]. None: all known cells, which may be none.

    Returns:
        The grid, of cells at whole multiples of the resolution.

    Raises:
        ValueError: the map is empty, heights do not fit its dimension, or the grid would not fit in
            memory.
    """
    levels = _levels(model, heights, resolution)
    log_odds, first = _ground_log_odds(model, resolution, levels, bounds)
    if bounds is None:
        log_odds, first = _cropped(log_odds, first)
    return GroundGrid(log_odds, first, resolution)


def _levels(
    model: OccupancyMap, heights: tuple[float, float] | None, resolution: float
) -> list[Tensor]:
    """Coordinates of the third axis: none in 2-D."""
    if model.dim not in (2, 3):
        raise ValueError(f"Nav2 needs a map of 2 or 3 dimensions; got {model.dim}")
    if (heights is None) != (model.dim == 2):
        raise ValueError(
            f"heights must be the lowest and highest z in 3-D, and None in 2-D; got {heights}"
        )
    if heights is None:
        return []
    return grid_axes([heights[0]], [heights[1]], resolution / 2, model.origin.device)


def _ground_log_odds(
    model: OccupancyMap,
    resolution: float,
    levels: list[Tensor],
    bounds: tuple[TensorLike, TensorLike] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """(nx, ny) log-odds that stand for each cell, NaN where it is unknown, and the first cell (2,)."""
    lower, upper = cluster_boxes(model)
    if levels and len(lower):
        touching = (upper[:, 2] >= levels[0][0]) & (lower[:, 2] <= levels[0][-1])
        lower, upper = lower[touching], upper[touching]
    ends = map_bounds(model) if bounds is None else bounds  # raises for an empty map
    low, high = (to_tensor(end, "bounds").cpu()[:2] for end in ends)
    grid_axes(low, high, resolution)  # raises for what is no resolution and no corners
    first = (low / resolution + 1e-6).floor().long().numpy()
    last = (high / resolution - 1e-6).ceil().long().numpy()
    counts = (last - first).clip(min=1)
    cells = float(counts[0]) * float(counts[1])
    check_memory(f"the image would have {cells / 1e6:.3g} million cells", resolution, 8 * cells, 2)
    log_odds = np.full(tuple(counts), UNSEEN, dtype=np.float32)
    for place in _tiles(lower, upper, first, counts, resolution):
        end = np.minimum(place + COARSE * BLOCK_CELLS, counts)
        part = slice(place[0], end[0]), slice(place[1], end[1])
        log_odds[part] = _tile(model, first + place, end - place, resolution, levels)
    return log_odds, first


def _tiles(
    lower: Tensor, upper: Tensor, first: np.ndarray, counts: np.ndarray, resolution: float
) -> Iterator[np.ndarray]:
    """First cells (2,), counted from that of the grid, of the tiles that a cluster's box touches."""
    corner = torch.as_tensor(first) * resolution
    flat = [torch.zeros(len(lower), 3, dtype=torch.float64) for _ in range(2)]
    for box, ends in zip(flat, (lower, upper), strict=True):
        box[:, :2] = ends.cpu()[:, :2] - corner
    cells = np.append(-(-counts // COARSE), 1)
    lattice = Lattice(np.zeros(3, dtype=np.int64), cells, COARSE * resolution)
    yield from COARSE * lattice.place(blocks_near_boxes(lattice, flat[0], flat[1]))[:, :2]


def _tile(
    model: OccupancyMap,
    first: np.ndarray,
    counts: np.ndarray,
    resolution: float,
    levels: list[Tensor],
) -> np.ndarray:
    """Log-odds that stand for the cells of one tile: the highest if occupied, the lowest if free."""
    axes = [
        resolution * (start + 0.25 + 0.5 * torch.arange(2 * count, dtype=torch.float64))
        for start, count in zip(first.tolist(), counts.tolist(), strict=True)
    ]
    axes = [axis.to(model.origin.device) for axis in axes]
    values = lattice_values(model, axes + levels, probability=False).float().cpu().numpy()
    values = values.reshape(counts[0], 2, counts[1], 2, -1)
    highest, lowest = values.max(axis=(1, 3, 4)), values.min(axis=(1, 3, 4))
    free = np.where(lowest <= -LOG_ODDS_MARGIN, lowest, UNSEEN)
    return np.where(highest >= LOG_ODDS_MARGIN, highest, free)


def _cropped(log_odds: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of the grid that contains all known cells."""
    known = np.argwhere(~np.isnan(log_odds))
    if len(known) == 0:
        return log_odds[:0, :0], first
    low, high = known.min(axis=0), known.max(axis=0) + 1
    return log_odds[low[0] : high[0], low[1] : high[1]], first + low


def _write_trinary(log_odds: np.ndarray, path: Path) -> None:
    shades = np.full(log_odds.shape, UNKNOWN, dtype=np.uint8)
    shades[log_odds > 0] = OCCUPIED
    shades[log_odds < 0] = FREE
    path.write_bytes(f"P5\n{len(shades[0])} {len(shades)}\n255\n".encode() + shades.tobytes())


def _write_scale(log_odds: np.ndarray, path: Path) -> None:
    from matplotlib.image import imsave

    known = ~np.isnan(log_odds)
    free = 1 / (1 + np.exp(np.nan_to_num(log_odds)))
    pixels = np.zeros((*log_odds.shape, 4), dtype=np.uint8)
    pixels[..., :3] = np.round(255 * free)[..., None]
    pixels[..., 3] = np.where(known, 255, 0)
    imsave(path, np.ascontiguousarray(pixels))
