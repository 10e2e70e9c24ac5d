"""Maps as integers, for files that are sent: rounding, and the state dict of what was rounded.

Everything is rounded relative to the size of its cluster, so the same precision serves all scenes:
weights and binary logarithms of the diagonals of the factors in absolute terms, the other factors
relative to a power of two just below the diagonal of their row, and centers relative to one just
below the smallest diagonal.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import torch

from lardhm_torch.io import map_files, packed_files
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.packed_blocks import decode_block, encode_block
from lardhm_torch.io.packed_files import Packed
from lardhm_torch.learning.packed_channels import (
    check_finite,
    rounded_channels,
    with_packed_channels,
)
from lardhm_torch.learning.parameters import MapParameters, read_state

PRECISION = 6  # fractional bits: changes scores by less than 0.0005 and probabilities by about 0.01
LARGEST = 1 << 30  # of an integer
MOST_OCTAVES = 30  # length scales from 2^-30 to 2^30 m: all numbers are finite in float32


def check_precision(precision: int) -> None:
    """Raise a ValueError if a precision is out of range."""
    if precision not in packed_files.PRECISIONS:
        raise ValueError(f"precision must be a whole number from 1 to 16; got {precision!r}")


def rounded(model: MapParameters, precision: int = PRECISION) -> Packed:
    """The integers of a map.

    Args:
        model: a map.
        precision: fractional bits.

    Raises:
        ValueError: the precision is out of range, a parameter of the map is not finite, or too
            large for the precision.
    """
    check_precision(precision)
    state, kernel, origin = read_state(model), model.kernel, model.origin
    weights, centers, raw = (
        tensor.double().cpu().numpy()
        for tensor in (state.weights, state.centers, state.raw_scale_tril)
    )
    dim, scale = centers.shape[1], 1 << precision
    diagonals = raw.diagonal(axis1=1, axis2=2).clip(math.log(kernel.min_lengthscale))
    sizes = np.rint(diagonals / math.log(2) * scale)
    if not all(np.isfinite(values).all() for values in (weights, centers, raw)):
        raise ValueError("the parameters of the map must be finite to be packed; some are not")
    octaves = np.floor(sizes / scale).astype(np.int64)
    _check_octaves(octaves)
    rows, columns = np.tril_indices(dim, -1)
    table = np.column_stack(
        [
            state.kinds.cpu().numpy(),
            weights * scale,
            sizes,
            np.ldexp(raw[:, rows, columns], precision - octaves[:, rows]),
            np.ldexp(centers, precision - _smallest(octaves)),
        ]
    )
    if np.abs(table).max(initial=0) > LARGEST:
        raise ValueError(f"precision must be smaller for this map; {precision} needs over 30 bits")
    settings = (kernel.num_neighbors, kernel.covariance_scale, kernel.min_lengthscale)
    return Packed(np.rint(table).astype(np.int32), origin.cpu().numpy(), precision, *settings)


def _check_octaves(octaves: np.ndarray) -> None:
    largest = np.abs(octaves).max(initial=0)
    if largest > MOST_OCTAVES:
        raise ValueError(
            f"length scales must be between 2^-{MOST_OCTAVES} and 2^{MOST_OCTAVES} m; got 2^{largest}"
        )


def _smallest(octaves: np.ndarray) -> np.ndarray:
    return octaves.min(axis=1, keepdims=True)


def state_dict_of(packed: Packed) -> dict[str, Any]:
    """State dict of the map of these integers; `LardHilbertMap.load` completes it.

    Moments are those of the kernels: counts are 1, except 0 for clusters of unknown points, means are
    the centers, and the covariances those of the kernels without `Packed.min_lengthscale`.

    Raises:
        ValueError: the integers are not those of a map.
    """
    dim, precision = len(packed.origin), packed.precision
    kinds, weights, sizes, below, places = np.split(
        packed.table, np.cumsum([1, 1, dim, dim * (dim - 1) // 2]), axis=1
    )
    octaves = sizes >> precision
    _check_octaves(octaves)
    rows, columns = np.tril_indices(dim, -1)
    raw = np.zeros((len(packed.table), dim, dim))
    raw[:, np.arange(dim), np.arange(dim)] = np.ldexp(sizes * math.log(2), -precision)
    raw[:, rows, columns] = np.ldexp(below.astype(float), octaves[:, rows] - precision)
    centers = np.ldexp(places.astype(float), _smallest(octaves) - precision)
    if not np.isin(kinds, (0, 1, 2)).all():
        raise ValueError(f"kinds of clusters must be 0, 1 or 2; got {np.unique(kinds).tolist()}")
    kind = torch.from_numpy(kinds[:, 0])
    floats = {
        "weights": np.ldexp(weights[:, 0].astype(float), -precision),
        "centers": centers,
        "raw_scale_tril": raw,
        "means": centers,
        "scatters": _covariances(raw) - packed.min_lengthscale**2 * np.eye(dim),
        "posterior_means": np.zeros(len(kinds)),
        "posterior_variances": np.zeros(len(kinds)),
        "posterior_scales": np.ones(2),
    }
    settings = {
        "num_neighbors": packed.num_neighbors,
        "covariance_scale": packed.covariance_scale,
        "min_lengthscale": packed.min_lengthscale,
    }
    return {
        **{name: torch.from_numpy(value).float() for name, value in floats.items()},
        "is_occupied": kind == 0,
        "counts": (kind < 2).long(),
        "origin": torch.from_numpy(packed.origin.copy()),
        "_extra_state": {
            "format_version": map_files.FORMAT_VERSION,
            "dim": dim,
            "is_packed": True,
            **settings,
        },
    }


def _covariances(raw: np.ndarray) -> np.ndarray:
    factors = np.tril(raw, -1) + np.exp(raw.diagonal(axis1=1, axis2=2))[:, :, None] * np.eye(
        raw.shape[1]
    )
    return factors @ factors.transpose(0, 2, 1)


def save_packed(model: MapParameters, path: str | os.PathLike[str], precision: int) -> None:
    """Write a map as one packet that holds it whole, see `LardHilbertMap.pack`."""
    with replaced_file(path) as partial:
        partial.write_bytes(packed_bytes(model, precision))


def packed_bytes(model: MapParameters, precision: int = PRECISION) -> bytes:
    """The content of the file that `save_packed` writes."""
    packed = rounded(model, precision)
    content = packed_files.encode(packed)
    if model.channel_layout:
        check_finite(model)
        channels = rounded_channels(model, state_dict_of(packed), 1 << precision)
        content = encode_block(*channels) + content
    return content


def load_state(path: str | os.PathLike[str]) -> dict[str, Any]:
    """State dict of any map file, packed or not.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a map file, or damaged.
    """
    if packed_files.is_packed(path):
        return _load_packed(path)
    return map_files.load_state(path)


def _load_packed(path: str | os.PathLike[str]) -> dict[str, Any]:
    """State dict of a packed map with its channels."""
    packed = packed_files.load_packed(path)[1]
    state = state_dict_of(packed)
    if os.path.isdir(path):
        return state
    try:
        with open(path, "rb") as file:
            block = decode_block(file.read())
        if block is not None:
            state = with_packed_channels(state, *block, 1 << packed.precision)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{os.fspath(path)} must be a complete packed map; {error}") from error
    return state
