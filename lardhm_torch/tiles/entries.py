"""The manifest's entry for one fitted tile, and the validation of its fields."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.queries.raycasting import thickness_counts
from lardhm_torch.tiles.indexing import Folder

MOST_BINS = 1 << 12  # of thickness, below and above 1 m: up to 2^256 m
NEGLIGIBLE = 1e-10  # log-odds of a cluster; gradients [1/m] of 1 cm kernels then stay below 1e-6


@dataclass(frozen=True, kw_only=True)
class Tile:
    """What is known of a fitted tile without opening its map file.

    Args:
        checksum: SHA-256 of the map file, hexadecimal.
        num_points: number of training points inside the tile.
        num_clusters: number of clusters in the map file, at least 1.
        bounds: lower and upper corner (D,) of the cluster centers, world frame [m].
        support_radius: largest `support_radius` of the tile's clusters [m].
        thickness: the `raycasting.thickness_counts` of the map as consecutive bins: number of the
            first bin, then the counts. Empty if no cluster has a positive weight.

    Raises:
        ValueError: a field is out of range; the message names it.
    """

    checksum: str
    num_points: int
    num_clusters: int
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    support_radius: float
    thickness: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        text = self.checksum
        if not isinstance(text, str) or len(text) != 64 or set(text) - set("0123456789abcdef"):
            raise ValueError(f"checksum must be 64 hexadecimal digits; got {text!r}")
        check_whole("num_points", self.num_points, 0)
        check_whole("num_clusters", self.num_clusters, 1)
        check_number("support_radius", self.support_radius, 0.0)
        _check_thickness(self.thickness)
        if not isinstance(self.bounds, tuple) or len(self.bounds) != 2:
            raise ValueError(f"bounds must be a lower and an upper corner; got {self.bounds!r}")
        lower, upper = self.bounds
        for name, corner in (("lower", lower), ("upper", upper)):
            check_position(f"bounds ({name})", corner, len(lower))
        if any(low > high for low, high in zip(lower, upper, strict=True)):
            raise ValueError(f"bounds must be lower <= upper; got {self.bounds!r}")

    def thickness_counts(self) -> dict[int, int]:
        """The `raycasting.thickness_counts` of the tile's map."""
        first, *counts = self.thickness or (0,)
        return {first + number: count for number, count in enumerate(counts) if count}


def tile_record(model: LardHilbertMap, path: Folder, num_points: int) -> Tile:
    """The entry of a tile whose map was saved to ``path``.

    Raises:
        ValueError: the map is empty.
    """
    if len(model) == 0:
        raise ValueError("a tile must hold clusters; the map is empty: leave the tile out")
    centers = model.centers.detach().double() + model.origin
    corners = (centers.amin(dim=0).tolist(), centers.amax(dim=0).tolist())
    return Tile(
        checksum=file_checksum(path),
        num_points=int(num_points),
        num_clusters=len(model),
        bounds=(tuple(corners[0]), tuple(corners[1])),
        support_radius=support_radius(model.weights, model.scale_tril),
        thickness=_consecutive_bins(thickness_counts(model)),
    )


def support_radius(weights: Tensor, scale_tril: Tensor) -> float:
    """Distance from its center beyond which |weight| * kernel of every cluster is negligible [m].

    A kernel decays slowest along its longest axis, as exp(-(d / s)^2 / 2) with the largest singular
    value s of its factor. It falls below `NEGLIGIBLE` at d = s sqrt(2 log(|w| / NEGLIGIBLE)).
    Weights below 1 count as 1, so that kernel values, and with them variances, are negligible too.

    Args:
        weights: (M,), M at least 1.
        scale_tril: (M, D, D) lower Cholesky factors of the kernels [m].
    """
    factors = scale_tril.detach().double()
    size = weights.detach().double().abs().clamp(min=1)
    lengths = (2 * (size / NEGLIGIBLE).log()).sqrt()
    # |(L^T L)^2|^(1/4) in the Frobenius norm is between s and D^(1/8) s. Singular values are only
    # computed for the few clusters that can have the largest radius.
    gram = factors.mT @ factors
    upper_bounds = lengths * torch.linalg.vector_norm(gram @ gram, dim=(1, 2)) ** 0.25
    rows = upper_bounds * factors.shape[1] ** 0.125 >= upper_bounds.max()
    longest = torch.linalg.matrix_norm(factors[rows], ord=2)
    return float((lengths[rows] * longest).max())


def _consecutive_bins(counts: Mapping[int, int]) -> tuple[int, ...]:
    """The field ``thickness``: number of the first bin, then the counts of all bins from it on."""
    if not counts:
        return ()
    bins = range(min(counts), max(counts) + 1)
    return bins[0], *(counts.get(number, 0) for number in bins)


def file_checksum(path: Folder) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def tile_to_json(tile: Tile) -> dict[str, Any]:
    """The fields of a tile as plain values."""
    bounds = [list(corner) for corner in tile.bounds]
    return {**vars(tile), "bounds": bounds, "thickness": " ".join(map(str, tile.thickness))}


def tile_from_json(entry: Any) -> Tile:
    """The inverse of `tile_to_json`.

    Raises:
        ValueError: the entry is anything else; the message names the field.
    """
    if not isinstance(entry, dict) or set(entry) != set(Tile.__dataclass_fields__):
        raise ValueError(f"a tile must have {list(Tile.__dataclass_fields__)}; got {entry!r}")
    bounds, text = entry["bounds"], entry["thickness"]
    if not isinstance(bounds, list):
        raise ValueError(f"bounds must be a lower and an upper corner; got {bounds!r}")
    numbers = text.split() if isinstance(text, str) else [""]
    if not all(number.removeprefix("-").isdecimal() for number in numbers):
        raise ValueError(f"thickness must be whole numbers; got {text!r}")
    corners = tuple(position_from_json(corner) for corner in bounds)
    return Tile(**{**entry, "bounds": corners, "thickness": tuple(map(int, numbers))})


def position_from_json(values: Any) -> tuple[float, ...]:
    """A list of coordinates as a tuple."""
    if not isinstance(values, list):
        raise ValueError(f"a position must be a list of numbers; got {values!r}")
    return tuple(values)


def check_whole(name: str, value: Any, least: int | None) -> None:
    """A ValueError if a field is not a whole number of at least ``least``."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{name} must be a whole number; got {value!r}")
    if least is not None and value < least:
        raise ValueError(f"{name} must be {least} or more; got {value}")


def check_number(name: str, value: Any, least: float) -> None:
    """A ValueError if a field is not a finite number of at least ``least``."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < least:
        raise ValueError(f"{name} must be a finite number, {least:g} or more; got {value!r}")


def check_position(name: str, values: Any, dim: int) -> None:
    """A ValueError if a field is not a tuple of ``dim`` coordinates."""
    if not isinstance(values, tuple) or len(values) != dim:
        raise ValueError(f"{name} must be {dim} coordinates; got {values!r}")
    for value in values:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or abs(value) > 1e15:
            raise ValueError(f"{name} must be coordinates in meters; got {value!r}")


def _check_thickness(values: Any) -> None:
    if not isinstance(values, tuple) or len(values) == 1:
        raise ValueError(f"thickness must be a bin and counts; got {values!r}")
    for position, value in enumerate(values):
        check_whole("thickness", value, 0 if position else -MOST_BINS)
    if len(values) > MOST_BINS or (values and values[0] > MOST_BINS):
        raise ValueError(f"thickness must be bins -{MOST_BINS} to {MOST_BINS}; got {values!r}")
