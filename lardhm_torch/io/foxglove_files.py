"""A stream of scans and the growing map as an MCAP file for Foxglove."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.io.foxglove_messages import (
    SCHEMAS,
    ground_grid_message,
    point_cloud,
    scene_update,
)
from lardhm_torch.io.nav2_files import ground_grid
from lardhm_torch.maps import OccupancyMap
from lardhm_torch.scans import Scans
from lardhm_torch.surfaces.meshing import extract_mesh

if TYPE_CHECKING:
    from mcap.writer import Writer

TOPICS = {
    "/surface": "foxglove.SceneUpdate",
    "/cloud": "foxglove.PointCloud",
    "/grid": "foxglove.Grid",
}
SCAN_NANOSECONDS = 10**8  # scans have no times: they are 0.1 s apart, the first at 0.1 s


class FoxgloveLog:
    """Writes scans and the map that they give to an open MCAP file, see `foxglove_log`."""

    def __init__(
        self,
        file: BinaryIO,
        *,
        every: int = 10,
        resolution: float = 0.1,
        heights: tuple[float, float] | None = None,
    ) -> None:
        self._writer = _new_writer(file)
        self._every, self._resolution, self._heights = every, resolution, heights
        self._channels = {topic: self._add_channel(topic) for topic in TOPICS}
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
            raise ValueError(f"an MCAP file needs a map of 2 or 3 dimensions; got {model.dim}")
        self._model = model
        hits = _in_3d(self._scan.hits.cpu().numpy())
        self._write("/cloud", point_cloud(hits, _origin(model), self._time))
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
        self._writer.finish()

    @property
    def _time(self) -> int:
        return self._number * SCAN_NANOSECONDS

    def _draw(self, model: OccupancyMap) -> None:
        self._drawn = self._number
        if len(model.centers) == 0:
            return
        if model.dim == 3:
            mesh = extract_mesh(model, self._resolution)
            self._write("/surface", scene_update(mesh, _origin(model), self._time))
        if model.dim == 2 or self._heights is not None:
            found = ground_grid(model, self._resolution, heights=self._heights)
            height = 0.0 if self._heights is None else self._heights[0]
            self._write("/grid", ground_grid_message(found, height, self._time))

    def _add_channel(self, topic: str) -> int:
        name = TOPICS[topic]
        schema = self._writer.register_schema(
            name, "jsonschema", json.dumps(SCHEMAS[name]).encode()
        )
        return self._writer.register_channel(topic, "json", schema)

    def _write(self, topic: str, message: dict[str, Any]) -> None:
        content = json.dumps(message, separators=(",", ":")).encode()
        self._writer.add_message(self._channels[topic], self._time, content, self._time)


@contextmanager
def foxglove_log(
    path: str | os.PathLike[str],
    *,
    every: int = 10,
    resolution: float = 0.1,
    heights: tuple[float, float] | None = None,
) -> Iterator[FoxgloveLog]:
    """Write an MCAP file that Foxglove plays: clouds, growing surface and grid, 0.1 s per scan.

        with foxglove_log("out.mcap", heights=(0.2, 1.5)) as log:
            stream_scans(model, log.watch(scans), after_scan=log.send)

    Coordinates are relative to the origin of the map, in the frame "map". After an error or Ctrl-C
    the file holds what was written so far.

    Args:
        path: the file; an old one is replaced at the end.
        every: write the surface and the grid every so many scans, and after the last.
        resolution: edge of a cell of the surface and the grid [m].
        heights: lowest and highest z of obstacles [m]; None: no grid of a 3-D map.

    Raises:
        ImportError: the library mcap is not installed.
        ValueError: every or resolution is not > 0.
        FileNotFoundError: the folder of path does not exist.
    """
    for name, value in (("every", every), ("resolution", resolution)):
        if not value > 0:
            raise ValueError(f"{name} must be > 0; got {value}")
    failure: BaseException | None = None
    with replaced_file(path) as partial, open(partial, "wb") as file:
        log = FoxgloveLog(file, every=every, resolution=resolution, heights=heights)
        try:
            yield log
        except BaseException as error:
            if not log.has_scans:
                raise
            failure = error
        log.finish(is_complete=failure is None)
    if failure is not None:
        raise failure


def _new_writer(file: BinaryIO) -> Writer:
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise ImportError(
            "MCAP files for Foxglove need mcap, which is not installed; "
            'install the extra: pip install "lardhm_torch[foxglove]"'
        ) from error
    writer = Writer(file)
    writer.start(profile="", library="lardhm_torch")
    return writer


def _in_3d(points: np.ndarray) -> np.ndarray:
    """(n, 2) or (n, 3) points as (n, 3), with z = 0."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _origin(model: OccupancyMap) -> np.ndarray:
    return _in_3d(model.origin.detach().double().cpu().numpy()[None])[0]
