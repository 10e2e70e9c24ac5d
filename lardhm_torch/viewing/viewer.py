"""A map in the browser: surface, slice, clusters and scans on a page that a server sends.

viser does the drawing; it works without a screen, and `MapViewer.export` writes the scene as one
file. Coordinates on the page are relative to the middle of the map, in float32.
"""

from __future__ import annotations

import copy
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.scans import Scans
from lardhm_torch.surfaces.meshing import COLORS, lattice_mesh, surface_lattice
from lardhm_torch.viewing.scene import (
    Stage,
    core_box,
    knows_variance,
    variance_colors,
    view_resolution,
)

EXPORT_SUFFIXES = (".html", ".viser")
THRESHOLD_HINT = (
    "The surface stays where the hits lie. A higher threshold leaves out what the map is less sure of, "
    "and shows the backs of what it is sure of."
)


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Where the page is served and how much is sent to it."""

    host: str = "127.0.0.1"  # 0.0.0.0: other machines may look, too
    port: int = 8080  # the next free one, if it is taken
    resolution: float | None = None  # [m] of the surface; None: by `scene.view_resolution`
    max_points: int = 100_000  # of the scans; of more, one for each small cube
    max_clusters: int = 10_000  # ellipsoids; those with the largest weights of more

    def __post_init__(self) -> None:
        if self.resolution is not None and not self.resolution > 0:
            raise ValueError(f"resolution must be > 0 m; got {self.resolution}")
        for name in ("max_points", "max_clusters"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be 1 or more; got {getattr(self, name)}")


class MapViewer:
    """A page that shows a map; meshing goes on in a thread, so that the page stays responsive.

    Args:
        model: a 3-D map with clusters.
        scans: shown as points and sensor positions, where given.
        config: where to serve, and how much.

    Raises:
        ImportError: viser is not installed.
        ValueError: the map is not 3-D or is empty.
    """

    def __init__(
        self, model: Any, scans: Scans | None = None, config: ViewConfig | None = None
    ) -> None:
        self.config = config or ViewConfig()
        _check_model(model)
        self.server = _new_server(self.config)
        self._core = core_box(model)
        self.offset = ((self._core[0] + self._core[1]) / 2).round().numpy()
        self._stage = Stage(self.server, self.offset)
        self._model = _snapshot(model)
        self._lattice: Any = None
        self._report = ""
        self._wanted: set[str] = set()
        self._changed = threading.Condition()
        self._closed = False
        self._add_controls()
        if scans is not None:
            self._add_scans(scans)
        self._stage.aim(self._core)
        self.update(model)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self.config.host}:{self.server.get_port()}"

    def update(self, model: Any) -> None:
        """Show this state of the map: a loop that grows it calls this after each step.

        Returns at once; states that come faster than they can be drawn are left out.
        """
        _check_model(model)
        snapshot = _snapshot(model)
        with self._changed:
            self._model = snapshot
        self._ask("map")

    def wait(self) -> None:
        """Until all that was asked for is on the page."""
        with self._changed:
            self._changed.wait_for(lambda: not self._wanted or self._closed)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the scene to one .html file that opens in any browser, or to a .viser file.

        Raises:
            ValueError: the path ends in neither.
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
        """Stop the thread and the server."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._worker.join()
        self.server.stop()

    # --- controls ---

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._status = gui.add_markdown("starting ...")
        with gui.add_folder("Surface"):
            self._show_mesh = gui.add_checkbox("show surface", True)
            self._threshold = gui.add_slider("threshold", 0.5, 0.99, 0.01, 0.5, hint=THRESHOLD_HINT)
            known = knows_variance(self._model)
            colors = [color for color in COLORS if known or color != "variance"]
            self._color = gui.add_dropdown("color", colors, initial_value="height")
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
        with gui.add_folder("Clusters"):
            self._show_occupied = gui.add_checkbox("show occupied", False)
            self._show_free = gui.add_checkbox("show free", False)
        self._threshold.on_update(lambda _: self._ask("surface"))
        self._color.on_update(lambda _: self._ask("surface"))
        for control in (self._show_slice, self._height):
            control.on_update(lambda _: self._ask("slice"))
        for name, control in (
            ("/surface", self._show_mesh),
            ("/clusters/occupied", self._show_occupied),
            ("/clusters/free", self._show_free),
        ):
            self._stage.follow(name, control)

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

    def _ask(self, job: str) -> None:
        with self._changed:
            self._wanted.add(job)
            self._changed.notify_all()

    def _work(self) -> None:
        """The thread: does what was asked for last, and forgets what was asked for before."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted or self._closed)
                if self._closed:
                    return
                jobs = self._wanted
                self._wanted = {"busy"}  # one drawing answers all that was asked for until now
                model = self._model
            try:
                self._status.content = "*drawing ...*"
                self._draw(model, jobs)
            except Exception as error:
                self._status.content = f"**{type(error).__name__}**: {error}"
            with self._changed:
                self._wanted.discard("busy")
                self._changed.notify_all()

    def _draw(self, model: Any, jobs: set[str]) -> None:
        """The slice, the surface, or all of a new map: what is among the jobs."""
        if "map" in jobs:
            resolution = self.config.resolution or view_resolution(model)
            self._lattice = surface_lattice(model, resolution, keep=True)
            self._stage.draw_clusters(model, self.config.max_clusters)
        if jobs & {"map", "slice"}:
            height = float(self._height.value) if self._show_slice.value else None
            self._stage.draw_slice(model, height, self._core)
        if jobs & {"map", "surface"}:
            self._report = self._draw_surface(model)
        self._status.content = self._report

    def _draw_surface(self, model: Any) -> str:
        """Draws it, and says what was drawn."""
        color, threshold = self._color.value, float(self._threshold.value)
        plain = None if color == "variance" else color
        mesh = lattice_mesh(model, self._lattice, threshold, color=plain)
        if color == "variance" and len(mesh.vertices):
            visual: Any = mesh.visual
            visual.vertex_colors = variance_colors(model, np.asarray(mesh.vertices))
        shown = self._stage.draw_surface(mesh)
        return (
            f"{len(model):,} clusters; surface of {len(mesh.faces):,} faces, "
            f"{shown:,} shown, cells of {self._lattice.resolution:.3g} m. "
            f"Middle of the map: ({', '.join(f'{v:g}' for v in self.offset)}) m"
        )


class LiveView:
    """The page of a map that does not exist yet: opened by the first update, redrawn by each.

    Args:
        config: where to serve, and how much.
    """

    def __init__(self, config: ViewConfig | None = None) -> None:
        self.config = config
        self.viewer: MapViewer | None = None

    def update(self, model: Any) -> None:
        """Show this state of the map; an empty one is not shown yet."""
        if len(model.centers) == 0:
            return
        if self.viewer is None:
            self.viewer = MapViewer(model, config=self.config)
        else:
            self.viewer.update(model)

    def close(self) -> None:
        """Stop serving, if there was anything to serve."""
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


def _check_model(model: Any) -> None:
    if model.dim != 3:
        raise ValueError(f"model must be a 3-D map to be viewed; got {model.dim}-D")
    if len(model.centers) == 0:
        raise ValueError("the map must hold clusters to be viewed; it is empty: fit it first")


def _snapshot(model: Any) -> Any:
    """A copy that training on does not change."""
    whole = model.merge() if hasattr(model, "merge") else copy.deepcopy(model)
    return whole.requires_grad_(False)
