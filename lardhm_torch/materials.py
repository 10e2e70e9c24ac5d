"""Materials of the simulated room: class and color of every surface."""

from __future__ import annotations

import torch
from torch import Tensor

from lardhm_torch.channels import CLASS, COLOR

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
