"""Interactive viewer in the browser: surface, slice, clusters and scans of a map.

Drawing is done by viser. No display is needed, and `MapViewer.export` writes the scene to a file.
Coordinates on the page are relative to the middle of the map, in float32.
"""

from __future__ import annotations

import atexit
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lardhm_torch.channels import CLASS, COLOR
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.maps import OccupancyMap, channel_names, snapshot
from lardhm_torch.scans import Scans
from lardhm_torch.surfaces.lattice import Lattice
from lardhm_torch.surfaces.meshing import lattice_mesh, surface_lattice
from lardhm_torch.surfaces.vertex_colors import COLORS, has_variance
from lardhm_torch.viewing.legends import legend_html
from lardhm_torch.viewing.scene import Stage, core_box, view_resolution

BELOW = -0.2  # [m] height of the probabilities of a flat map, which would cut its hits and sensors
CLOSING = 1.0  # [s] at most that `close` waits for what is being drawn
DRAFT = 2.5  # cells of the first surface after a change over those of the final one
SETTLED = 0.4  # [s] without a change before the final surface is begun; the page draws the first
EXPORT_SUFFIXES = (".html", ".viser")
THRESHOLD_HINT = (
    "The surface stays on the hits. A higher threshold removes parts of which the map is less certain "
    "and closes the surface behind objects."
)


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Settings of the viewer.

    Attributes:
        host: address to serve on; "0.0.0.0" accepts connections from other machines.
        port: TCP port; if it is in use, the next free one is used.
        resolution: edge of the cells of the surface [m]; None: chosen by `scene.view_resolution`.
        max_points: limit for the scan points; above it, one point per voxel is shown.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    resolution: float | None = None
    max_points: int = 100_000

    def __post_init__(self) -> None:
        if self.resolution is not None and not self.resolution > 0:
            raise ValueError(f"resolution must be > 0 m; got {self.resolution}")
        if self.max_points < 1:
            raise ValueError(f"max_points must be 1 or more; got {self.max_points}")


class MapViewer:
    """Serve a page that shows a map. Surfaces are extracted in a background thread.

    Args:
        model: a map of 2 or 3 dimensions with clusters; call `update` to show later changes.
        scans: scans to show as points and sensor positions.
        config: address and resolution.

    Raises:
        ImportError: viser is not installed.
        ValueError: the map has another dimension or is empty.
    """

    def __init__(
        self, model: OccupancyMap, scans: Scans | None = None, config: ViewConfig | None = None
    ) -> None:
        self.config = config or ViewConfig()
        self._model = _checked_snapshot(model)
        self.server = _new_server(self.config)
        self._core = core_box(self._model)
        self.offset = ((self._core[0] + self._core[1]) / 2).round().numpy()
        self._stage = Stage(self.server, self.offset)
        self._lattices: list[Lattice | None] = []
        self._report = ""
        self._jobs: set[str] = {"map"}
        self._changed = threading.Condition()
        self._closed = False
        self._add_controls()
        if scans is not None:
            self._add_scans(scans)
        self._stage.aim(self._core)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.config.host}:{self.server.get_port()}"

    def update(self, model: OccupancyMap) -> None:
        """Show the current map, for example after each step of a mapping loop.

        Returns immediately. Updates that arrive faster than they can be drawn are skipped.

        Raises:
            ValueError: the map has another dimension than the first one, or is empty.
        """
        current = _checked_snapshot(model, (self._model.dim,))
        with self._changed:
            self._model = current
        self._request("map")

    def wait(self) -> None:
        """Block until all requested changes are on the page."""
        with self._changed:
            self._changed.wait_for(lambda: not self._jobs or self._closed)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the scene to a self-contained .html file for any browser, or to a .viser file.

        Raises:
            ValueError: the path has another extension.
        """
        path = Path(path)
        if path.suffix.lower() not in EXPORT_SUFFIXES:
            known = " or ".join(EXPORT_SUFFIXES)
            raise ValueError(f"path must end in {known} for a scene; got {path.name!r}")
        self.wait()
        scene = self.server.get_scene_serializer()
        html = path.suffix.lower() == ".html"
        content = scene.as_html().encode() if html else scene.serialize()
        with replaced_file(path) as partial:
            partial.write_bytes(content)

    def close(self) -> None:
        """Stop the thread and the server, even while a surface is extracted."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._worker.join(CLOSING)
        if self._worker.is_alive():  # the interpreter must not end while it runs native code
            atexit.register(self._worker.join)
        self.server.stop()

    # --- controls ---

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._status = gui.add_markdown("starting ...")
        if self._model.dim == 2:
            self._show_slice = gui.add_checkbox("show probability", True)
            self._show_slice.on_update(lambda _: self._request("slice"))
            return
        self._add_surface_controls(gui)
        self._add_slice_controls(gui)
        with gui.add_folder("Clusters"):
            occupied = gui.add_checkbox("show occupied", False)
            free = gui.add_checkbox("show free", False)
        self._stage.follow("/clusters/occupied", occupied)
        self._stage.follow("/clusters/free", free)

    def _add_surface_controls(self, gui: Any) -> None:
        with gui.add_folder("Surface"):
            show = gui.add_checkbox("show surface", True)
            self._threshold = gui.add_slider("threshold", 0.5, 0.99, 0.01, 0.5, hint=THRESHOLD_HINT)
            available = has_variance(self._model)
            colors = [color for color in COLORS if available or color != "variance"]
            colors += [name for name in channel_names(self._model) if name not in colors]
            initial = COLOR if COLOR in colors else "height"
            self._color = gui.add_dropdown("color", colors, initial_value=initial)
            self._legend = gui.add_html("")
        self._stage.follow("/surface", show)
        self._threshold.on_update(lambda _: self._request("surface"))
        self._color.on_update(lambda _: self._request("surface"))

    def _add_slice_controls(self, gui: Any) -> None:
        lower, upper = (end.numpy() - self.offset for end in self._core)
        with gui.add_folder("Slice"):
            self._show_slice = gui.add_checkbox("show slice", False)
            self._height = gui.add_slider(
                "height [m]",
                float(np.floor(lower[2] * 20) / 20),
                float(np.ceil(upper[2] * 20) / 20),
                0.05,
                float(np.round((lower[2] + upper[2]) * 10) / 20),
            )
        for control in (self._show_slice, self._height):
            control.on_update(lambda _: self._request("slice"))

    def _add_scans(self, scans: Scans) -> None:
        gui = self.server.gui
        shown = self._stage.draw_scans(scans, self.config.max_points)
        with gui.add_folder("Scans"):
            gui.add_markdown(f"{shown:,} of {int(scans.is_return.sum()):,} points")
            points = gui.add_checkbox("show points", True)
            sensors = gui.add_checkbox("show sensors", True)
            size = gui.add_slider("point size [m]", 0.005, 0.1, 0.005, 0.02)
        self._stage.follow("/scans", points)
        self._stage.follow("/sensors", sensors)
        size.on_update(lambda _: self._stage.resize_points(size.value))

    def _request(self, job: str) -> None:
        with self._changed:
            self._jobs.add(job)
            self._changed.notify_all()

    def _work(self) -> None:
        """Background thread: draws the latest map, once for all requests so far."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                jobs, self._jobs = self._jobs, {"busy"}
                model = self._model
            try:
                self._status.content = "*drawing ...*"
                self._draw(model, jobs)
            except _OutdatedError:
                pass
            except Exception as error:
                self._status.content = f"**{type(error).__name__}**: {error}"
            with self._changed:
                self._jobs.discard("busy")
                self._changed.notify_all()

    def _draw(self, model: OccupancyMap, jobs: set[str]) -> None:
        """Redraw what the jobs name: "slice", "surface", or "map" for everything."""
        if model.dim == 2:
            self._stage.draw_slice(model, BELOW if self._show_slice.value else None, self._core)
            self._status.content = f"{len(model.weights):,} clusters. {self._middle()}"
            return
        if "map" in jobs or not self._lattices:
            fine = self.config.resolution or view_resolution(model)
            self._lattices = [surface_lattice(model, r, keep=True) for r in (DRAFT * fine, fine)]
            self._stage.draw_clusters(model)
        if jobs & {"map", "slice"}:
            height = float(self._height.value) if self._show_slice.value else None
            self._stage.draw_slice(model, height, self._core)
        if jobs & {"map", "surface"}:
            draft, final = self._lattices
            self._report = self._draw_surface(model, draft, is_final=False)
            with self._changed:
                self._changed.wait_for(self._is_outdated, timeout=SETTLED)
            self._report = self._draw_surface(model, final, is_final=True)
        self._status.content = self._report

    def _draw_surface(self, model: OccupancyMap, lattice: Lattice | None, is_final: bool) -> str:
        """Show the surface; returns the status line. A final one gives way to a change of a control."""

        def check(_: int = 0) -> None:
            if self._closed or (is_final and self._is_outdated()):
                raise _OutdatedError

        color = self._color.value
        self._legend.content = legend_html(model) if color == CLASS else ""
        mesh = lattice_mesh(
            model,
            lattice,
            float(self._threshold.value),
            color=color,
            report=check,
        )
        check()
        shown = self._stage.draw_surface(mesh)
        return (
            f"{len(model.weights):,} clusters; surface of {len(mesh.faces):,} faces, "
            f"{shown:,} shown, cells of {lattice.resolution if lattice else 0:.3g} m. "
            f"{self._middle()}"
        )

    def _is_outdated(self) -> bool:
        """Whether a change makes the surface that is being drawn needless."""
        return self._closed or "surface" in self._jobs

    def _middle(self) -> str:
        return f"Middle of the map: ({', '.join(f'{v:g}' for v in self.offset)}) m"


class _OutdatedError(Exception):
    """What is being drawn is not wanted any more."""


class LiveView:
    """A viewer that opens with the first non-empty map, for maps under construction.

    Args:
        config: settings of the viewer.
    """

    def __init__(self, config: ViewConfig | None = None) -> None:
        self.config = config
        self.viewer: MapViewer | None = None

    def update(self, model: OccupancyMap) -> None:
        """Show the current map; an empty map is ignored."""
        if len(model.centers) == 0:
            return
        if self.viewer is None:
            self.viewer = MapViewer(model, config=self.config)
        else:
            self.viewer.update(model)

    def close(self) -> None:
        """Stop the viewer, if it was opened."""
        if self.viewer is not None:
            self.viewer.close()


def _new_server(config: ViewConfig) -> Any:
    try:
        import viser
    except ImportError as error:
        raise ImportError(
            "the viewer needs viser, which is not installed; "
            'install the extra: pip install "lardhm_torch[view]"'
        ) from error
    return viser.ViserServer(config.host, config.port, label="lardhm", verbose=False)


def _checked_snapshot(model: OccupancyMap, dimensions: tuple[int, ...] = (2, 3)) -> OccupancyMap:
    """A copy of the map that later changes to the map do not affect, or a ValueError."""
    if model.dim not in dimensions:
        allowed = " or ".join(f"{dim}-D" for dim in dimensions)
        raise ValueError(f"model must be a {allowed} map to be viewed; got {model.dim}-D")
    copied = snapshot(model)
    if len(copied.centers) == 0:
        raise ValueError("the map must hold clusters to be viewed; it is empty: fit it first")
    return copied
