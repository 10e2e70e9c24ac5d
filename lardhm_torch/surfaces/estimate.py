"""Estimates of the area, faces and memory of a mesh, from the clusters."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.maps import OccupancyMap, covariance_scale, pieces
from lardhm_torch.queries.memory import check_memory

FACES_PER_CELL = 2.2  # faces for each square of a cell's edge: 2.0 to 2.6 on five maps
BYTES_PER_FACE = 450  # at the peak
CLOSED = 2.0  # area of a watertight mesh over that of an open one: 1.3 to 3.3 on four maps
LARGEST = 0.05  # fraction of the clusters left out: the largest ones are stray points in free space


class MeshEstimate(NamedTuple):
    """Rough size of a mesh: area [m^2], faces, and memory [bytes]; within a factor of 2 as a rule."""

    area: float
    faces: int
    memory: int

    def __str__(self) -> str:
        count = f"{self.faces / 1e6:.2g} million" if self.faces >= 1e6 else f"{self.faces:,}"
        return f"about {count} faces, {self.memory / 1e9:.1g} GB"


@torch.no_grad()
def estimate_mesh(
    model: OccupancyMap,
    resolution: float,
    bounds: tuple[Tensor, Tensor] | None = None,
    sign: int = 1,
    *,
    watertight: bool = False,
) -> MeshEstimate:
    """Estimate the size of a mesh.

    The points of each supporting cluster cover two standard deviations to either side along its two
    longer axes.

    Args:
        model: a 3-D map.
        resolution: edge of a cell [m].
        bounds: lower and upper corner (3,) of the part to mesh, world frame [m]; None: all of it.
        sign: of the weights of the supporting clusters.
        watertight: whether the mesh also closes gaps.
    """
    areas = [torch.zeros(0, dtype=torch.float64)]
    for piece in pieces(model, bounds):
        chosen = piece.weights * sign > 0
        if bounds is not None:
            centers = piece.centers + piece.origin
            low, high = (end.to(centers) for end in bounds)
            chosen &= ((centers >= low) & (centers <= high)).all(dim=1)
        stds = torch.linalg.svdvals(piece.scale_tril[chosen].double())
        areas.append((9 / covariance_scale(piece) * stds[:, 0] * stds[:, 1]).cpu())
    largest_last = torch.cat(areas).sort().values
    area = float(largest_last[: len(largest_last) - int(LARGEST * len(largest_last))].sum())
    area *= CLOSED if watertight else 1.0
    faces = FACES_PER_CELL * area / resolution**2
    return MeshEstimate(area, round(faces), round(BYTES_PER_FACE * faces))


def check_mesh_memory(resolution: float, estimate: MeshEstimate) -> None:
    """Raise a ValueError if a mesh of this size would not fit in memory."""
    what = f"the mesh would have about {estimate.faces / 1e6:.3g} million faces"
    check_memory(what, resolution, estimate.memory, power=2)
