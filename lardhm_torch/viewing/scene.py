"""What a viewer shows of a map, as arrays: slice, ellipsoids, points and colors.

Positions are relative to an ``offset`` near the middle of the map, so that float32 is enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.queries.grids import query_slice
from lardhm_torch.scans import Scans

if TYPE_CHECKING:
    import trimesh

OCCUPIED, FREE = (200, 70, 60), (70, 110, 190)  # colors of the clusters
SLICE_PIXELS = 512  # along the longer edge
MESH_FACES = 200_000  # about; the resolution is chosen for it
MOST_FACES = 600_000  # about; where surfaces are so thin that they need finer cells
SHEET_CELLS = 1.5  # thicknesses: through larger cells thin sheets slip
SHOWN_FACES = 60_000  # of a surface on the page
KEY_LIGHT = np.array([0.35, -0.45, 0.82])  # direction to the light that is painted on


def core_box(model: Any, share: float = 0.02, margin: float = 0.5) -> tuple[Tensor, Tensor]:
    """(3,) and (3,) world corners around all but the outermost clusters [m]: what is worth a look."""
    chosen = model.weights > 0
    centers = model.centers[chosen if bool(chosen.any()) else ...].detach().double().cpu()
    ends = torch.quantile(centers, torch.tensor([share, 1 - share], dtype=torch.float64), dim=0)
    return ends[0] + model.origin.cpu() - margin, ends[1] + model.origin.cpu() + margin


def view_resolution(model: Any) -> float:
    """Edge of a cell [m] at which the surface has about `MESH_FACES` faces.

    The clusters lie on the surface like tiles of two standard deviations to each side. Where they
    are thin (a quarter of them is thinner), cells are smaller, for up to about `MOST_FACES`: a floor
    slips between the nodes of a lattice much coarser than it is thick, and has holes.
    """
    factors = model.scale_tril.detach()[model.weights > 0].double()
    if len(factors) == 0:
        return 0.1
    axes = torch.linalg.svdvals(factors)  # of the kernels, the longest first
    area = 8 / model.covariance_scale * float((axes[:, 0] * axes[:, 1]).sum())
    wide, fine = ((4 * area / faces) ** 0.5 for faces in (MESH_FACES, MOST_FACES))
    thin = float(axes[:, -1].quantile(0.25))
    return max(0.02, fine, min(wide, SHEET_CELLS * thin))


def slice_picture(
    model: Any, height: float, core: tuple[Tensor, Tensor], offset: np.ndarray
) -> dict[str, Any]:
    """Probability at a height above the offset [m], as the arguments of viser's `add_image`."""
    from matplotlib import colormaps

    pixel = float((core[1] - core[0])[:2].max()) / SLICE_PIXELS
    probability, extent = query_slice(model, height + float(offset[2]), pixel, core)
    p = probability.float().cpu().numpy().T[::-1]  # rows from the top, that is from large y
    image = colormaps["RdBu_r"](p, bytes=True)
    image[..., 3] = np.clip(np.abs(p - 0.5) * 1000, 40, 235)  # the unknown is nearly clear
    middle = [(extent[0] + extent[1]) / 2, (extent[2] + extent[3]) / 2]
    return {
        "image": image,
        "render_width": extent[1] - extent[0],
        "render_height": extent[3] - extent[2],
        "format": "png",
        "wxyz": (0.0, 1.0, 0.0, 0.0),  # image rows go down: turned about x, they go along -y
        "position": (middle[0] - offset[0], middle[1] - offset[1], height),
    }


def ellipsoids(model: Any, chosen: Tensor, offset: np.ndarray) -> dict[str, Any]:
    """Clusters at one standard deviation, as the arguments of viser's batched meshes."""
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
        "batched_scales": (stds / model.covariance_scale**0.5).numpy().astype(np.float32),
    }


def fewer_faces(mesh: trimesh.Trimesh, most: int = SHOWN_FACES) -> trimesh.Trimesh:
    """The mesh with at most about so many faces, flat parts first; colors of the nearest vertices.

    Source: Garland & Heckbert 1997, quadric error metrics (by fast-simplification).
    """
    import trimesh
    from scipy.spatial import cKDTree

    if len(mesh.faces) <= most:
        return mesh
    import fast_simplification

    vertices, faces = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), mesh.faces, target_count=most
    )
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    visual: Any = mesh.visual
    colors = visual.vertex_colors[nearest]
    return trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)


def painted_glb(mesh: trimesh.Trimesh) -> bytes:
    """The mesh as GLB whose colors hold the light already, so that a page need not compute it.

    Half of the light comes from everywhere, more from above; the rest from one side.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    normals = mesh.vertex_normals
    light = 0.5 + 0.12 * normals[:, 2:] + 0.42 * np.clip(normals @ KEY_LIGHT, 0, None)[:, None]
    visual: Any = mesh.visual
    colors = np.asarray(visual.vertex_colors).copy()
    linear = (colors[:, :3] / 255 * light.clip(0, 1)) ** 2.2  # glTF's vertex colors are linear
    colors[:, :3] = (255 * linear).round()

    def unlit(tree: dict[str, Any]) -> None:
        tree["materials"] = [{"extensions": {"KHR_materials_unlit": {}}}]
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        for part in tree["meshes"]:
            for primitive in part["primitives"]:
                primitive["material"] = 0

    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    return export_glb(trimesh.Scene(painted), include_normals=False, tree_postprocessor=unlit)


def scan_points(scans: Scans, most: int, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) hits, of too many one for each cube of a lattice, and (N, 3) grays that tell height."""
    from matplotlib import colormaps

    hits = scans.hits
    hits = hits[hits.isfinite().all(dim=1)].cpu()
    points = thinned((hits.numpy() - offset).astype(np.float32), most)
    low, high = np.quantile(points[:, 2], [0.01, 0.99]) if len(points) else (0, 1)
    shades = 0.25 + 0.6 * (points[:, 2] - low) / max(high - low, 1e-9)
    return points, colormaps["gray"](shades, bytes=True)[:, :3]


def thinned(points: np.ndarray, most: int) -> np.ndarray:
    """At most so many of (N, 3) points: the first in each cube of a lattice that is coarse enough."""
    kept, edge = np.arange(len(points)), 0.01
    while len(kept) > most:
        cells = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
        sides = cells.max(axis=0) + 1
        kept = np.unique(np.ravel_multi_index(cells.T, sides), return_index=True)[1]
        edge *= max(1.02, (len(kept) / most) ** 0.4)  # points on surfaces go with the edge squared
    return points[np.sort(kept)]


def knows_variance(model: Any) -> bool:
    """Whether the map can tell how unsure it is: has ``variance``, and what that needs."""
    if not hasattr(model, "variance"):
        return False
    try:
        model.variance(model.centers[:1].detach().double() + model.origin)
    except RuntimeError:
        return False
    return True


def variance_colors(model: Any, vertices: np.ndarray) -> np.ndarray:
    """(V, 4) RGBA: dark where the map is certain, bright where it is not."""
    from matplotlib import colormaps

    points = torch.as_tensor(vertices, device=model.centers.device)
    with torch.no_grad():
        variance = model.variance(points).double().cpu().numpy()
    logs = np.log10(np.maximum(variance, 1e-12))
    low, high = np.quantile(logs, [0.02, 0.98])
    return colormaps["magma"]((logs - low) / max(high - low, 1e-9), bytes=True)


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices -> (N, 4) quaternions w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]].astype(np.float32)


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
