"""A stream of scans and the growing map as an MCAP file for Foxglove."""

from __future__ import annotations

import json
import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.foxglove_messages import (
    SCHEMAS,
    ground_grid_message,
    point_cloud,
    scene_update,
)
from lardhm_torch.io.map_logs import MapLog, recorded
from lardhm_torch.io.nav2_files import GroundGrid

if TYPE_CHECKING:
    import trimesh
    from mcap.writer import Writer

TOPICS = {
    "/surface": "foxglove.SceneUpdate",
    "/cloud": "foxglove.PointCloud",
    "/grid": "foxglove.Grid",
}
SCAN_NANOSECONDS = 10**8  # scans have no times: they are 0.1 s apart, the first at 0.1 s


class FoxgloveLog(MapLog):
    """An MCAP file in the making, see `foxglove_log`."""

    def __init__(self, path: Path, **settings: Any) -> None:
        super().__init__(**settings)
        kind = _writer_class()
        self._file = open(path, "wb")  # noqa: SIM115
        self._writer = kind(self._file)
        self._writer.start(profile="", library="lardhm_torch")
        self._channels = {topic: self._add_channel(topic) for topic in TOPICS}

    def _write_cloud(
        self, hits: NDArray[np.float64], origin: NDArray[np.float64], number: int
    ) -> None:
        time = number * SCAN_NANOSECONDS
        self._write("/cloud", point_cloud(hits, origin, time), time)

    def _write_surface(
        self, mesh: trimesh.Trimesh, origin: NDArray[np.float64], number: int
    ) -> None:
        time = number * SCAN_NANOSECONDS
        self._write("/surface", scene_update(mesh, origin, time), time)

    def _write_grid(
        self, found: GroundGrid, height: float, origin: NDArray[np.float64], number: int
    ) -> None:
        time = number * SCAN_NANOSECONDS
        self._write("/grid", ground_grid_message(found, height, time), time)

    def _write_end(self) -> None:
        with self._file:
            self._writer.finish()

    def _add_channel(self, topic: str) -> int:
        name = TOPICS[topic]
        schema = self._writer.register_schema(
            name, "jsonschema", json.dumps(SCHEMAS[name]).encode()
        )
        return self._writer.register_channel(topic, "json", schema)

    def _write(self, topic: str, message: dict[str, Any], time: int) -> None:
        content = json.dumps(message, separators=(",", ":")).encode()
        self._writer.add_message(self._channels[topic], time, content, time)


def foxglove_log(
    path: str | os.PathLike[str],
    *,
    every: int = 10,
    resolution: float = 0.1,
    heights: tuple[float, float] | None = None,
) -> AbstractContextManager[FoxgloveLog]:
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
    settings: dict[str, Any] = {"every": every, "resolution": resolution, "heights": heights}
    return recorded(path, lambda partial: FoxgloveLog(partial, **settings))


def _writer_class() -> type[Writer]:
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise ImportError(
            "MCAP files for Foxglove need mcap, which is not installed; "
            'install the extra: pip install "lardhm_torch[foxglove]"'
        ) from error
    return Writer
