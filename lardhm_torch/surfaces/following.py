"""Follow a level set of the log-odds from block to block, starting near the clusters.

Only blocks that contain the surface and their neighbors are evaluated, so time and memory grow with
the surface and not with the volume.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, local_parts, native_map, pieces
from lardhm_torch.native.surfaces import point_gradients
from lardhm_torch.queries.grids import SupportingClusters, occupancy_gradient
from lardhm_torch.surfaces.lattice import BLOCK_CELLS, SLOTS, Edges, Lattice
from lardhm_torch.surfaces.marching import Faces, march_blocks

BATCH_BLOCKS = 1024  # examined at a time
REGION_EDGE = 10.0  # [m] within which the surface is followed before other tiles are loaded
FRONT = (1.0, 2.0)  # [standard deviations] from a vertex, where it is tested: in front of it, ...
BEHIND, BEYOND = (-1.0, -2.0, -3.0), (-4.0, -6.0, -8.0)  # ... behind it, and beyond the surface
FREE_FACTOR = 3.0  # on the margin in front, where free space can leak through walls
FREER = 2.0  # times as far below the level as beyond the surface: so much suffices in front, too
LEAST_SHARE = 0.01  # of a lattice edge between its end and a vertex of a closed surface
SEED_RADII = torch.linspace(0, 4.5, 10)  # standard deviations from a center
SEED_CLUSTERS = 1 << 12  # whose lines are evaluated at a time
_WAYS = torch.tensor([*itertools.product((-1.0, 0.0, 1.0), repeat=3)], dtype=torch.float64)
SHORTEST = _WAYS[(_WAYS[:, :2] == 0).all(dim=1) & (_WAYS[:, 2] != 0)]  # lines by the principal axes
OTHERS = torch.cat(
    [
        _WAYS[(_WAYS.abs().sum(dim=1) == 1) & (_WAYS[:, 2] == 0)],
        _WAYS[_WAYS.abs().sum(dim=1) == 3] / 3**0.5,
    ]
)


class Rule(NamedTuple):
    """Which part of which level set is followed.

    Attributes:
        level: log-odds of the level set.
        sign: of the weights of the supporting clusters.
        threshold: log-odds of the surface, which is behind the level set or on it.
        log_odds_margin: required beyond the threshold on both sides of a face; None: none.
        is_closed: whether the border of the lattice is above the level, so that the surface ends nowhere.
    """

    level: float
    sign: int
    threshold: float
    log_odds_margin: float | None
    is_closed: bool = False

    @property
    def free(self) -> float:
        """Log-odds below which space can be free: unknown space never is."""
        return min(self.threshold, 0.0)

    @property
    def highest(self) -> float:
        """Log-odds above which space behind a face is known to be occupied, as for `raycast`."""
        return self.threshold + (self.log_odds_margin or 0.0)


class Sheet(NamedTuple):
    """A surface: vertices (V, 3) and faces (F, 3), and for each vertex its unit normal (V, 3), against
    the gradient of the log-odds, and the thickness of the nearest supporting cluster (V,). Of a closed
    surface also whether the vertex only closes a gap (V,).

    Positions are float64, in the world frame; lengths in meters.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    thickness: np.ndarray
    closing: np.ndarray | None = None

    def without_unused(self) -> Sheet:
        """The same surface without vertices that have no face."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        columns = {
            name: values[used]
            for name, values in self._asdict().items()
            if values is not None and name != "faces"
        }
        return Sheet(faces=(np.cumsum(used) - 1)[self.faces], **columns)


@torch.no_grad()
def follow_surface(
    model: OccupancyMap,
    lattice: Lattice,
    starts: np.ndarray,
    rule: Rule,
    allowed: np.ndarray | None = None,
    report: Callable[[int], object] = lambda _: None,
) -> Sheet:
    """The parts of a level set that can be reached from some blocks over supported faces.

    Lengths are standard deviations of the nearest supporting cluster (the smallest). A vertex is
    supported if the log-odds exceed the threshold by ``log_odds_margin`` within three of them behind it,
    and if the space up to two of them in front is free: the log-odds are `FREE_FACTOR` margins below the
    threshold, or `FREER` times as far below it as beyond the surface, four to eight of them behind the
    vertex. A face is kept if its three vertices are supported.

    Args:
        model: the map.
        lattice: over which the surface is followed.
        starts: (B,) ascending numbers of the blocks to begin with.
        rule: which surface.
        allowed: ascending numbers of the blocks that may be evaluated; None: all.
        report: called with the number of new faces after each batch of blocks.
    """
    found = _Found(lattice)
    pending = starts
    while len(pending):
        later = [np.zeros(0, dtype=np.int64)]
        for rows, part, region in _regions(model, lattice, pending):
            follower = _Follower(part, lattice, rule)
            todo = found.unknown(pending[rows])
            while len(todo):
                batch, rest = todo[:BATCH_BLOCKS], todo[BATCH_BLOCKS:]
                before = found.num_faces
                wanted = found.unknown(found.add(batch, follower.examine(batch)))
                report(found.num_faces - before)
                if allowed is not None:
                    wanted = wanted[_among(wanted, allowed)]
                inside = region(wanted)
                later.append(wanted[~inside])
                todo = np.union1d(rest, wanted[inside])
        pending = found.unknown(np.unique(np.concatenate(later)))
    return found.sheet()


@torch.no_grad()
def seed_blocks(model: OccupancyMap, lattice: Lattice, rule: Rule) -> np.ndarray:
    """Blocks in which the level set crosses a line that starts at the center of a supporting cluster.

    From each center, two lines run along the shortest principal axis, as far as `SEED_RADII`. If they do
    not cross the surface, lines along the other axes and between all three follow. One of several
    clusters that reach the same blocks is enough. Lines without the margin above the threshold count only
    if none is required.
    """
    found = [np.zeros(0, dtype=np.int64)]
    for piece in pieces(model, lattice.bounds if lattice.is_cut else None):
        chosen = _near(piece, lattice, rule.sign)
        for rows in chosen.split(SEED_CLUSTERS):
            axes, stds, _ = torch.linalg.svd(piece.scale_tril.detach()[rows].double())
            centers = piece.centers.detach()[rows].double() + piece.origin
            left = _apart(lattice, centers, SEED_RADII[4] * axes[..., 2] * stds[:, 2:])
            for ways in (SHORTEST, OTHERS):
                steps = ways.to(centers) @ (axes[left] * stds[left, None]).mT  # (R, W, 3)
                radii = SEED_RADII.to(steps)[:, None, None, None]
                lines = centers[left, None] + radii * steps  # (S, R, W, 3)
                crossed, ends = _crossed(model, lines, rule)
                found.append(lattice.blocks_at(ends.cpu().numpy()))
                left = left[~crossed]
    return np.unique(np.concatenate(found))


def _apart(lattice: Lattice, centers: Tensor, reach: Tensor) -> Tensor:
    """Rows of the centers (R, 3), without those that reach the same two blocks to either side (R, 3)."""
    sides = [lattice.block_places((centers + sign * reach).cpu().numpy()) for sign in (-1, 1)]
    _, first = np.unique(np.hstack(sides), axis=0, return_index=True)
    return torch.from_numpy(np.sort(first)).to(centers.device)


def _crossed(model: OccupancyMap, lines: Tensor, rule: Rule) -> tuple[Tensor, Tensor]:
    """(S, R, W, 3) points along lines -> (R,) whether any of W lines crosses the surface, and (N, 3)
    both ends of the steps that do."""
    log_odds = model.log_odds(lines)
    inside = log_odds > rule.level
    crossed = inside[1:] != inside[:-1]
    if rule.log_odds_margin is not None:
        crossed &= log_odds.amax(dim=0) > rule.highest
    return crossed.any(dim=2).any(dim=0), torch.cat([lines[1:][crossed], lines[:-1][crossed]])


def _near(piece: OccupancyMap, lattice: Lattice, sign: int) -> Tensor:
    """Rows of the clusters of a sign whose lines reach the lattice."""
    rows = (piece.weights.detach() * sign > 0).nonzero().squeeze(1)
    centers = piece.centers.detach()[rows].double() + piece.origin
    reach = SEED_RADII[-1] * piece.scale_tril.detach()[rows].double().norm(dim=2)
    lower, upper = (end.to(centers) for end in lattice.bounds)
    return rows[((centers + reach >= lower) & (centers - reach <= upper)).all(dim=1)]


def _regions(model: OccupancyMap, lattice: Lattice, blocks: np.ndarray) -> Iterator[tuple]:
    """Rows of the blocks that one map answers for, the map, and which further blocks it may examine."""
    edge = max(1, round(REGION_EDGE / (BLOCK_CELLS * lattice.resolution)))
    shape = -(-lattice.shape // edge)

    def numbers(of: np.ndarray) -> np.ndarray:
        return np.ravel_multi_index((lattice.place(of) // (BLOCK_CELLS * edge)).T, shape)

    regions, owner = np.unique(numbers(blocks), return_inverse=True)
    place = np.stack(np.unravel_index(regions, shape), axis=1) * edge * BLOCK_CELLS
    lower = torch.from_numpy((lattice.first + place) * lattice.resolution)
    upper = lower + edge * BLOCK_CELLS * lattice.resolution
    for chosen, part in local_parts(model, lower, upper):
        if part is model:  # it answers everywhere
            yield slice(None), part, lambda wanted: np.ones(len(wanted), dtype=bool)
            return
        own = regions[chosen.cpu().numpy()]
        rows = np.isin(regions[owner], own)
        yield rows, part, lambda wanted, own=own: np.isin(numbers(wanted), own)


class _Follower:
    """Examines blocks with one map."""

    def __init__(self, model: OccupancyMap, lattice: Lattice, rule: Rule) -> None:
        self.model, self.lattice, self.rule = model, lattice, rule
        self.clusters = SupportingClusters(model, rule.sign)

    def examine(self, blocks: np.ndarray) -> _Batch:
        """The surface in some blocks, and the supported part of it."""
        values = self.lattice.values(self.model, blocks)
        if self.rule.is_closed:
            values[self.lattice.is_border(blocks)] = self.rule.level + LEAST_SHARE
        cut = march_blocks(values, self.rule.level, self.lattice.marched_cells(blocks))
        shares = cut.shares
        if (
            self.rule.is_closed
        ):  # no two vertices coincide, so files without indices are closed, too
            shares = shares.clip(LEAST_SHARE, 1 - LEAST_SHARE)
        edges = Edges.of(self.lattice, blocks, cut.edges, shares)
        rows = np.flatnonzero(edges.is_owned)
        points = torch.from_numpy(edges.select(rows).crossings(self.lattice))
        points = points.to(self.model.origin.device)
        normals = self._normals(points)
        thickness = self.clusters.nearest(points).thickness
        chosen = self._supported(points, normals, thickness)
        columns = (points[chosen], normals[chosen].float(), thickness[chosen].float())
        rows = rows[chosen.cpu().numpy()]
        return _Batch(edges, cut, rows, *(column.cpu().numpy() for column in columns))

    def _normals(self, points: Tensor) -> Tensor:
        tensors = native_map(self.model)
        if tensors is not None:
            gradient = point_gradients(tensors, points)
        else:
            gradient = occupancy_gradient(self.model, points)
        return -torch.nn.functional.normalize(gradient, dim=1)

    def _supported(self, points: Tensor, normals: Tensor, thickness: Tensor) -> Tensor:
        """Ascending rows of the points with free space in front of them and occupied space behind."""
        rows, rule = torch.arange(len(points), device=points.device), self.rule
        if rule.log_odds_margin is None:
            return rows
        steps = normals * thickness[:, None]

        def log_odds(distances: tuple[float, ...]) -> Tensor:
            factors = torch.tensor(distances, dtype=torch.float64, device=points.device)
            return self.model.log_odds(points[rows] + factors[:, None, None] * steps[rows])

        rows = rows[log_odds(BEHIND).amax(dim=0) > rule.highest]
        in_front = log_odds(FRONT).amin(dim=0) - rule.free
        beyond = log_odds(BEYOND).amin(dim=0) - rule.free
        is_free = in_front < -FREE_FACTOR * rule.log_odds_margin
        return rows[is_free | (in_front < FREER * beyond.clamp(max=0))]


class _Batch(NamedTuple):
    """What was found in some blocks: crossed edges, the marched surface, and its supported vertices.

    ``rows`` (S,) are the supported ones among the edges that the blocks own, with their positions,
    normals and thicknesses.
    """

    edges: Edges
    cut: Faces
    rows: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    thickness: np.ndarray


class _Found:
    """The surface so far."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.known = np.zeros(0, dtype=np.int64)  # ascending numbers of the examined blocks
        self.order: list[np.ndarray] = []  # the same in the order in which they were examined
        self.keys: list[
            np.ndarray
        ] = []  # of the vertices: SLOTS x place in this order + slot; ascending
        self.vertices: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.faces: list[np.ndarray] = []  # vertex numbers, or -1 - key of an edge of another block
        self.num_vertices = self.num_faces = 0

    def unknown(self, blocks: np.ndarray) -> np.ndarray:
        """Those of the blocks that were not examined."""
        return blocks[~_among(blocks, self.known)]

    def add(self, blocks: np.ndarray, batch: _Batch) -> np.ndarray:
        """Take in what was found in new blocks; returns the numbers of the blocks to go on to."""
        edges, corners = batch.edges, batch.cut.faces
        self.keys.append(SLOTS * len(self.known) + batch.cut.edges[batch.rows])
        self.known = np.insert(self.known, np.searchsorted(self.known, blocks), blocks)
        self.order.append(blocks)
        self.vertices.append((batch.points, batch.normals, batch.thickness))
        is_supported = np.zeros(len(edges.axes), dtype=bool)
        is_supported[batch.rows] = True
        first, second, third = is_supported[corners].T
        begun = corners[first | second | third]
        first, second, third = (is_supported | ~edges.is_owned)[corners].T
        kept = corners[first & second & third]
        number = np.zeros(len(is_supported), dtype=np.int64)
        number[batch.rows] = self.num_vertices + np.arange(len(batch.rows))
        foreign = np.flatnonzero(~edges.is_owned)
        others = edges.select(foreign)
        number[foreign] = -1 - self.lattice.edge_keys(others.points, others.axes)
        self.faces.append(number[kept])
        self.num_vertices += len(batch.rows)
        self.num_faces += len(kept)
        used = np.zeros(len(is_supported), dtype=bool)
        used[begun] = True
        return edges.select(used & edges.is_on_border).touching_blocks(self.lattice)

    def sheet(self) -> Sheet:
        """The surface, welded at the borders of the blocks."""
        if self.num_vertices == 0:
            nothing = np.zeros((0, 3))
            return Sheet(nothing, nothing.astype(np.int64), nothing, nothing[:, 0])
        columns = (np.concatenate(column) for column in zip(*self.vertices, strict=True))
        points, normals, thickness = columns
        faces, keys, order = (np.concatenate(part) for part in (self.faces, self.keys, self.order))
        self.faces, self.vertices = [], []
        foreign = faces < 0
        block, slot = np.divmod(-1 - faces[foreign], SLOTS)
        place = np.argsort(order)[np.searchsorted(self.known, block).clip(max=len(order) - 1)]
        wanted = SLOTS * place + slot
        vertex = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
        exists = (order[place] == block) & (keys[vertex] == wanted)
        faces[foreign] = np.where(exists, vertex, -1)
        return Sheet(points, faces[(faces >= 0).all(axis=1)], normals, thickness)


def _among(values: np.ndarray, ascending: np.ndarray) -> np.ndarray:
    """(N,) whether each value is one of some ascending ones."""
    if len(ascending) == 0:
        return np.zeros(len(values), dtype=bool)
    place = np.searchsorted(ascending, values).clip(max=len(ascending) - 1)
    return ascending[place] == values
