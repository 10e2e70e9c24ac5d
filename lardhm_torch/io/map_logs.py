"""Recording a stream of scans and the growing map: what the logs for Foxglove and Rerun share."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.nav2_files import GroundGrid, ground_grid
from lardhm_torch.maps import OccupancyMap
from lardhm_torch.scans import Scans
from lardhm_torch.surfaces.meshing import extract_mesh

if TYPE_CHECKING:
    import trimesh


class MapLog(ABC):
    """Writes the hits of every scan, and now and then the surface and the grid of the map.

    Formats implement the four ``_write`` methods; positions are in the world frame [m], ``number``
    counts scans from 1.

    Args:
        every: write the surface and the grid every so many scans, and after the last.
        resolution: edge of a cell of the surface and the grid [m].
        heights: lowest and highest z of obstacles [m]; None: no grid of a 3-D map.

    Raises:
        ValueError: every or resolution is not > 0.
    """

    def __init__(
        self,
        *,
        every: int = 10,
        resolution: float = 0.1,
        heights: tuple[float, float] | None = None,
    ) -> None:
        for name, value in (("every", every), ("resolution", resolution)):
            if not value > 0:
                raise ValueError(f"{name} must be > 0; got {value}")
        self._every, self._resolution, self._heights = every, resolution, heights
        self._scan: Scans | None = None
        self._number, self._drawn = 0, 0
        self._model: OccupancyMap | None = None

    def watch(self, scans: Iterable[Scans]) -> Iterator[Scans]:
        """Yield the same scans, and remember the latest for `send`."""
        for self._scan in scans:
            self._number += 1
            yield self._scan

    def send(self, model: OccupancyMap) -> None:
        """Write the latest scan and, if they are due, the surface and grid of the map."""
        if self._scan is None:
            raise ValueError("scans must come through watch before send; none has come")
        if model.dim not in (2, 3):
            raise ValueError(f"a log needs a map of 2 or 3 dimensions; got {model.dim}")
        self._model = model
        hits = _in_3d(self._scan.hits.cpu().numpy())
        self._write_cloud(hits, _origin(model), self._number)
        if self._number % self._every == 0:
            self._draw(model)

    @property
    def has_scans(self) -> bool:
        """Whether anything was written."""
        return self._model is not None

    def finish(self, is_complete: bool) -> None:
        """End the file; a complete one ends with the surface and grid of the last map."""
        if is_complete and self._model is not None and self._drawn < self._number:
            self._draw(self._model)
        self._write_end()

    def _draw(self, model: OccupancyMap) -> None:
        self._drawn = self._number
        if len(model.centers) == 0:
            return
        origin = _origin(model)
        if model.dim == 3:
            self._write_surface(extract_mesh(model, self._resolution), origin, self._number)
        if model.dim == 2 or self._heights is not None:
            found = ground_grid(model, self._resolution, heights=self._heights)
            height = 0.0 if self._heights is None else self._heights[0]
            self._write_grid(found, height, origin, self._number)

    @abstractmethod
    def _write_cloud(
        self, hits: NDArray[np.float64], origin: NDArray[np.float64], number: int
    ) -> None:
        """(n, 3) hits of a scan; origin (3,) of the map."""

    @abstractmethod
    def _write_surface(
        self, mesh: trimesh.Trimesh, origin: NDArray[np.float64], number: int
    ) -> None:
        """The surface, with vertex colors."""

    @abstractmethod
    def _write_grid(
        self, found: GroundGrid, height: float, origin: NDArray[np.float64], number: int
    ) -> None:
        """The map from above, to be shown at a height [m]."""

    @abstractmethod
    def _write_end(self) -> None:
        """Finish the file."""


Log = TypeVar("Log", bound=MapLog)


@contextmanager
def recorded(path: str | os.PathLike[str], start: Callable[[Path], Log]) -> Iterator[Log]:
    """The log that `start` opens at a temporary file, which replaces path at the end.

    After an error or Ctrl-C the file holds what was written so far. If that is nothing, an old file
    stays.
    """
    failure: BaseException | None = None
    with replaced_file(path) as partial:
        log = start(partial)
        try:
            yield log
        except BaseException as error:
            failure = error
        log.finish(is_complete=failure is None)
        if failure is not None and not log.has_scans:
            raise failure
    if failure is not None:
        raise failure


def _in_3d(points: np.ndarray) -> np.ndarray:
    """(n, 2) or (n, 3) points as (n, 3), with z = 0."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _origin(model: OccupancyMap) -> np.ndarray:
    return _in_3d(model.origin.detach().double().cpu().numpy()[None])[0]
