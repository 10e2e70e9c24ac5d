"""Where rays end in a map: the first obstacle along each, empty space skipped.

A map is anything with the members of `LardHilbertMap` that are used here: ``log_odds(points)``,
``centers``, ``scale_tril``, ``weights``, ``origin`` and ``dim``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lardhm_torch.queries.bounds import Cells, ceiling_box, cover_cells, log_odds_ceiling
from lardhm_torch.queries.grids import BLOCK_POINTS, EVIDENCE, SURFACES, local_parts

BINS_AN_OCTAVE = 16  # by which thicknesses are counted: 4 % from one to the next
BISECTIONS = 16  # a step of 5 cm is narrowed down to below 1 µm
STRIDE = 4  # steps of a block, which is asked as a whole
WINDOW = 32  # blocks of a ray between looks at which rays are done
ROUNDS = (2, 6, 14)  # blocks that may be occupied asked first, second, third; then the rest
RAYS_AT_ONCE = 1 << 17
NONE = 1 << 40  # a step that no ray reaches
MOST_CELLS = 1 << 22  # of the lattice by which empty space is skipped
SKIP_FROM = 1 << 22  # steps of all rays from which the lattice pays for itself


class _Rays(NamedTuple):
    """R rays, world frame: origins and unit directions (R, D) float64 [m], and number of steps."""

    origins: Tensor
    directions: Tensor
    step: float
    max_range: float

    @property
    def last(self) -> int:
        """Number of the last step, which is at max_range."""
        return math.ceil(self.max_range / self.step - 1e-9)

    def depths(self, steps: Tensor) -> Tensor:
        """Numbers of steps -> distance from the origin [m]."""
        return (steps.double() * self.step).clamp(max=self.max_range)

    def log_odds(self, model: Any, rays: Tensor, depths: Tensor) -> Tensor:
        """(A, S) log-odds at (A, S) depths of the rays with these (A,) numbers."""
        origins, directions = self.origins[rays, None], self.directions[rays, None]
        return model.log_odds(torch.addcmul(origins, depths.to(origins)[..., None], directions))

    def rough(self) -> _Rays:
        """The same in float32, where that is off by no more than a thousandth of a step."""
        if not len(self.origins):
            return self
        far = float(self.origins.abs().max()) + self.max_range
        if far * torch.finfo(torch.float32).eps > 1e-3 * self.step:
            return self
        return self._replace(origins=self.origins.float(), directions=self.directions.float())


@torch.no_grad()
def raycast(
    model: Any,
    origins: Tensor,
    directions: Tensor,
    max_range: float,
    threshold: float = 0.5,
    step: float | None = None,
    *,
    surface: str = "peak",
) -> Tensor:
    """Distance along each ray to the first obstacle.

    The ray is sampled every ``step`` until log-odds are clearly above the threshold, by 1: without
    that margin the ripple around 0 where nothing was measured would stop rays. Then

    - ``surface="peak"`` goes on to the ridge: the largest log-odds before they fall by 1 again. That
      is where the hits lie, so it is the range that a sensor would measure.
    - ``surface="crossing"`` goes back to where log-odds last crossed the threshold, and bisects.
      Free space is learned only up to some centimeters before the hits, so this lies about 10 cm
      in front of the surface: on the safe side for a robot. A ray that starts clearly above the
      threshold gives 0; one that starts in between is met where it gets clearly above.

    Many rays skip the cells of a lattice in which the map is nowhere that sure (`bounding`); the
    answers are the same.

    Args:
        model: the map.
        origins: (R, D) or (D,) starts, world frame [m].
        directions: (R, D) of any length but 0.
        max_range: where to give up [m].
        threshold: probability of occupancy that counts as an obstacle, between 0 and 1.
        step: [m]; an obstacle thinner than this can be missed. Left out: `surface_step`, the median
            standard deviation of the occupied clusters across their surface, a third of a wall or
            less.
        surface: "peak" or "crossing".

    Returns:
        (R,) float64 distances [m], infinite where nothing is met up to max_range.

    Raises:
        ValueError: shapes do not match, a direction is zero or not finite, or another argument is
            not in its range.
    """
    if surface not in SURFACES:
        raise ValueError(f"surface must be one of {', '.join(SURFACES)}; got {surface!r}")
    check_rays(model, origins, directions, max_range, step)
    if not 0 < threshold < 1:
        raise ValueError(f"threshold must be between 0 and 1, both excluded; got {threshold}")
    origins, directions = unit_rays(model, origins, directions)
    result = origins.new_full((len(origins),), torch.inf)
    ends = origins + max_range * directions
    step = min(surface_step(model) if step is None else step, max_range)
    for rows, part in local_parts(model, origins.minimum(ends), origins.maximum(ends)):
        rays = _Rays(origins[rows], directions[rows], step, max_range)
        result[rows] = _raycast(part, rays, threshold, surface)
    return result


def _raycast(model: Any, rays: _Rays, threshold: float, surface: str) -> Tensor:
    origins, directions, step, max_range = rays
    level = math.log(threshold / (1 - threshold))
    if getattr(model, "query_rays", None) is not None:
        march = (step, max_range, level, level + EVIDENCE, surface == "peak")
        ranges = model.query_rays(origins, directions, march)
        if ranges is not None:
            return ranges
    maybe = _empty_space(model, level + EVIDENCE, step, max_range, len(directions))
    parts = []
    for part in torch.arange(len(directions), device=directions.device).split(RAYS_AT_ONCE):
        rays = _Rays(origins[part], directions[part], step, max_range)
        clear = _first_clear(model, rays.rough(), level + EVIDENCE, maybe)
        refine = _peak if surface == "peak" else _crossing
        result = origins.new_full((len(part),), torch.inf)
        met = (clear >= 0).nonzero().squeeze(1)
        result[met] = refine(model, rays, met, clear[met], level)
        parts.append(result)
    return torch.cat(parts) if parts else origins.new_zeros(0)


def unit_rays(model: Any, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """(R, D) origins and (R, D) directions of length 1, float64, on the map's device."""
    device = model.origin.device
    directions = directions.to(device, torch.float64)
    directions = directions / torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    return origins.to(device, torch.float64).expand_as(directions), directions


def check_rays(
    model: Any, origins: Tensor, directions: Tensor, max_range: float, step: float | None
) -> None:
    """A ValueError that says what is wrong with the rays, if anything is."""
    if directions.ndim != 2 or directions.shape[1] != model.dim:
        raise ValueError(f"directions must be (R, {model.dim}); got {tuple(directions.shape)}")
    if tuple(origins.shape) not in (tuple(directions.shape), (model.dim,)):
        raise ValueError(
            f"origins must be {tuple(directions.shape)} as the directions, or one ({model.dim},); "
            f"got {tuple(origins.shape)}"
        )
    lengths = torch.linalg.vector_norm(directions.double(), dim=1)
    if not ((lengths > 0) & lengths.isfinite()).all():
        raise ValueError("directions must be finite and not zero; got one that is")
    if not (max_range > 0 and math.isfinite(max_range)):
        raise ValueError(f"max_range must be > 0 m and finite; got {max_range}")
    if step is not None and not step > 0:
        raise ValueError(f"step must be > 0 m; got {step}")


def _first_clear(model: Any, rays: _Rays, target: float, maybe: _Maybe | None) -> Tensor:
    """(R,) number of the first step with log-odds above the target; -1 where there is none."""
    device = rays.origins.device
    found = torch.full((len(rays.origins),), NONE, device=device)
    active = torch.arange(len(found), device=device)
    for start in range(0, rays.last + 1, WINDOW * STRIDE):
        number = start + STRIDE * torch.arange(WINDOW, device=device)  # first steps of the blocks
        number = number[number <= rays.last]
        if maybe is None:
            occupied = torch.ones(len(active), len(number), dtype=torch.bool, device=device)
        else:
            occupied = maybe.holds(rays, active, number)
        rank = occupied.cumsum(dim=1)  # blocks before the first clear one are asked in batches
        for low, high in itertools.pairwise((0, *ROUNDS, WINDOW)):
            asked = occupied & (rank > low) & (rank <= high) & (found[active] == NONE)[:, None]
            row, block = asked.nonzero(as_tuple=True)
            for part in torch.arange(len(row), device=device).split(BLOCK_POINTS // STRIDE):
                _search(model, rays, active[row[part]], number[block[part]], target, found)
        active = active[found[active] == NONE]
        if len(active) == 0:
            break
    return torch.where(found == NONE, -1, found)


def _search(
    model: Any, rays: _Rays, owner: Tensor, number: Tensor, target: float, found: Tensor
) -> None:
    """Write the first clear step of each (B,) block, if it comes before what is found already."""
    numbers = number[:, None] + torch.arange(STRIDE, device=number.device)
    clear = rays.log_odds(model, owner, rays.depths(numbers)) > target
    hit = clear.any(dim=1)
    first = (number + clear.to(torch.uint8).argmax(dim=1))[hit].clamp(max=rays.last)
    found.scatter_reduce_(0, owner[hit], first, "amin")


def _crossing(model: Any, rays: _Rays, met: Tensor, clear: Tensor, level: float) -> Tensor:
    """(A,) depth of the last crossing of the level before each clear step."""
    below = torch.full_like(clear, -1)
    active = (clear > 0).nonzero().squeeze(1)
    position = clear.clone()
    steps = torch.arange(-STRIDE, 0, device=clear.device)
    while len(active):
        numbers = position[active, None] + steps
        low = rays.log_odds(model, met[active], rays.depths(numbers.clamp(min=0))) <= level
        last = torch.where(low & (numbers >= 0), numbers, -1).amax(dim=1)
        below[active] = last
        position[active] -= STRIDE
        active = active[(last < 0) & (position[active] > 0)]
    high = rays.depths(clear)
    unknown = below < 0  # never below the level: from there it is met where it gets clear
    low = torch.where(unknown, (high - rays.step).clamp(min=0.0), rays.depths(below))
    target = torch.where(unknown, level + EVIDENCE, level)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        above = rays.log_odds(model, met, middle[:, None]).squeeze(1) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return high


def _peak(model: Any, rays: _Rays, met: Tensor, clear: Tensor, level: float) -> Tensor:
    """(A,) depth of the largest log-odds from each clear step on, before they fall by 1."""
    best = torch.full(clear.shape, -torch.inf, dtype=torch.float64, device=clear.device)
    place, position = clear.clone(), clear.clone()
    active = torch.arange(len(clear), device=clear.device)
    steps = torch.arange(STRIDE, device=clear.device)
    while len(active):
        numbers = position[active, None] + steps
        values = rays.log_odds(model, met[active], rays.depths(numbers)).double()
        values = torch.cat([best[active, None], values], dim=1)
        highest = values.cummax(dim=1)
        fallen = values < highest.values - EVIDENCE
        over = fallen.any(dim=1)
        end = torch.where(over, fallen.to(torch.uint8).argmax(dim=1), STRIDE)[:, None]
        best[active] = highest.values.gather(1, end).squeeze(1)
        index = highest.indices.gather(1, end).squeeze(1)
        place[active] = torch.where(index > 0, position[active] + index - 1, place[active])
        position[active] += STRIDE
        active = active[~over & (position[active] <= rays.last)]
    depths, width = rays.depths(place), rays.step
    for _ in range(2):
        depths, width = _vertex(model, rays, met, depths, width), width / 4
    return depths


def _vertex(model: Any, rays: _Rays, met: Tensor, depths: Tensor, width: float) -> Tensor:
    """(A,) depths moved to the top of the parabola through three log-odds ``width`` apart."""
    around = depths[:, None] + width * torch.tensor([-1.0, 0.0, 1.0], device=depths.device)
    around = around.clamp(min=0.0, max=rays.max_range)
    before, here, after = rays.log_odds(model, met, around).double().unbind(dim=1)
    bend = before - 2 * here + after
    shift = torch.where(bend < 0, 0.5 * (before - after) / bend, 0.0).clamp(-1.0, 1.0)
    return (depths + width * shift).clamp(min=0.0, max=rays.max_range)


class _Maybe(NamedTuple):
    """Cells of a lattice, and (cells,) bool: whether the log-odds can exceed the target in a block
    of steps whose middle is in the cell."""

    cells: Cells
    occupied: Tensor

    def holds(self, rays: _Rays, active: Tensor, number: Tensor) -> Tensor:
        """(A, B) whether the blocks with these (B,) first steps can be occupied on each ray."""
        edge, shape = self.cells.edge, self.cells.shape
        start = (rays.origins[active].double() - self.cells.corner.to(rays.origins.device)) / edge
        start, way = start.float(), (rays.directions[active] / edge).float()
        depth = ((number + (STRIDE - 1) / 2) * rays.step).float()
        place = torch.zeros(len(active), len(number), dtype=torch.long, device=number.device)
        for axis, count in enumerate(shape):
            cell = torch.addcmul(start[:, axis, None], way[:, axis, None], depth)
            place = place * count + cell.clamp_(0, count - 1).to(torch.int64)
        return self.occupied[place]


def _empty_space(
    model: Any, target: float, step: float, max_range: float, num_rays: int
) -> _Maybe | None:
    """Where rays may be stopped; None where there is nothing to gain or to say.

    The outermost cells are empty, so a point outside the lattice may be looked up in them.
    """
    if num_rays * max_range / step < SKIP_FROM or model.dim > 3 or target <= 0:
        return None
    box = ceiling_box(model, target)
    if box is None:
        return None
    size = float((box[1] - box[0]).max())
    rounding = 1e-6 * (size + max_range)  # of the float32 that finds the cell
    margin = (STRIDE - 1) / 2 * step + rounding
    cells = cover_cells(box[0] - margin, box[1] + margin, step, MOST_CELLS)
    cells = Cells(cells.corner - cells.edge, cells.edge, tuple(n + 2 for n in cells.shape))
    ceiling = log_odds_ceiling(model, cells, target, margin=margin)
    return _Maybe(cells, (ceiling > target).reshape(-1))


def thickness_counts(model: Any) -> dict[int, int]:
    """How many of the clusters that speak for occupied have which thickness, in bins.

    A cluster's thickness t is its smallest standard deviation; it is in bin
    floor(`BINS_AN_OCTAVE` log2(t / 1 m)). Counts of parts of a map add up to those of the whole.
    """
    factors = model.scale_tril[model.weights > 0].detach().double()
    thickness = torch.linalg.svdvals(factors)[:, -1].clamp(min=1e-30)
    bins, counts = (BINS_AN_OCTAVE * thickness.log2()).floor().long().unique(return_counts=True)
    return dict(zip(bins.tolist(), counts.tolist(), strict=True))


def surface_step(model: Any) -> float:
    """Median thickness of the clusters that speak for occupied [m], to 2 %: the middle of its bin.

    In bins, so that a map in tiles has the very step that it would have in one piece.

    Raises:
        ValueError: the map has no such cluster and so no surface.
    """
    known = hasattr(model, "thickness_counts")
    counts: Mapping[int, int] = model.thickness_counts() if known else thickness_counts(model)
    if not counts:
        raise ValueError("the map must hold a cluster of positive weight; got none: give a step")
    left = (sum(counts.values()) - 1) // 2
    for number in sorted(counts):
        left -= counts[number]
        if left < 0:
            break
    return float(2 ** ((number + 0.5) / BINS_AN_OCTAVE))
