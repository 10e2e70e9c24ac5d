"""The 3-D scene of the viewer: surface, slice, cluster ellipsoids and scan points.

Positions are relative to an ``offset`` near the middle of the map, so that float32 is enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.channels import COLOR
from lardhm_torch.maps import OccupancyMap, covariance_scale
from lardhm_torch.queries.grids import query_slice
from lardhm_torch.scans import Scans
from lardhm_torch.surfaces.estimate import estimate_mesh
from lardhm_torch.surfaces.simplification import simplify_mesh

if TYPE_CHECKING:
    import trimesh

OCCUPIED, FREE = (200, 70, 60), (70, 110, 190)  # colors of the clusters
SLICE_PIXELS = 512  # along the longer edge
MESH_FACES = 200_000  # approximate number of faces for which the resolution is chosen
MAX_MESH_FACES = 600_000  # approximate limit where thin surfaces need finer cells
SHEET_CELLS = 1.5  # largest cell in thicknesses of a surface; larger cells leave holes
SHOWN_FACES = 60_000  # limit for the surface on the page
MAX_CLUSTERS = 10_000  # limit for the ellipsoids on the page
KEY_LIGHT = np.array([0.35, -0.45, 0.82])  # direction to the light baked into the surface


def core_box(model: OccupancyMap) -> tuple[Tensor, Tensor]:
    """Lower and upper corner (3,) of the box to show, world frame [m]. A flat map is at height 0.

    From the 2 % to the 98 % quantile of the centers of the occupied clusters, plus 0.5 m.
    """
    occupied = model.weights > 0
    centers = model.centers[occupied if bool(occupied.any()) else ...].detach().double().cpu()
    ends = torch.quantile(centers, torch.tensor([0.02, 0.98], dtype=torch.float64), dim=0)
    lower, upper = ends[0] + model.origin.cpu() - 0.5, ends[1] + model.origin.cpu() + 0.5
    return (lower, upper) if model.dim == 3 else (in_space(lower), in_space(upper))


def in_space(positions: Tensor) -> Tensor:
    """(..., 2) or (..., 3) positions -> (..., 3), flat ones at height 0."""
    return torch.nn.functional.pad(positions, (0, 3 - positions.shape[-1]))


def view_resolution(model: OccupancyMap) -> float:
    """Edge of a cell [m] for a surface of about `MESH_FACES` faces.

    Thin clusters (first quartile) make cells smaller, down to about `MAX_MESH_FACES` faces, because a
    surface much thinner than a cell has holes.
    """
    factors = model.scale_tril.detach()[model.weights > 0].double()
    if len(factors) == 0:
        return 0.1
    faces = estimate_mesh(model, 1.0).faces
    wide, fine = ((faces / limit) ** 0.5 for limit in (MESH_FACES, MAX_MESH_FACES))
    thin = float(torch.linalg.svdvals(factors)[:, -1].quantile(0.25))
    return max(0.02, fine, min(wide, SHEET_CELLS * thin))


def slice_picture(
    model: OccupancyMap, height: float, core: tuple[Tensor, Tensor], offset: np.ndarray
) -> dict[str, Any]:
    """Slice of the probability at a height above the offset [m], as arguments of `add_image`.

    Of a flat map, all of it.
    """
    from matplotlib import colormaps

    pixel = float((core[1] - core[0])[:2].max()) / SLICE_PIXELS
    level = height + float(offset[2]) if model.dim == 3 else None
    probability, extent = query_slice(model, level, pixel, core)
    p = probability.float().cpu().numpy().T[::-1]  # first row at the largest y
    image = colormaps["RdBu_r"](p, bytes=True)
    image[..., 3] = np.clip(np.abs(p - 0.5) * 1000, 40, 235)  # unknown is nearly transparent
    middle = [(extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2]
    return {
        "image": image,
        "render_width": extent[1] - extent[0],
        "render_height": extent[3] - extent[2],
        "format": "png",
        "wxyz": (0.0, 1.0, 0.0, 0.0),  # half a turn about x: image rows run along -y
        "position": (middle[0] - offset[0], middle[1] - offset[1], height),
    }


def ellipsoids(model: OccupancyMap, chosen: Tensor, offset: np.ndarray) -> dict[str, Any]:
    """Ellipsoids of one standard deviation of the points of clusters, as viser's batched meshes."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    factors = model.scale_tril.detach()[chosen].double().cpu()
    axes, stds, _ = torch.linalg.svd(factors)
    axes[torch.linalg.det(axes) < 0, :, 2] *= -1
    centers = model.centers.detach()[chosen].double().cpu() + model.origin.cpu()
    return {
        "vertices": ball.vertices,
        "faces": ball.faces,
        "batched_wxyzs": quaternions(axes.numpy()),
        "batched_positions": (centers.numpy() - offset).astype(np.float32),
        "batched_scales": (stds / covariance_scale(model) ** 0.5).numpy().astype(np.float32),
    }


def painted_glb(mesh: trimesh.Trimesh) -> bytes:
    """Encode a mesh as GLB with the lighting baked into its colors, for an unlit material.

    Half of the light is ambient, stronger from above; the rest comes from `KEY_LIGHT`.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    normals = mesh.vertex_normals
    light = 0.5 + 0.12 * normals[:, 2:] + 0.42 * np.clip(normals @ KEY_LIGHT, 0, None)[:, None]
    visual: Any = mesh.visual
    colors = np.asarray(visual.vertex_colors).copy()
    linear = (colors[:, :3] / 255 * light.clip(0, 1)) ** 2.2  # glTF vertex colors are linear
    colors[:, :3] = (255 * linear).round()

    def unlit(tree: dict[str, Any]) -> None:
        tree["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        for part in tree["meshes"]:
            for primitive in part["primitives"]:
                primitive["material"] = 0

    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    return export_glb(trimesh.Scene(painted), include_normals=False, tree_postprocessor=unlit)


def scan_points(scans: Scans, limit: int, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) hits, at most about ``limit``, and (N, 3) uint8 colors: their own, or gray by height."""
    from matplotlib import colormaps

    rays = scans.select(scans.is_return & scans.ends.isfinite().all(dim=1))
    points = (in_space(rays.ends.cpu()).numpy() - offset).astype(np.float32)
    rows = thinned_rows(points, limit)
    points = points[rows]
    if COLOR in rays.channels:
        colors = rays.channels[COLOR].cpu()[torch.from_numpy(rows)].nan_to_num(nan=0.6)
        return points, (255 * colors).round().to(torch.uint8).numpy()
    low, high = np.quantile(points[:, 2], [0.01, 0.99]) if len(points) else (0, 1)
    shades = 0.25 + 0.6 * (points[:, 2] - low) / max(high - low, 1e-9)
    return points, colormaps["gray"](shades, bytes=True)[:, :3]


def thinned_rows(points: np.ndarray, limit: int) -> np.ndarray:
    """Ascending rows of at most ``limit`` points: the first in each voxel, as large as needed."""
    kept, edge = np.arange(len(points)), 0.01
    while len(kept) > limit:
        cells = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
        sides = cells.max(axis=0) + 1
        kept = np.unique(np.ravel_multi_index(cells.T, sides), return_index=True)[1]
        edge *= max(1.02, (len(kept) / limit) ** 0.4)  # on surfaces the count goes with edge^-2
    return np.sort(kept)


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices -> (N, 4) quaternions w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]].astype(np.float32)


class Stage:
    """Draws a map on the page of a viser server.

    Args:
        server: the viser server.
        offset: (3,) world position of the origin of the page [m].
    """

    def __init__(self, server: Any, offset: np.ndarray) -> None:
        self.server, self.offset = server, offset
        self._controls: dict[str, Any] = {}
        self._light()

    def _light(self) -> None:
        """Replace viser's lights, which overexpose the clusters, by one from `KEY_LIGHT`."""
        scene = self.server.scene
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/lights/everywhere", intensity=0.8)
        scene.add_light_directional(
            "/lights/key", intensity=0.8, position=tuple(KEY_LIGHT), cast_shadow=False
        )

    def follow(self, name: str, control: Any) -> None:
        """Bind the visibility of a scene node, existing or not, to a checkbox."""
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
        """Show the surface, simplified to `SHOWN_FACES`; returns the number of faces shown."""
        scene = self.server.scene
        if len(mesh.faces) == 0:
            scene.remove_by_name("/surface")
            return 0
        moved = mesh.copy()
        moved.apply_translation(-self.offset)
        shown = simplify_mesh(moved, SHOWN_FACES)
        scene.add_glb(
            "/surface",
            painted_glb(shown),
            visible=self._visible("/surface"),
            cast_shadow=False,
            receive_shadow=False,
        )
        return len(shown.faces)

    def draw_slice(
        self, model: OccupancyMap, height: float | None, core: tuple[Tensor, Tensor]
    ) -> None:
        """Show the slice at a height above the offset [m]; None removes it."""
        scene = self.server.scene
        if height is None:
            scene.remove_by_name("/slice")
            return
        picture = slice_picture(model, height, core, self.offset)
        scene.add_image("/slice", **picture, cast_shadow=False, receive_shadow=False)

    def draw_clusters(self, model: OccupancyMap) -> None:
        """Show ellipsoids of the `MAX_CLUSTERS` clusters with the largest absolute weights."""
        weights = model.weights.detach()
        order = weights.abs().argsort(descending=True)[:MAX_CLUSTERS]
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

    def draw_scans(self, scans: Scans, limit: int) -> int:
        """Show the sensors and at most ``limit`` points; returns the number of points shown."""
        points, colors = scan_points(scans, limit, self.offset)
        scene = self.server.scene
        scene.add_point_cloud("/scans", points, colors, point_size=0.02, precision="float32")
        origins = (in_space(scans.origins.cpu()).numpy() - self.offset).astype(np.float32)
        scene.add_point_cloud(
            "/sensors", origins, (255, 150, 0), point_size=0.12, point_shape="circle"
        )
        return len(points)

    def resize_points(self, size: float) -> None:
        """Set the size of the scan points [m]."""
        self.server.scene.get_handle_by_name("/scans").point_size = size

    def aim(self, core: tuple[Tensor, Tensor]) -> None:
        """Place the camera so far that it sees the whole box: obliquely above, or above a flat one."""
        low, high = (end.numpy() - self.offset for end in core)
        distance = max(float(np.linalg.norm(high - low)), 1.0)
        direction = np.array([0.25, -0.5, 0.5] if high[2] > low[2] else [0.0, -0.01, 0.8])
        camera = self.server.initial_camera
        camera.look_at = tuple((low + high) / 2)
        camera.position = tuple((low + high) / 2 + distance * direction)
        self.server.scene.set_up_direction("+z")
