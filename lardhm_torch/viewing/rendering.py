"""Offline rendering to PNG, without a display: shaded meshes and slices of the probability."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.maps import OccupancyMap, TensorLike
from lardhm_torch.queries.grids import query_slice

if TYPE_CHECKING:
    import trimesh

SUPERSAMPLING = 2  # samples per pixel along each axis
FIELD_OF_VIEW = math.radians(35)
CHUNK_PIXELS = 1 << 20  # pixels rasterized or shaded at a time
LIGHT = np.array([-0.35, 0.45, 0.82])  # right, up, toward the camera; unit length
AMBIENT = 0.35  # brightness of a face that points away from the light
SMOOTH = math.cos(math.radians(40))  # a larger angle of vertex and face normal is a sharp edge
PLAIN = (205, 205, 210)  # color of a mesh without colors
EMPTY = np.iinfo(np.uint64).max  # z-buffer where no triangle is


def render_mesh(
    mesh: trimesh.Trimesh,
    path: str | Path | None = None,
    *,
    azimuth: float = -60.0,
    elevation: float = 40.0,
    size: tuple[int, int] = (1200, 900),
    zoom: float = 1.0,
    cut_above: float | None = None,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    cull: bool = True,
    legend: Mapping[str, tuple[int, int, int]] | None = None,
) -> np.ndarray:
    """Render a mesh: perspective, smooth shading, ambient occlusion, white background.

    Args:
        mesh: with or without vertex colors.
        path: PNG file to write; None: none.
        azimuth: direction from the scene to the camera, counterclockwise seen from above, from +x
            (or from +y, if x is up) [degrees].
        elevation: of the camera above the horizon [degrees].
        size: width and height [pixels].
        zoom: values above 1 magnify the middle.
        cut_above: omit faces with a vertex higher than this along ``up``, such as a ceiling [m].
        up: direction that points up in the image; (0, -1, 0) in the frame of a camera.
        cull: cull back faces, so that walls do not hide the room behind them.
        legend: RGB colors, 0 to 255, by the text beside them; None: no legend.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ValueError: size or zoom is not > 0, up is zero, or the path does not end in .png.
    """
    if min(size) < 1 or not zoom > 0:
        raise ValueError(f"size and zoom must be > 0; got {size} and {zoom}")
    if not np.linalg.norm(up) > 0:
        raise ValueError(f"up must be a direction, not zero; got {up}")
    _check_png(path)
    width, height = (SUPERSAMPLING * n for n in size)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if cut_above is not None:
        heights = vertices @ (np.asarray(up) / np.linalg.norm(up))
        faces = faces[(heights[faces] <= cut_above).all(axis=1)]
    image = np.full((height, width, 3), 255.0, dtype=np.float32)
    if len(faces):
        axes = _camera_axes(azimuth, elevation, up)
        screen = _project(vertices, faces, axes, width, height, zoom)
        pixels, seen_faces = _rasterize(screen[faces], width, height, cull)
        color, depth = _shade(mesh, faces[seen_faces], screen, pixels, width, axes)
        depths = np.zeros(height * width, dtype=np.float32)
        depths[pixels] = depth
        brightness = _ambient_occlusion(depths.reshape(height, width)).reshape(-1)[pixels]
        image.reshape(-1, 3)[pixels] = color * brightness[:, None]
    small = image.reshape(size[1], SUPERSAMPLING, size[0], SUPERSAMPLING, 3).mean(axis=(1, 3))
    result = small.clip(0, 255).astype(np.uint8)
    if legend:
        result = _with_legend(result, legend)
    if path is not None:
        from matplotlib.image import imsave

        with replaced_file(path) as partial:
            imsave(partial, result)
    return result


def _with_legend(image: np.ndarray, legend: Mapping[str, tuple[int, int, int]]) -> np.ndarray:
    """The (height, width, 3) image with a legend in its upper right corner."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    height, width = image.shape[:2]
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image, aspect="auto", interpolation="nearest")
    axes.set_axis_off()
    patches = [
        Patch(color=(rgb[0] / 255, rgb[1] / 255, rgb[2] / 255), label=text)
        for text, rgb in legend.items()
    ]
    axes.legend(handles=patches, loc="upper right", framealpha=0.9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:height, :width, :3].copy()


def render_slice(
    model: OccupancyMap,
    path: str | Path,
    height: float | None = None,
    resolution: float = 0.02,
    bounds: tuple[TensorLike, TensorLike] | None = None,
) -> None:
    """Render the probability on a horizontal plane: free blue, unknown white, occupied red.

    Args:
        model: a map of two or three dimensions.
        path: PNG file to write.
        height: z of the plane [m]; None for a 2-D map.
        resolution: edge of a pixel [m].
        bounds: lower and upper (x, y) [m]; None: those of the map.

    Raises:
        ValueError: the path does not end in .png, or as for `query_slice`.
    """
    from matplotlib.figure import Figure

    _check_png(path)
    probability, extent = query_slice(model, height, resolution, bounds)
    half = resolution / 2
    edges = (extent[0] - half, extent[1] + half, extent[2] - half, extent[3] + half)
    aspect = (edges[3] - edges[2]) / (edges[1] - edges[0])
    figure = Figure(figsize=(9, min(max(8 * aspect, 3), 14)), layout="constrained")
    axes = figure.add_subplot()
    image = axes.imshow(
        probability.T.float().cpu().numpy(),
        origin="lower",
        extent=edges,
        cmap="RdBu_r",
        vmin=0,
        vmax=1,
        interpolation="nearest",
    )
    axes.set(xlabel="x [m]", ylabel="y [m]")
    if height is not None:
        axes.set_title(f"z = {height:.2f} m")
    figure.colorbar(image, ax=axes, label="probability of occupancy", shrink=0.8)
    with replaced_file(path) as partial:
        figure.savefig(partial, dpi=130)


def _check_png(path: str | Path | None) -> None:
    if path is not None and Path(path).suffix.lower() != ".png":
        raise ValueError(f"path must end in .png for an image; got {Path(path).name!r}")


def _camera_axes(azimuth: float, elevation: float, up: tuple[float, float, float]) -> np.ndarray:
    """(3, 3) unit vectors of the camera frame in rows: right, up, and toward the camera."""
    turn, rise = math.radians(azimuth), math.radians(elevation)
    top = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    start = np.eye(3)[1 if abs(top[0]) > 0.9 else 0]
    ahead = start - (start @ top) * top
    ahead /= np.linalg.norm(ahead)
    level = math.cos(turn) * ahead + math.sin(turn) * np.cross(top, ahead)
    back = math.cos(rise) * level + math.sin(rise) * top
    right = math.cos(turn) * np.cross(top, ahead) - math.sin(turn) * ahead
    return np.array([right, np.cross(back, right), back])


def _project(
    vertices: np.ndarray, faces: np.ndarray, axes: np.ndarray, width: int, height: int, zoom: float
) -> np.ndarray:
    """Perspective projection (V, 3): pixel x, pixel y (downward) and 1 / depth.

    The camera distance is chosen so that the faces fill the image, except for outliers of 0.2 % of
    their area.
    """
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    used, area = faces.reshape(-1), np.repeat(area, 3)
    low, high = (_quantile(vertices[used], area, q) for q in (0.002, 0.998))
    seen = (vertices - (low + high) / 2) @ axes.T
    tangent = math.tan(FIELD_OF_VIEW / 2)
    needed = np.abs(seen[used, :2]) / (tangent * np.array([width / height, 1.0]))
    nearest = (seen[used, 2] + needed.max(axis=1))[:, None]
    distance = 1.04 * float(_quantile(nearest, area, 0.998)[0])
    depth = np.maximum(distance - seen[:, 2], 0.01 * distance)
    focal = zoom * height / (2 * tangent)
    x = width / 2 + focal * seen[:, 0] / depth
    y = height / 2 - focal * seen[:, 1] / depth
    return np.stack([x, y, 1 / depth], axis=1)


def _quantile(values: np.ndarray, weights: np.ndarray, fraction: float) -> np.ndarray:
    """(C,) weighted quantiles of the columns of (N, C) values."""
    order = values.argsort(axis=0)
    total = weights[order].cumsum(axis=0)
    row = (total < fraction * total[-1]).sum(axis=0)
    return np.take_along_axis(values, np.take_along_axis(order, row[None], axis=0), axis=0)[0]


def _rasterize(
    triangles: np.ndarray, width: int, height: int, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """(P,) covered pixels (row * width + column) and (P,) nearest triangle on each, by z-buffer."""
    x, y = triangles[..., 0], triangles[..., 1]
    area = (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0]) - (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0])
    left = np.ceil(x.min(axis=1) - 0.5).clip(0).astype(np.int64)
    right = np.floor(x.max(axis=1) - 0.5).clip(-1, width - 1).astype(np.int64)
    top = np.ceil(y.min(axis=1) - 0.5).clip(0).astype(np.int64)
    bottom = np.floor(y.max(axis=1) - 0.5).clip(-1, height - 1).astype(np.int64)
    columns, rows = (right - left + 1).clip(0), (bottom - top + 1).clip(0)
    counts = columns * rows * (area > 0 if cull else area != 0)
    order = counts.nonzero()[0]
    cuts = np.searchsorted(counts[order].cumsum(), np.arange(1, 1 << 20) * CHUNK_PIXELS)
    buffer = np.full(width * height, EMPTY, dtype=np.uint64)
    for chunk in np.split(order, np.unique(cuts[cuts < len(order)])):
        face = np.repeat(chunk, counts[chunk])
        number = np.arange(len(face)) - np.repeat(
            counts[chunk].cumsum() - counts[chunk], counts[chunk]
        )
        column = left[face] + number % columns[face]
        row = top[face] + number // columns[face]
        weights = _barycentric(triangles[face], column + 0.5, row + 0.5)
        inside = (weights >= 0).all(axis=1)
        face, pixel = face[inside], (row * width + column)[inside]
        depth = 1 / (weights[inside] * triangles[face, :, 2]).sum(axis=1)
        # the bits of positive floats sort like the floats: depth first, then the face index
        key = depth.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
        np.minimum.at(buffer, pixel, key | face.astype(np.uint64))
    pixels = (buffer != EMPTY).nonzero()[0]
    return pixels, (buffer[pixels] & np.uint64(0xFFFFFFFF)).astype(np.int64)


def _barycentric(triangles: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(P, 3) barycentric coordinates of pixel positions x, y; all >= 0 inside the triangle."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    of_b = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / double
    of_c = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / double
    return np.stack([1 - of_b - of_c, of_b, of_c], axis=1)


def _shade(
    mesh: trimesh.Trimesh,
    corners: np.ndarray,
    screen: np.ndarray,
    pixels: np.ndarray,
    width: int,
    axes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) shaded colors, 0 to 255, and (P,) depths of pixels whose faces have (P, 3) corners."""
    vertices = np.asarray(mesh.vertices) @ axes.T
    normals = np.asarray(mesh.vertex_normals) @ axes.T
    visual: Any = mesh.visual
    colored = visual is not None and visual.kind == "vertex"
    colors = visual.vertex_colors[:, :3] if colored else np.full((len(vertices), 3), PLAIN)
    color = np.empty((len(pixels), 3), dtype=np.float32)
    depth = np.empty(len(pixels), dtype=np.float32)
    for start in range(0, len(pixels), CHUNK_PIXELS):
        part = slice(start, start + CHUNK_PIXELS)
        corner, pixel = corners[part], pixels[part]
        weights = _barycentric(screen[corner], pixel % width + 0.5, pixel // width + 0.5)
        weights = weights * screen[corner, 2]  # perspective: linear in 1 / depth
        depth[part] = 1 / weights.sum(axis=1)
        weights = weights * depth[part, None]
        edges = vertices[corner[:, 1:]] - vertices[corner[:, :1]]
        flat = np.cross(edges[:, 0], edges[:, 1])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        smooth = normals[corner]  # (P, 3 corners, 3)
        near = (smooth * flat[:, None]).sum(axis=2, keepdims=True) > SMOOTH
        normal = (weights[..., None] * np.where(near, smooth, flat[:, None])).sum(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        normal *= np.where(flat[:, 2:] < 0, -1, 1)  # back faces are lit as well
        light = AMBIENT + (1 - AMBIENT) * (normal @ LIGHT).clip(0)
        color[part] = (weights[..., None] * colors[corner]).sum(axis=1) * light[:, None]
    return color, depth


def _ambient_occlusion(depths: np.ndarray) -> np.ndarray:
    """(height, width) brightness in (0, 1]: lower where a pixel is deeper than its surroundings.

    Depths are 0 where no face is. Source: Luft, Colditz, Deussen, "Image enhancement by unsharp
    masking the depth buffer", 2006.
    """
    from scipy.ndimage import gaussian_filter

    covered = (depths > 0).astype(np.float32)
    if not covered.any():
        return covered
    logs = np.log(depths, where=depths > 0, out=np.zeros_like(depths))
    brightness = np.ones_like(depths)
    for radius, strength in ((depths.shape[0] / 200, 10.0), (depths.shape[0] / 40, 4.0)):
        around = gaussian_filter(logs, radius) / np.maximum(gaussian_filter(covered, radius), 1e-6)
        brightness *= np.exp(-strength * (logs - around).clip(0, 0.08))
    return brightness
