"""Simulation of three laser scanners in a furnished room of 40 m² with a known surface.

The room consists of boxes, upright cylinders and spheres inside a box-shaped shell with a doorway and
a window. Ray intersections are computed in closed form, and the ground-truth mesh is built from the
same shapes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.channels import CLASS, COLOR
from lardhm_torch.scans import Scans, seeded_generator

if TYPE_CHECKING:
    import trimesh

Box = tuple[float, float, float, float, float, float]  # x, y, z of the lower and the upper corner

ROOM = (8.0, 5.0, 2.6)  # [m] upper corner of the shell; the lower corner is (0, 0, 0)
MAX_RANGE = 10.0  # [m] length of a beam that leaves through an opening
MAX_ELEVATION = math.radians(75)  # limit of the vertical field of view, up and down
SCANNERS = ((1.7, 3.1, 1.35), (4.4, 0.8, 1.6), (6.4, 3.6, 1.2))  # [m]


class Opening(NamedTuple):
    """A rectangular opening: u along the wall, z in height; ``far``: the wall at the upper bound."""

    axis: int
    far: bool
    u: tuple[float, float]
    z: tuple[float, float]


OPENINGS = (
    Opening(axis=1, far=False, u=(6.0, 6.9), z=(0.0, 2.05)),  # doorway
    Opening(axis=0, far=False, u=(1.5, 3.3), z=(0.9, 2.1)),  # window
)


def _table(x: float, y: float, width: float, depth: float) -> list[Box]:
    """A table top on four legs, with its lower corner at (x, y)."""
    legs = [(x + i * (width - 0.07), y + j * (depth - 0.07)) for i in (0, 1) for j in (0, 1)]
    top = (x, y, 0.71, x + width, y + depth, 0.75)
    return [top, *((a, b, 0.0, a + 0.07, b + 0.07, 0.71) for a, b in legs)]


def _chair(x: float, y: float, back_at: float) -> list[Box]:
    """A seat of 0.44 m on four legs, with the backrest on the lower (0) or upper (1) side in y."""
    legs = [(x + i * 0.39, y + j * 0.39) for i in (0, 1) for j in (0, 1)]
    seat = (x, y, 0.42, x + 0.44, y + 0.44, 0.47)
    back = (x, y + back_at * 0.39, 0.47, x + 0.44, y + back_at * 0.39 + 0.05, 0.95)
    return [seat, back, *((a, b, 0.0, a + 0.05, b + 0.05, 0.42) for a, b in legs)]


def _sofa() -> list[Box]:
    """Base, backrest and two armrests, placed along the wall y = 5."""
    arms = [(x, 4.1, 0.0, x + 0.2, 5.0, 0.62) for x in (0.5, 2.5)]
    return [(0.7, 4.1, 0.0, 2.5, 5.0, 0.42), (0.7, 4.75, 0.42, 2.5, 5.0, 0.85), *arms]


def _shelf() -> list[Box]:
    """Two sides and five boards against the wall x = 8, without a back panel."""
    sides = [(7.65, y, 0.0, 8.0, y + 0.05, 2.0) for y in (3.0, 4.55)]
    boards = [(7.65, 3.05, z, 8.0, 4.55, z + 0.04) for z in (0.1, 0.55, 1.0, 1.45, 1.96)]
    return [*sides, *boards]


BOXES: tuple[Box, ...] = (
    *_table(2.2, 1.4, 1.7, 0.9),
    *_chair(2.45, 0.85, back_at=0),
    *_chair(3.2, 0.85, back_at=0),
    *_chair(2.45, 2.4, back_at=1),
    *_chair(3.2, 2.4, back_at=1),
    *_sofa(),
    *_shelf(),
    (4.95, 3.3, 0.0, 5.07, 5.0, 2.6),  # partition wall
    (7.4, 0.3, 0.0, 8.0, 1.9, 2.1),  # wardrobe
    (5.3, 4.4, 0.0, 6.8, 5.0, 0.8),  # sideboard
    (0.0, 0.0, 0.0, 0.5, 1.2, 0.9),  # chest
)
# x, y of the axis, radius, lower and upper z [m]
CYLINDERS = (
    (5.6, 1.7, 0.18, 0.0, 2.6),  # column
    (1.6, 3.55, 0.3, 0.36, 0.42),  # coffee table: top and foot
    (1.6, 3.55, 0.06, 0.0, 0.36),
    (0.6, 3.7, 0.15, 0.0, 0.04),  # floor lamp: base and pole
    (0.6, 3.7, 0.025, 0.04, 1.4),
)
# x, y, z of the center, radius [m]
SPHERES = ((0.6, 3.7, 1.55, 0.2), (6.0, 4.7, 1.0, 0.2))  # shade of the lamp, globe


def simulate_room(
    num_rays: int = 50_000,
    noise: float = 0.02,
    seed: int = 0,
    *,
    exposure_noise: float = 0.0,
    wrong_labels: float = 0.0,
) -> Scans:
    """Simulate three laser scanners in a furnished room of 8 m x 5 m x 2.6 m.

    Each scanner emits one third of the rays, evenly distributed over all directions up to 75 degrees
    above and below the horizon (a spherical spiral with a random rotation). Rays through the doorway
    or the window do not return: ``is_return`` is False, and they end after 10 m.

    Args:
        num_rays: total number of rays.
        noise: standard deviation of the Gaussian range noise [m]. The paper writes
            sigma² = N(0, 0.1), which leaves the unit open; 0.02 m is typical of laser scanners.
        seed: random seed of the rotations of the spirals and of the noise.
        exposure_noise: standard deviation of the logarithm of the exposure of each scanner; the
            brightness of each ray has additional noise of half that standard deviation.
        wrong_labels: fraction of the rays that get the label of a random other class.

    Returns:
        Scans with three origins, in the world frame, with the channels "color" and "class" (an index
        into `CLASS_NAMES`).

    Raises:
        ValueError: num_rays is below 3, noise or exposure_noise is negative, or wrong_labels is not
            from 0 to 1.

    Source: Guizilini & Ramos 2016, Section IV-A (three simulated lasers, about 40 m², 50k points).
    """
    if num_rays < 3:
        raise ValueError(f"num_rays must be at least 3, one per scanner; got {num_rays}")
    if not noise >= 0:
        raise ValueError(f"noise must be >= 0 m; got {noise}")
    if not exposure_noise >= 0 or not 0 <= wrong_labels <= 1:
        raise ValueError(
            "exposure_noise must be >= 0 and wrong_labels from 0 to 1; "
            f"got {exposure_noise} and {wrong_labels}"
        )
    rng = torch.Generator().manual_seed(seed)
    origins = torch.tensor(SCANNERS, dtype=torch.float64)
    counts = [(num_rays + i) // len(SCANNERS) for i in range(len(SCANNERS))]
    scan_id = torch.repeat_interleave(torch.arange(len(SCANNERS)), torch.tensor(counts))
    directions = torch.cat([_spiral(count, rng) for count in counts])
    ranges, shapes = first_shapes(origins[scan_id], directions)
    is_return = ranges.isfinite()
    surface = origins[scan_id] + ranges.where(is_return, 0)[:, None] * directions
    classes = surface_classes(shapes, surface, ROOM[2])
    channels = measured_materials(
        classes,
        surface_colors(classes, surface),
        scan_id,
        is_return,
        exposure_noise=exposure_noise,
        wrong_labels=wrong_labels,
        rng=seeded_generator(seed, "materials"),
    )
    error = noise * torch.randn(num_rays, generator=rng, dtype=torch.float64)
    ranges = torch.where(is_return, (ranges + error).clamp(min=0.0), MAX_RANGE)
    ends = origins[scan_id] + ranges[:, None] * directions
    return Scans(origins, ends, scan_id, is_return, channels=channels)


def true_ranges(origins: Tensor, directions: Tensor) -> Tensor:
    """Distance along each ray to the first surface of the room, without noise.

    Args:
        origins: (R, 3) starts inside the room, outside the furniture, world frame [m].
        directions: (R, 3) unit vectors.

    Returns:
        (R,) ranges [m]; infinite where the ray leaves through the doorway or the window.
    """
    return first_shapes(origins, directions)[0]


def true_classes(points: Tensor, scan_origins: Tensor) -> Tensor:
    """(R, 3) hits, with noise, and (R, 3) origins of their rays [m] -> (R,) true classes."""
    directions = torch.nn.functional.normalize(points - scan_origins, dim=1)
    ranges, shapes = first_shapes(scan_origins, directions)
    surface = scan_origins + ranges[:, None] * directions
    return surface_classes(shapes, surface, ROOM[2])


def first_shapes(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The (R,) ranges of `true_ranges`, and the (R,) number of the shape that each ray hits.

    Boxes, cylinders and spheres are numbered in this order; -1 is the shell.
    """
    ranges = _shell_ranges(origins, directions)
    shapes = torch.full(ranges.shape, -1, device=ranges.device)
    for number, (near, is_hit) in enumerate(_shape_ranges(origins, directions)):
        shapes[is_hit & (near < ranges)] = number
        ranges = torch.where(is_hit, torch.minimum(ranges, near), ranges)
    return ranges, shapes


def _shape_ranges(origins: Tensor, directions: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """(R,) distance at which rays enter each shape, and (R,) whether they do."""
    for box in BOXES:
        near, far = _slab(origins, directions, origins.new_tensor(box))
        yield near, (near <= far) & (near > 0)
    for x, y, radius, low, high in CYLINDERS:
        round_near, round_far = _ball(origins, directions, (x, y), radius)
        height = origins.new_tensor([low, high])
        flat_near, flat_far = _slab(origins[:, 2:], directions[:, 2:], height)
        near = torch.maximum(round_near, flat_near)
        yield near, (near <= torch.minimum(round_far, flat_far)) & (near > 0)
    for *center, radius in SPHERES:
        near, far = _ball(origins, directions, tuple(center), radius)
        yield near, (near <= far) & (near > 0)


def room_mesh() -> trimesh.Trimesh:
    """Ground-truth mesh of the room: shell and furniture, with normals pointing into free space.

    Furniture faces that lie on the shell (such as the underside of a sofa) are omitted. Shapes that
    touch or overlap are not cut: no ray hits the faces inside another shape.
    """
    import trimesh

    parts = []
    for box in BOXES:
        parts.append(trimesh.creation.box(bounds=np.reshape(box, (2, 3))))
    for x, y, radius, low, high in CYLINDERS:
        part = trimesh.creation.cylinder(radius=radius, height=high - low, sections=96)
        parts.append(part.apply_translation((x, y, (low + high) / 2)))
    for *center, radius in SPHERES:
        part = trimesh.creation.icosphere(subdivisions=4, radius=radius)
        parts.append(part.apply_translation(center))
    furniture = _join(parts)
    corners = furniture.triangles  # (F, 3 corners, 3)
    on_shell = [np.isclose(corners, wall).all(axis=1).any(axis=1) for wall in (0.0, ROOM)]
    furniture.update_faces(~(on_shell[0] | on_shell[1]))
    furniture.remove_unreferenced_vertices()
    return _join([furniture, _shell_mesh()])


def _join(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Concatenate meshes without merging vertices."""
    import trimesh

    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + n for part, n in zip(parts, before, strict=False)])
    return trimesh.Trimesh(vertices, faces, process=False)


def _spiral(count: int, rng: torch.Generator) -> Tensor:
    """(count, 3) unit vectors, evenly distributed between the minimum and maximum elevation."""
    steps = torch.arange(count, dtype=torch.float64)
    up = math.sin(MAX_ELEVATION) * (1 - (2 * steps + 1) / count)
    golden_angle = math.pi * (3 - math.sqrt(5))
    azimuth = golden_angle * steps + 2 * math.pi * torch.rand((), generator=rng).double()
    flat = (1 - up.square()).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), up], dim=1)


def _slab(origins: Tensor, directions: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """(R,) distances at which lines enter and leave a box; near > far for lines that miss it."""
    lower, upper = corners.reshape(2, -1)
    tiny = torch.finfo(directions.dtype).tiny  # avoids 0 / 0 for lines parallel to a face
    safe = torch.where(directions == 0, tiny, directions)
    first, second = (lower - origins) / safe, (upper - origins) / safe
    near = torch.minimum(first, second).amax(dim=1)
    return near, torch.maximum(first, second).amin(dim=1)


def _ball(
    origins: Tensor, directions: Tensor, center: tuple[float, ...], radius: float
) -> tuple[Tensor, Tensor]:
    """As `_slab`, for a ball (3 coordinates) or an infinite vertical cylinder (2 coordinates)."""
    columns = len(center)
    offset = origins[:, :columns] - origins.new_tensor(center)
    heading = directions[:, :columns]
    a = heading.square().sum(dim=1).clamp(min=1e-30)
    half_b = (offset * heading).sum(dim=1)
    c = offset.square().sum(dim=1) - radius**2
    root = (half_b.square() - a * c).sqrt()  # NaN for lines that miss
    misses = root.isnan()
    near, far = (-half_b - root) / a, (-half_b + root) / a
    return near.masked_fill(misses, torch.inf), far.masked_fill(misses, -torch.inf)


def _shell_ranges(origins: Tensor, directions: Tensor) -> Tensor:
    """(R,) distance to walls, floor and ceiling from inside; infinite for rays through an opening."""
    corners = origins.new_tensor((0.0, 0.0, 0.0, *ROOM))
    ranges = _slab(origins, directions, corners)[1]
    ends = origins + ranges[:, None] * directions
    for axis, far, u, z in OPENINGS:
        on_wall = (ends[:, axis] - (ROOM[axis] if far else 0.0)).abs() < 1e-9
        along, up = ends[:, 1 - axis], ends[:, 2]
        inside = (along > u[0]) & (along < u[1]) & (up > z[0]) & (up < z[1])
        ranges = ranges.masked_fill(on_wall & inside, torch.inf)
    return ranges


def _shell_mesh() -> trimesh.Trimesh:
    """Floor, ceiling and walls without the openings, with normals pointing inward."""
    import trimesh

    quads = []
    for axis in range(3):
        u_axis, v_axis = (i for i in range(3) if i != axis)
        for far in (False, True):
            holes = [o for o in OPENINGS if (o.axis, o.far) == (axis, far)]
            u_cuts = sorted({0.0, ROOM[u_axis], *(c for hole in holes for c in hole.u)})
            v_cuts = sorted({0.0, ROOM[v_axis], *(c for hole in holes for c in hole.z)})
            for u in itertools.pairwise(u_cuts):
                for v in itertools.pairwise(v_cuts):
                    if any(hole.u == u and hole.z == v for hole in holes):
                        continue
                    quad = np.full((4, 3), ROOM[axis] if far else 0.0)
                    quad[:, u_axis] = [u[0], u[1], u[1], u[0]]
                    quad[:, v_axis] = [v[0], v[0], v[1], v[1]]
                    # u x v points to +axis for x and z, -axis for y; inward is +axis at 0, -axis at ROOM
                    quads.append(quad[::-1] if far != (axis == 1) else quad)
    faces = np.concatenate([4 * i + np.array([[0, 1, 2], [0, 2, 3]]) for i in range(len(quads))])
    return trimesh.Trimesh(np.concatenate(quads), faces, process=False)


# --- materials: class and color of every surface ---

CLASS_NAMES = (
    "floor", "ceiling", "wall", "table", "chair", "sofa", "shelf", "cabinet", "column", "lamp",
)  # fmt: skip
COLORS = (
    (0.62, 0.46, 0.30), (0.93, 0.93, 0.90), (0.80, 0.77, 0.66), (0.45, 0.26, 0.13),
    (0.85, 0.33, 0.15), (0.18, 0.32, 0.60), (0.35, 0.52, 0.28), (0.55, 0.18, 0.20),
    (0.60, 0.60, 0.64), (0.95, 0.80, 0.25),
)  # fmt: skip
TILE, DARK = 1.0, 0.75  # [m] edge of the tiles of the floor, and brightness of every other one

# Classes of the shapes, in the order of `simulation.BOXES`, `CYLINDERS` and `SPHERES`.
_BOXES = [*["table"] * 5, *["chair"] * 24, *["sofa"] * 4, *["shelf"] * 7, "wall", *["cabinet"] * 3]
_CYLINDERS = ("column", "table", "table", "lamp", "lamp")
_SPHERES = ("lamp", "lamp")
SHAPE_CLASSES = tuple(map(CLASS_NAMES.index, (*_BOXES, *_CYLINDERS, *_SPHERES)))


def surface_classes(shapes: Tensor, hits: Tensor, height: float) -> Tensor:
    """(R,) class of the surface that each ray hits.

    Args:
        shapes: (R,) number of the shape; -1 for floor, ceiling and walls.
        hits: (R, 3) points on the surfaces [m].
        height: of the room [m].
    """
    names = torch.tensor(SHAPE_CLASSES, device=shapes.device)
    up = hits[:, 2]
    shell = torch.where(up < 1e-6, 0, torch.where(up > height - 1e-6, 1, 2))
    return torch.where(shapes < 0, shell, names[shapes.clamp(min=0)])


def surface_colors(classes: Tensor, hits: Tensor) -> Tensor:
    """(R,) classes and (R, 3) points [m] -> (R, 3) colors; the floor has tiles."""
    colors = torch.tensor(COLORS, device=classes.device)[classes]
    is_dark = ((hits[:, :2] / TILE).floor().sum(dim=1) % 2 == 1) & (classes == 0)
    return torch.where(is_dark[:, None], DARK * colors, colors)


def measured_materials(
    classes: Tensor,
    colors: Tensor,
    scan_id: Tensor,
    is_return: Tensor,
    *,
    exposure_noise: float,
    wrong_labels: float,
    rng: torch.Generator,
) -> dict[str, Tensor]:
    """Channels of the rays as a sensor measures them; missing for beams without return.

    Args:
        classes: (R,) class of each surface.
        colors: (R, 3) color of each surface.
        scan_id: (R,) scan of each ray.
        is_return: (R,) False where nothing was hit.
        exposure_noise: standard deviation of the logarithm of a scan's exposure, and, of half of
            that, of the brightness of each ray.
        wrong_labels: fraction of the rays with a random other class.
        rng: random generator.
    """
    scans = int(scan_id.max()) + 1 if len(scan_id) else 0
    exposure = exposure_noise * torch.randn(scans, generator=rng)
    brightness = exposure_noise / 2 * torch.randn(len(classes), generator=rng)
    factor = (exposure[scan_id] + brightness).exp()
    color = (colors * factor[:, None]).clamp(0, 1)
    is_wrong = torch.rand(len(classes), generator=rng) < wrong_labels
    shift = torch.randint(1, len(CLASS_NAMES), (len(classes),), generator=rng)
    classes = torch.where(is_wrong, (classes + shift) % len(CLASS_NAMES), classes)
    return {
        COLOR: torch.where(is_return[:, None], color, torch.nan),
        CLASS: torch.where(is_return, classes, -1),
    }
