"""The 3-D part of the viewer's page: draws a map's parts into a scene of viser.

Everything is drawn so that a page without a graphics card stays usable: surfaces have no more faces
than such a page can turn and their light is painted on, nothing casts shadows, and points that lie
close together are thinned out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from lardhm_torch.scans import Scans
from lardhm_torch.scene import (
    KEY_LIGHT,
    ellipsoids,
    fewer_faces,
    painted_glb,
    scan_points,
    slice_picture,
)

if TYPE_CHECKING:
    import trimesh

OCCUPIED, FREE = (200, 70, 60), (70, 110, 190)  # colors of the clusters


class Stage:
    """What is seen of a map on the page of a server; positions are relative to ``offset`` (3,) [m]."""

    def __init__(self, server: Any, offset: np.ndarray) -> None:
        self.server, self.offset = server, offset
        self._controls: dict[str, Any] = {}
        self._light()

    def _light(self) -> None:
        """One lamp where the painted light comes from: viser's own lights bleach the clusters."""
        scene = self.server.scene
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/lights/everywhere", intensity=0.8)
        scene.add_light_directional(
            "/lights/key", intensity=0.8, position=tuple(KEY_LIGHT), cast_shadow=False
        )

    def follow(self, name: str, control: Any) -> None:
        """Show what has this name, now or later, while the checkbox is set."""
        self._controls[name] = control

        def apply(_: Any) -> None:
            handle = self.server.scene.get_handle_by_name(name)
            if handle is not None:
                handle.visible = control.value

        control.on_update(apply)
        apply(None)

    def _visible(self, name: str) -> bool:
        return name not in self._controls or bool(self._controls[name].value)

    def draw_surface(self, mesh: trimesh.Trimesh) -> int:
        """The surface, with as few faces as a page needs; returns how many."""
        scene = self.server.scene
        if len(mesh.faces) == 0:
            scene.remove_by_name("/surface")
            return 0
        moved = mesh.copy()
        moved.apply_translation(-self.offset)
        shown = fewer_faces(moved)
        scene.add_glb(
            "/surface",
            painted_glb(shown),
            visible=self._visible("/surface"),
            cast_shadow=False,
            receive_shadow=False,
        )
        return len(shown.faces)

    def draw_slice(self, model: Any, height: float | None, core: tuple[Tensor, Tensor]) -> None:
        """The probability at a height above the offset [m], or none."""
        scene = self.server.scene
        if height is None:
            scene.remove_by_name("/slice")
            return
        picture = slice_picture(model, height, core, self.offset)
        scene.add_image("/slice", **picture, cast_shadow=False, receive_shadow=False)

    def draw_clusters(self, model: Any, most: int) -> None:
        """Ellipsoids of the clusters with the largest weights."""
        weights = model.weights.detach()
        order = weights.abs().argsort(descending=True)[:most]
        for name, color, mask in (
            ("/clusters/occupied", OCCUPIED, weights[order] > 0),
            ("/clusters/free", FREE, weights[order] < 0),
        ):
            chosen = order[mask]
            if len(chosen) == 0:
                self.server.scene.remove_by_name(name)
                continue
            self.server.scene.add_batched_meshes_simple(
                name,
                **ellipsoids(model, chosen, self.offset),
                batched_colors=color,
                opacity=0.9,
                cast_shadow=False,
                receive_shadow=False,
                visible=self._visible(name),
            )

    def draw_scans(self, scans: Scans, most: int) -> int:
        """At most so many points, and the sensors; returns how many points."""
        points, colors = scan_points(scans, most, self.offset)
        scene = self.server.scene
        scene.add_point_cloud("/scans", points, colors, point_size=0.02, precision="float32")
        origins = (scans.origins.cpu().numpy() - self.offset).astype(np.float32)
        scene.add_point_cloud(
            "/sensors", origins, (255, 150, 0), point_size=0.12, point_shape="circle"
        )
        return len(points)

    def resize_points(self, size: float) -> None:
        """Edge of the scans' points [m]."""
        self.server.scene.get_handle_by_name("/scans").point_size = size

    def aim(self, core: tuple[Tensor, Tensor]) -> None:
        """From obliquely above, far enough to see where most clusters are."""
        low, high = (end.numpy() - self.offset for end in core)
        reach = max(float(np.linalg.norm(high - low)), 1.0)
        camera = self.server.initial_camera
        camera.look_at = tuple((low + high) / 2)
        camera.position = tuple((low + high) / 2 + reach * np.array([0.25, -0.5, 0.5]))
        self.server.scene.set_up_direction("+z")
