"""Messages of Foxglove's schemas in JSON: a surface, a cloud and a grid.

Source: https://docs.foxglove.dev/docs/sdk/schemas (SceneUpdate, PointCloud, Grid).
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.nav2_files import GroundGrid

if TYPE_CHECKING:
    import trimesh

FRAME = "map"
UINT8, FLOAT32 = 1, 7  # NumericType; ROS's PointField has other numbers
_UNUSED = ("arrows", "cubes", "spheres", "cylinders", "lines", "texts", "models")


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _numbers(*names: str) -> dict[str, Any]:
    return _object(**{name: {"type": "number"} for name in names})


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_INTEGER, _TEXT = {"type": "integer"}, {"type": "string"}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TIME = {"title": "time", **_object(sec=_INTEGER, nsec=_INTEGER)}
_DURATION = {"title": "duration", **_object(sec=_INTEGER, nsec=_INTEGER)}
_POSE = _object(position=_numbers(*"xyz"), orientation=_numbers(*"xyzw"))
_FIELDS = _array(_object(name=_TEXT, offset=_INTEGER, type=_INTEGER))
_TRIANGLES = _object(
    pose=_POSE,
    points=_array(_numbers(*"xyz")),
    color=_numbers(*"rgba"),
    colors=_array(_numbers(*"rgba")),
    indices=_array(_INTEGER),
)
_ENTITY = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked={"type": "boolean"},
    metadata=_array(_object(key=_TEXT, value=_TEXT)),
    triangles=_array(_TRIANGLES),
    **{name: _array({"type": "object"}) for name in _UNUSED},
)
_MESSAGES = {
    "foxglove.SceneUpdate": _object(
        deletions=_array(_object(timestamp=_TIME, type=_INTEGER, id=_TEXT)),
        entities=_array(_ENTITY),
    ),
    "foxglove.PointCloud": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        point_stride=_INTEGER,
        fields=_FIELDS,
        data=_BYTES,
    ),
    "foxglove.Grid": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        column_count=_INTEGER,
        cell_size=_numbers("x", "y"),
        row_stride=_INTEGER,
        cell_stride=_INTEGER,
        fields=_FIELDS,
        data=_BYTES,
    ),
}
SCHEMAS = {name: {"title": name, **schema} for name, schema in _MESSAGES.items()}


def scene_update(
    mesh: trimesh.Trimesh, origin: NDArray[np.float64], nanoseconds: int
) -> dict[str, Any]:
    """A foxglove.SceneUpdate with one entity, which replaces the surface sent before.

    Args:
        mesh: the surface, world frame [m], with vertex colors.
        origin: (3,) position to which vertices are relative in the message [m].
        nanoseconds: time of the message.
    """
    offsets = (np.asarray(mesh.vertices).reshape(-1, 3) - origin).round(4).tolist()
    visual: Any = mesh.visual
    colors = np.asarray(visual.vertex_colors).reshape(-1, 4) / 255
    triangles = {
        "pose": _pose(origin),
        "points": [{"x": x, "y": y, "z": z} for x, y, z in offsets],
        "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
        "colors": [{"r": r, "g": g, "b": b, "a": a} for r, g, b, a in colors.round(3).tolist()],
        "indices": np.asarray(mesh.faces).reshape(-1).tolist(),
    }
    entity = {
        "timestamp": _time(nanoseconds),
        "frame_id": FRAME,
        "id": "surface",
        "lifetime": {"sec": 0, "nsec": 0},  # until it is replaced
        "frame_locked": False,
        "metadata": [],
        "triangles": [triangles],
        **{name: [] for name in _UNUSED},
    }
    return {"deletions": [], "entities": [entity]}


def point_cloud(
    points: NDArray[np.float64], origin: NDArray[np.float64], nanoseconds: int
) -> dict[str, Any]:
    """A foxglove.PointCloud of (n, 3) points, world frame [m]; as float32 relative to origin (3,)."""
    return {
        "timestamp": _time(nanoseconds),
        "frame_id": FRAME,
        "pose": _pose(origin),
        "point_stride": 12,
        "fields": [{"name": n, "offset": 4 * i, "type": FLOAT32} for i, n in enumerate("xyz")],
        "data": _encoded((points - origin).astype("<f4")),
    }


def ground_grid_message(found: GroundGrid, height: float, nanoseconds: int) -> dict[str, Any]:
    """A foxglove.Grid of what `ground_grid` found, at a height [m].

    A cell has the probability (float32, NaN where unknown) and a shade of gray: darker is more
    occupied, and unknown cells are transparent.
    """
    log_odds = found.log_odds.T
    cells = np.zeros(log_odds.shape, [("probability", "<f4"), ("color", "u1", 4)])
    cells["probability"] = 1 / (1 + np.exp(-log_odds))
    cells["color"] = found.shades()
    colors = [
        {"name": name, "offset": 4 + i, "type": UINT8}
        for i, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    return {
        "timestamp": _time(nanoseconds),
        "frame_id": FRAME,
        "pose": _pose(np.array([*found.corner, height])),
        "column_count": log_odds.shape[1],
        "cell_size": {"x": found.resolution, "y": found.resolution},
        "row_stride": 8 * log_odds.shape[1],
        "cell_stride": 8,
        "fields": [{"name": "probability", "offset": 0, "type": FLOAT32}, *colors],
        "data": _encoded(cells),
    }


def _pose(position: NDArray[np.float64]) -> dict[str, Any]:
    x, y, z = map(float, position)
    return {
        "position": {"x": x, "y": y, "z": z},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }


def _time(nanoseconds: int) -> dict[str, int]:
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}


def _encoded(array: NDArray[Any]) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
