"""One scan of the simulated room, as the tests of file formats write it."""

import numpy as np

from lardhm_torch import simulate_room

POSITION = np.array([1.5, -0.75, 1.25])
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z, by 90 degrees
QUATERNION = [0.5**0.5, 0.0, 0.0, 0.5**0.5]  # the same, w x y z


def pose() -> np.ndarray:
    """(4, 4) world_from_sensor of the tests."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, POSITION
    return matrix


def sensor_points(count: int = 240) -> np.ndarray:
    """(count, 3) hits of the room in the frame of its first sensor, none of them at zero."""
    scans = simulate_room(num_rays=2000, seed=3)
    mine = (scans.scan_id == 0) & scans.is_return
    return (scans.ends[mine] - scans.origins[0])[:count].numpy().round(4)


def world_points(count: int = 240) -> np.ndarray:
    """(count, 3) the same hits in the world frame."""
    return sensor_points(count) @ TURN.T + POSITION


def with_zeros(points: np.ndarray) -> np.ndarray:
    """The points with every third at exactly zero."""
    marked = points.copy()
    marked[::3] = 0
    return marked


def without_third(points: np.ndarray) -> np.ndarray:
    """What `with_zeros` leaves of the points."""
    return points[np.arange(len(points)) % 3 != 0]


def append_without_pose(file, columns: dict[str, np.ndarray]) -> None:
    """A scan of an open E57 without a pose; write_scan_raw always writes one, identity by default."""
    from pye57 import libe57

    image, scan = file.image_file, libe57.StructureNode(file.image_file)
    scan.set("guid", libe57.StringNode(image, "{1}"))
    prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
    held = {
        name: np.ascontiguousarray(values, dtype=np.float64) for name, values in columns.items()
    }
    for name, values in held.items():
        is_state = name.endswith("State")
        node = (
            libe57.IntegerNode(image, 0, 0, 2)
            if is_state
            else libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)
        )
        prototype.set(name, node)
        buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
    vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", vector)
    file.data3d.append(scan)
    writer = vector.writer(buffers)
    writer.write(len(values))
    writer.close()


def ptx(points, shape, position, matrix, columns=" 0.5"):
    """One scan as Leica writes it: the matrix is for row vectors."""
    rows = [*matrix[:3, :3].T.tolist(), *matrix.T.tolist()]
    lines = [*map(str, shape), *(" ".join(map(repr, row)) for row in [position.tolist(), *rows])]
    lines += [" ".join(map(repr, row)) + columns for row in points.tolist()]
    return "\n".join(lines) + "\n"
