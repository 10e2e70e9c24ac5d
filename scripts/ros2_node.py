"""ROS 2 node: a map from the clouds of a moving sensor, published as grid, surface and OctoMap.

    python scripts/ros2_node.py --ros-args -r cloud:=/lidar/points \\
        -p map_frame:=odom -p heights:="[0.2, 1.5]" -p path:=map.pt

Run it with the Python of a ROS 2 installation (`source /opt/ros/<release>/setup.bash`) in which
lardhm_torch is installed. It was written against the documented interfaces of rclpy and tf2_ros.

| topic | kind | content |
|---|---|---|
| `cloud` (in) | sensor_msgs/PointCloud2 | points in the frame of the sensor; its pose comes from tf |
| `grid` | nav_msgs/OccupancyGrid | cells within `heights`: -1 unknown, else probability in percent |
| `surface` | visualization_msgs/Marker | triangles of the surface, colored by height |
| `octomap` | octomap_msgs/Octomap | occupied and free cells; needs octomap_msgs and octomap-python |

| parameter | default | |
|---|---|---|
| `map_frame` | map | frame of the map; tf must connect it to the frame of the clouds |
| `heights` | 0.2, 1.5 | lowest and highest z of obstacles for the robot, in the map frame [m] |
| `resolution` | 0.1 | edge of a cell of the grid, the surface and the OctoMap [m] |
| `period` | 2.0 | shortest time between two publications [s] |
| `max_range` | 100.0 | longer rays are cut here and have no hit [m] |
| `radius` | 0.0 | clusters farther than this from the sensor are removed [m]; 0: none |
| `path` | | map file, written every 10 scans and at the end, see `resume_stream` |

Parameters that are numbers need a decimal point: `-p max_range:=50.0`.
Scans that come while the map is busy wait, at most 5; then the oldest is dropped, with a warning.
Inputs are points without NaN; those at 0 0 0 are dropped, too, because drivers write "no return" so.
"""

from __future__ import annotations

import queue
import tempfile
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lardhm_torch import (
    LardHilbertMap,
    SamplingConfig,
    Scans,
    StreamConfig,
    extract_mesh,
    real_time,
    save_grid,
    stream_scans,
)
from lardhm_torch.io.nav2_files import GroundGrid, ground_grid
from lardhm_torch.io.ros_clouds import cloud_points
from lardhm_torch.io.trajectories import move_points, poses_from_quaternions


def points_of(cloud: Any) -> np.ndarray:
    """(n, 3) points of a PointCloud2, in its frame; those with NaN, inf or at 0 0 0 are dropped.

    Raises:
        ValueError: there are no fields x, y, z of floats, or fewer bytes than promised.
    """
    points = cloud_points(cloud)
    return points[np.isfinite(points).all(axis=1) & points.any(axis=1)]


def scan_of(points: np.ndarray, transform: Any) -> Scans:
    """A scan in the map frame.

    Args:
        points: (n, 3) in the frame of the sensor [m].
        transform: map_from_sensor, a geometry_msgs/Transform.
    """
    t, q = transform.translation, transform.rotation
    pose = poses_from_quaternions(
        np.array([[t.x, t.y, t.z]]), np.array([[q.x, q.y, q.z, q.w]], dtype=np.float64)
    )[0]
    ends = torch.from_numpy(move_points(pose, points))
    return Scans(torch.from_numpy(pose[None, :3, 3].copy()), ends)


def grid_fields(found: GroundGrid) -> dict[str, Any]:
    """Fields of nav_msgs/OccupancyGrid.

    Returns:
        ``resolution`` [m], ``width``, ``height``, ``origin`` (x, y) of the lower corner of the first
        cell [m], and ``data``: int8, row by row from the lowest y, each row from the lowest x.
    """
    values = found.percent()
    return {
        "resolution": found.resolution,
        "width": values.shape[1],
        "height": values.shape[0],
        "origin": found.corner,
        "data": array("b", values.tobytes()),
    }


def triangle_corners(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points and colors of a TRIANGLE_LIST: (3 F, 3) positions [m], (3 F, 4) RGBA from 0 to 1."""
    corners = np.asarray(mesh.faces).reshape(-1)
    colors = np.asarray(mesh.visual.vertex_colors).reshape(-1, 4) / 255
    return np.asarray(mesh.vertices)[corners], colors[corners]


def octomap_data(model: LardHilbertMap, resolution: float) -> array:
    """The int8 data of a binary octomap_msgs/Octomap: a .bt file without its header.

    It holds the cells in the box around all centers of clusters, since what lies beyond was hardly
    seen and would take most of the time.

    Raises:
        ImportError: octomap-python is not installed.
        ValueError: as for `save_grid`.
    """
    centers = model.centers.detach().double() + model.origin
    bounds = centers.amin(dim=0) - resolution, centers.amax(dim=0) + resolution
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.bt"
        save_grid(model, path, resolution, bounds)
        return array("b", path.read_bytes().partition(b"\ndata\n")[2])


class ScanQueue:
    """Scans on their way from a callback to the thread that updates the map."""

    def __init__(self, size: int = 5) -> None:
        self._scans: queue.Queue[Scans | None] = queue.Queue(size)
        self.num_dropped = 0

    def put(self, scan: Scans | None) -> None:
        """Add a scan, in place of the oldest if the queue is full; None: it was the last."""
        while True:
            try:
                return self._scans.put_nowait(scan)
            except queue.Full:
                try:
                    self._scans.get_nowait()
                    self.num_dropped += 1
                except queue.Empty:  # the other thread was faster
                    continue

    def __iter__(self) -> Iterator[Scans]:
        """Yield the scans, waiting for each, up to the last."""
        return iter(self._scans.get, None)


def at_most_every(
    period: float, call: Callable[[LardHilbertMap], None]
) -> Callable[[LardHilbertMap], None]:
    """A function that does the same, unless it did so less than a period [s] ago."""
    due = -float("inf")

    def after_scan(model: LardHilbertMap) -> None:
        nonlocal due
        if time.monotonic() >= due:
            call(model)
            due = time.monotonic() + period

    return after_scan


def make_node() -> Any:
    """The node; needs rclpy. `close` ends its thread and writes the map."""
    import rclpy
    from geometry_msgs.msg import Point
    from nav_msgs.msg import OccupancyGrid
    from rclpy.duration import Duration
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import ColorRGBA
    from tf2_ros import Buffer, TransformException, TransformListener
    from visualization_msgs.msg import Marker

    try:
        from octomap_msgs.msg import Octomap
    except ImportError:
        Octomap = None

    class MapNode(Node):
        """Updates a map with every cloud and publishes what it shows."""

        def __init__(self) -> None:
            super().__init__("lardhm")
            values = {
                "map_frame": "map",
                "heights": [0.2, 1.5],
                "resolution": 0.1,
                "period": 2.0,
                "max_range": 100.0,
                "radius": 0.0,
                "path": "",
            }
            self.settings = {
                name: self.declare_parameter(name, value).value for name, value in values.items()
            }
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.grids = self.create_publisher(OccupancyGrid, "grid", latched)
            self.surfaces = self.create_publisher(Marker, "surface", latched)
            self.octomaps = Octomap and self.create_publisher(Octomap, "octomap", latched)
            self.transforms = Buffer()
            self.listener = TransformListener(self.transforms, self)
            self.scans, self.model = ScanQueue(), LardHilbertMap()
            self.worker = threading.Thread(target=self.learn)
            self.worker.start()
            self.create_subscription(PointCloud2, "cloud", self.receive, qos_profile_sensor_data)

        def receive(self, cloud: Any) -> None:
            """Put a cloud in the queue, with the pose at its time."""
            dropped = self.scans.num_dropped
            try:
                pose = self.transforms.lookup_transform(
                    self.settings["map_frame"],
                    cloud.header.frame_id,
                    Time.from_msg(cloud.header.stamp),
                    Duration(seconds=0.5),
                )
                self.scans.put(scan_of(points_of(cloud), pose.transform))
            except (TransformException, ValueError) as error:
                self.get_logger().warning(f"a cloud was left out: {error}")
            if self.scans.num_dropped > dropped:
                self.get_logger().warning("the map is behind: the oldest waiting scan was dropped")

        def learn(self) -> None:
            """Update the map until the last scan, in a thread of its own; an error ends the node."""
            config = StreamConfig(
                radius=self.settings["radius"] or None,
                sampling=SamplingConfig(max_range=self.settings["max_range"]),
                checkpoint_every=10,
            )
            show = at_most_every(self.settings["period"], self.publish)
            path = self.settings["path"] or None
            try:
                stream_scans(self.model, self.scans, real_time(config), path=path, after_scan=show)
            finally:
                rclpy.try_shutdown()

        def publish(self, model: LardHilbertMap) -> None:
            """Publish the map, unless ROS was shut down: the remaining scans are learned anyway."""
            try:
                if len(model) > 0 and self.context.ok():
                    self.show(model)
            except Exception:
                if self.context.ok():
                    raise

        def show(self, model: LardHilbertMap) -> None:
            """Publish grid, surface and OctoMap of the map."""
            resolution = self.settings["resolution"]
            found = ground_grid(model, resolution, heights=tuple(self.settings["heights"]))
            self.grids.publish(self.stamped(grid_message(OccupancyGrid(), grid_fields(found))))
            mesh = extract_mesh(model, resolution)
            marker = marker_message(Marker(), Point, ColorRGBA, *triangle_corners(mesh))
            self.surfaces.publish(self.stamped(marker))
            if self.octomaps:
                try:
                    data = octomap_data(model, resolution)
                except (ImportError, ValueError) as error:
                    self.get_logger().warning(str(error))
                    self.octomaps = None
                    return
                message = Octomap(binary=True, id="OcTree", resolution=resolution, data=data)
                self.octomaps.publish(self.stamped(message))

        def stamped(self, message: Any) -> Any:
            """The message in the frame of the map, at this time."""
            message.header.frame_id = self.settings["map_frame"]
            message.header.stamp = self.get_clock().now().to_msg()
            return message

        def close(self) -> None:
            """Learn the scans that wait, write the map, end the thread."""
            self.scans.put(None)
            self.worker.join()

    return MapNode()


def grid_message(message: Any, fields: dict[str, Any]) -> Any:
    """Fill a nav_msgs/OccupancyGrid with `grid_fields`."""
    for name in ("resolution", "width", "height"):
        setattr(message.info, name, fields[name])
    position = message.info.origin.position
    position.x, position.y = fields["origin"]
    message.info.origin.orientation.w = 1.0
    message.data = fields["data"]
    return message


def marker_message(
    message: Any, point: Any, color: Any, points: np.ndarray, colors: np.ndarray
) -> Any:
    """Fill a visualization_msgs/Marker with triangles.

    Args:
        message: the marker.
        point: class of geometry_msgs/Point.
        color: class of std_msgs/ColorRGBA.
        points: (3 F, 3) corners [m].
        colors: (3 F, 4) RGBA from 0 to 1.
    """
    message.ns, message.id = "lardhm", 0
    message.type = message.TRIANGLE_LIST
    message.action = message.ADD
    message.pose.orientation.w = 1.0
    message.scale.x = message.scale.y = message.scale.z = 1.0
    message.color.a = 1.0
    message.points = [point(x=x, y=y, z=z) for x, y, z in points.tolist()]
    message.colors = [color(r=r, g=g, b=b, a=a) for r, g, b, a in colors.tolist()]
    return message


def main() -> None:
    """Run the node until Ctrl-C."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor

    rclpy.init()
    node = make_node()
    executor = MultiThreadedExecutor(num_threads=2)  # receives tf while a cloud waits for its pose
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
