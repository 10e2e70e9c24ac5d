"""A stream of scans and the growing map as a recording for Rerun."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.map_logs import MapLog, recorded
from lardhm_torch.io.nav2_files import GroundGrid

if TYPE_CHECKING:
    import trimesh

APPLICATION = "lardhm_torch"
TIMELINE = "scan"  # number of the scan, from 1
CLOUD, SURFACE, GRID, ORIGIN = "map/cloud", "map/surface", "map/grid", "map/origin"


class RerunLog(MapLog):
    """A recording in the making, see `rerun_log`."""

    def __init__(self, path: Path, **settings: Any) -> None:
        super().__init__(**settings)
        self._rerun = _import_rerun()
        self._recording = self._rerun.RecordingStream(APPLICATION)
        self._recording.save(path)
        self._origin: NDArray[np.float64] | None = None

    def _write_cloud(
        self, hits: NDArray[np.float64], origin: NDArray[np.float64], number: int
    ) -> None:
        self._write(CLOUD, self._rerun.Points3D(hits - origin), origin, number)

    def _write_surface(
        self, mesh: trimesh.Trimesh, origin: NDArray[np.float64], number: int
    ) -> None:
        visual: Any = mesh.visual
        surface = self._rerun.Mesh3D(
            vertex_positions=np.asarray(mesh.vertices).reshape(-1, 3) - origin,
            triangle_indices=np.asarray(mesh.faces),
            vertex_normals=np.asarray(mesh.vertex_normals),
            vertex_colors=np.asarray(visual.vertex_colors).reshape(-1, 4),
        )
        self._write(SURFACE, surface, origin, number)

    def _write_grid(
        self, found: GroundGrid, height: float, origin: NDArray[np.float64], number: int
    ) -> None:
        shades = found.shades()
        low = np.array([*found.corner, height]) - origin
        along_x, along_y = np.diag([*np.array(found.log_odds.shape) * found.resolution, 0.0])[:2]
        rectangle = self._rerun.Mesh3D(
            vertex_positions=[low, low + along_x, low + along_x + along_y, low + along_y],
            triangle_indices=[[0, 1, 2], [0, 2, 3]],
            vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
            albedo_texture=shades,
        )
        self._write(GRID, rectangle, origin, number)

    def _write_end(self) -> None:
        self._recording.disconnect()

    def _write(self, entity: str, content: Any, origin: NDArray[np.float64], number: int) -> None:
        if self._origin is None or (self._origin != origin).any():
            text = f"x y z of the origin of the map: {' '.join(map(repr, origin.tolist()))}"
            self._recording.set_time(TIMELINE, sequence=number)
            self._recording.log(ORIGIN, self._rerun.TextDocument(text))
            self._origin = origin
        self._recording.set_time(TIMELINE, sequence=number)
        self._recording.log(entity, content)


def rerun_log(
    path: str | os.PathLike[str],
    *,
    every: int = 10,
    resolution: float = 0.1,
    heights: tuple[float, float] | None = None,
) -> AbstractContextManager[RerunLog]:
    """Write a recording that Rerun plays: clouds, growing surface and grid by number of the scan.

        with rerun_log("out.rrd", heights=(0.2, 1.5)) as log:
            stream_scans(model, log.watch(scans), after_scan=log.send)

    Coordinates are relative to the origin of the map, which `map/origin` holds as text: Rerun keeps
    float32. Otherwise as `foxglove_files.foxglove_log`.

    Raises:
        ImportError: the library rerun-sdk is not installed.
        ValueError: every or resolution is not > 0.
        FileNotFoundError: the folder of path does not exist.
    """
    settings: dict[str, Any] = {"every": every, "resolution": resolution, "heights": heights}
    return recorded(path, lambda partial: RerunLog(partial, **settings))


def _import_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ImportError(
            "recordings for Rerun need rerun-sdk, which is not installed; "
            'install the extra: pip install "lardhm_torch[rerun]"'
        ) from error
    return rerun
