"""The interface of an occupancy map, as queries, surfaces and viewers use it.

Any object with the members of `OccupancyMap` is a map: `LardHilbertMap`, `TiledMap`, or a user-defined
class. Some maps have optional members, for speed or because they do not fit in memory. The functions
below use these members if they are present; no other module checks for them.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.native.surfaces import NativeMap

P = ParamSpec("P")
R = TypeVar("R")
TensorLike: TypeAlias = Tensor | np.ndarray | Sequence[object]  # types accepted by `to_tensor`


class OccupancyMap(Protocol):
    """A map of M Gaussian kernels in D dimensions.

    World coordinates are ``origin`` plus map coordinates.
    """

    @property
    def dim(self) -> int:
        """Number of coordinates D."""

    @property
    def origin(self) -> Tensor:
        """(D,) float64 origin of the map frame, world frame [m]."""

    @property
    def centers(self) -> Tensor:
        """(M, D) centers of the kernels, map frame [m]."""

    @property
    def scale_tril(self) -> Tensor:
        """(M, D, D) lower Cholesky factors of the kernels' covariances [m]."""

    @property
    def weights(self) -> Tensor:
        """(M,) weights: positive for occupied, negative for free clusters."""

    def __call__(self, points: Tensor, /) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy."""

    def log_odds(self, points: Tensor, /) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy."""


def to_tensor(values: TensorLike, name: str, device: torch.device | str | None = None) -> Tensor:
    """Convert a tensor, an array or nested lists to a float64 tensor. Gradients are preserved.

    Args:
        values: numbers.
        name: name of the argument, for error messages.
        device: device of the result; None: the device of a tensor, otherwise the CPU.

    Raises:
        ValueError: values are not numbers, or nested lists differ in length.
    """
    if isinstance(values, Tensor):
        return values.to(device or values.device, torch.float64)
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "biuf":
        raise ValueError(
            f"{name} must be a tensor, an array or equally long lists of numbers; got {values!r}"
        )
    return torch.from_numpy(array.astype(np.float64)).to(device)


# --- optional members ---


def reading(model: OccupancyMap) -> AbstractContextManager[None]:
    """A context in which no other thread changes the map, if the map has ``reading``."""
    return model.reading() if hasattr(model, "reading") else nullcontext()


def reads_map(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator for a function whose first argument is a map: no thread changes the map meanwhile."""

    @functools.wraps(function)
    def read(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        model: Any = args[0] if args else kwargs["model"]
        with reading(model):
            return function(*args, **kwargs)

    return read


def reads_copy(function: Callable[P, R]) -> Callable[P, R]:
    """As `reads_map`, for slow functions: they get a copy, and the map can change meanwhile.

    A map without ``reading``, such as a tiled map, is not copied.
    """

    @functools.wraps(function)
    def read(*args: P.args, **kwargs: P.kwargs) -> R:
        model: Any = args[0] if args else kwargs.pop("model")
        if hasattr(model, "reading"):
            with reading(model):
                model = copy.deepcopy(model)
        return function(model, *args[1:], **kwargs)  # type: ignore[arg-type]

    return read


def pieces(model: OccupancyMap) -> Iterable[OccupancyMap]:
    """Maps that together contain every cluster once: the tiles of a tiled map, or the map itself."""
    return model.pieces() if hasattr(model, "pieces") else (model,)


def local_parts(
    model: OccupancyMap, lower: Tensor, upper: Tensor
) -> Iterator[tuple[Tensor, OccupancyMap]]:
    """Split N boxes into groups, each with a map that is exact inside the boxes of the group.

    A tiled map groups nearby boxes and loads only the tiles that they need. Any other map yields a
    single group with all boxes.

    Args:
        model: the map.
        lower: (N, D) lower corners, world frame [m].
        upper: (N, D) upper corners [m].

    Yields:
        indices of the boxes in a group, and the map for them.
    """
    if hasattr(model, "local_parts"):
        yield from model.local_parts(lower, upper)
    else:
        yield torch.arange(len(lower), device=lower.device), model


def in_memory(model: OccupancyMap) -> OccupancyMap:
    """The map of all tiles of a tiled map, which must fit in memory; any other map itself."""
    return model.in_memory() if hasattr(model, "in_memory") else model


def num_neighbors(model: OccupancyMap) -> int:
    """Number k of nearest clusters used per point; the number of clusters if the map has no k."""
    return model.num_neighbors if hasattr(model, "num_neighbors") else len(model.weights)


def covariance_scale(model: OccupancyMap) -> float:
    """Kernel covariance divided by the covariance of a cluster's points; 1 if the map has none."""
    return getattr(model, "covariance_scale", 1.0)


def native_lattice(model: OccupancyMap, axes: list[Tensor], probability: bool) -> Tensor | None:
    """Probability or log-odds on a lattice by the map's ``query_lattice``; None if it has none."""
    if not hasattr(model, "query_lattice"):
        return None
    return model.query_lattice(axes, probability=probability)


def stored_moments(model: OccupancyMap) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """(M,) class and counts, (M, D) means and (M, D, D) scatters of the clusters; None if not stored."""
    if not hasattr(model, "scatters"):
        return None
    names = ("is_occupied", "counts", "means", "scatters")
    is_occupied, counts, means, scatters = (getattr(model, name) for name in names)
    return is_occupied, counts, means, scatters


def kept_hits(model: OccupancyMap) -> Tensor | None:
    """(M, K, D) kept points of the clusters, map frame, padded with infinity; None if not stored."""
    evidence = getattr(model, "evidence", None)
    return None if evidence is None or evidence.shape[1] == 0 else evidence.detach()


def native_map(model: OccupancyMap) -> NativeMap | None:
    """The tensors of the map for `native.surfaces` by its ``native_map``; None if not available."""
    return model.native_map() if hasattr(model, "native_map") else None


def native_ranges(
    model: OccupancyMap,
    origins: Tensor,
    directions: Tensor,
    march: tuple[float, float, float, float, bool],
) -> Tensor | None:
    """(R,) ranges of rays by the map's ``query_rays``; None if it is not available."""
    if getattr(model, "query_rays", None) is None:
        return None
    return model.query_rays(origins, directions, march)  # type: ignore[attr-defined]


def stored_thickness_counts(model: OccupancyMap) -> Mapping[int, int] | None:
    """Histogram of kernel thicknesses in the manifest of a tiled map; None for other maps."""
    return model.thickness_counts() if hasattr(model, "thickness_counts") else None


def channel_names(model: OccupancyMap) -> tuple[str, ...]:
    """Names of the channels of a map, such as "color" and "class"; none if it has no channels."""
    return tuple(getattr(model, "channel_layout", ()))


def log_odds_variance(model: OccupancyMap, points: Tensor) -> Tensor:
    """(..., D) world positions [m] -> (...) variance of the log-odds.

    Raises:
        ValueError: the map has no ``variance``.
        RuntimeError: its posterior has not been computed (`LardHilbertMap.fit_uncertainty`).
    """
    if not hasattr(model, "variance"):
        raise ValueError(f"model must have a variance; {type(model).__name__} has none")
    return model.variance(points)


def snapshot(model: OccupancyMap) -> OccupancyMap:
    """An independent in-memory copy without gradients; a tiled map is merged into one map."""
    with reading(model):
        whole = model.merge() if hasattr(model, "merge") else copy.deepcopy(model)
    return whole.requires_grad_(False) if hasattr(whole, "requires_grad_") else whole
