"""The ROS 2 node without ROS: its conversions, and its wiring on stand-ins for the ROS modules."""

import importlib.util
import sys
import threading
import types
from array import array
from types import SimpleNamespace

import numpy as np
import pytest
import ros2_node
import torch
from small_maps import GaussianMap, wall_map

from lardhm_torch import LardHilbertMap, Scans, resume_stream, simulate_room
from lardhm_torch.io.nav2_files import GroundGrid, ground_grid

FLOAT32, UINT16 = 7, 4


def cloud_of(points, *, height=1, row_padding=0, stamp=None):
    """A PointCloud2 with a ring number between the coordinates, padded points and padded rows."""
    kind = np.dtype(
        {
            "names": ["x", "ring", "y", "z"],
            "formats": ["<f4", "<u2", "<f4", "<f4"],
            "offsets": [4, 8, 12, 16],
            "itemsize": 32,
        }
    )
    width = len(points) // height
    rows = np.zeros((height, width), kind)
    for column, name in enumerate("xyz"):
        rows[name] = np.asarray(points)[:, column].reshape(height, width)
    rows["ring"] = 7
    content = b"".join(row.tobytes() + b"\xff" * row_padding for row in rows)
    fields = [
        SimpleNamespace(name=name, offset=kind.fields[name][1], datatype=number, count=1)
        for name, number in zip(kind.names, (FLOAT32, UINT16, FLOAT32, FLOAT32), strict=True)
    ]
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="lidar", stamp=stamp),
        fields=fields,
        height=height,
        width=width,
        point_step=32,
        row_step=32 * width + row_padding,
        is_bigendian=False,
        data=array("B", content),
    )


def transform_of(translation=(0, 0, 0), rotation=(0, 0, 0, 1)):
    return SimpleNamespace(
        translation=SimpleNamespace(**dict(zip("xyz", translation, strict=True))),
        rotation=SimpleNamespace(**dict(zip("xyzw", rotation, strict=True))),
    )


def test_it_imports_without_ros():
    if importlib.util.find_spec("rclpy"):
        pytest.skip("rclpy is installed")
    with pytest.raises(ImportError, match="rclpy"):
        ros2_node.make_node()


@pytest.mark.parametrize(("height", "row_padding"), [(1, 0), (2, 0), (2, 24)])
def test_points_of_padded_clouds(height, row_padding):
    points = np.arange(18, dtype=np.float32).reshape(6, 3) + 0.5
    cloud = cloud_of(points, height=height, row_padding=row_padding)
    np.testing.assert_array_equal(ros2_node.points_of(cloud), points)


def test_points_without_a_place_are_dropped():
    points = [[1, 2, 3], [np.nan] * 3, [0, 0, 0], [1, np.inf, 1], [0, 0, 5], [1, 1, np.nan]]
    np.testing.assert_array_equal(ros2_node.points_of(cloud_of(points)), [[1, 2, 3], [0, 0, 5]])
    assert ros2_node.points_of(cloud_of(np.zeros((0, 3)))).shape == (0, 3)


def test_a_cloud_that_is_too_short_is_refused():
    cloud = cloud_of(np.ones((4, 3)))
    cloud.data = cloud.data[:-1]
    with pytest.raises(ValueError, match="declares 1 x 4 points"):
        ros2_node.points_of(cloud)


def test_a_scan_lies_where_tf_says():
    quarter = (0, 0, 0.5**0.5, 0.5**0.5)  # about z, by 90 degrees
    scan = ros2_node.scan_of(np.array([[2.0, 0, 0.5]]), transform_of((10, 20, 1), quarter))
    assert scan.origins.tolist() == [[10, 20, 1]]
    np.testing.assert_allclose(scan.ends.numpy(), [[10, 22, 1.5]], atol=1e-12)
    with pytest.raises(ValueError, match="not all 0"):
        ros2_node.scan_of(np.ones((1, 3)), transform_of(rotation=(0, 0, 0, 0)))


def test_grid_fields_are_row_major_with_minus_one_for_unknown():
    log_odds = np.array([[np.nan, 2.0], [-3.0, np.nan], [0.0, 50.0]], dtype=np.float32)  # 3 x, 2 y
    fields = ros2_node.grid_fields(GroundGrid(log_odds, np.array([-4, 8]), 0.25))
    assert (fields["width"], fields["height"], fields["resolution"]) == (3, 2, 0.25)
    assert fields["origin"] == (-1.0, 2.0)
    assert fields["data"].typecode == "b"
    assert fields["data"].tolist() == [-1, 5, 50, 88, -1, 100]


def test_the_grid_of_a_map_has_the_obstacle_in_its_cell():
    stds = torch.tensor([0.05, 0.4])
    model = GaussianMap(
        [[3.0, 1.0, 1.0], [1.0, 1.0, 1.0]], stds[:, None, None] * torch.eye(3), [9.0, -6.0]
    )
    found = ros2_node.grid_fields(ground_grid(model, 0.2, heights=(0.8, 1.2)))
    values = np.array(found["data"]).reshape(found["height"], found["width"])

    def value(x, y):
        left, bottom = found["origin"]
        return values[int((y - bottom) / 0.2), int((x - left) / 0.2)]

    assert value(3.01, 1.01) > 90
    assert 0 <= value(1.01, 1.01) < 10
    assert value(2.3, 1.01) == -1
    assert len(ground_grid(model, 0.2, heights=(50, 51)).log_odds) == 0


def test_corners_of_triangles():
    trimesh = pytest.importorskip("trimesh")
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    colors = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [51, 51, 51, 255]])
    mesh = trimesh.Trimesh(
        vertices, [[0, 1, 2], [3, 1, 0]], vertex_colors=colors.astype(np.uint8), process=False
    )
    points, found = ros2_node.triangle_corners(mesh)
    np.testing.assert_array_equal(points, vertices[[0, 1, 2, 3, 1, 0]])
    np.testing.assert_allclose(found, colors[[0, 1, 2, 3, 1, 0]] / 255)


def test_octomap_data_is_a_tree_without_header(tmp_path):
    octomap = pytest.importorskip("octomap", reason="octomap-python is not installed")
    data = ros2_node.octomap_data(wall_map(), 0.1)
    pairs = np.unpackbits(np.frombuffer(data, np.uint8)).reshape(-1, 2)
    nodes = 1 + int(
        pairs.any(axis=1).sum()
    )  # two bits for each possible child, 00 if there is none
    header = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes}\nres 0.1\ndata\n"
    path = tmp_path / "map.bt"
    path.write_bytes(header.encode() + data.tobytes())
    tree = octomap.OcTree(0.1)
    assert tree.readBinary(str(path).encode())
    assert tree.isNodeOccupied(tree.search(np.array([1.0, 1.0, 1.0])))
    assert not tree.isNodeOccupied(tree.search(np.array([0.4, 1.0, 1.0])))


def test_a_full_queue_drops_the_oldest_scan():
    scans = ros2_node.ScanQueue(2)
    made = [Scans(torch.zeros(1, 3), torch.ones(n, 3)) for n in (1, 2, 3)]
    for scan in made:
        scans.put(scan)
    assert scans.num_dropped == 1
    assert list(map(len, [next(iter(scans)), next(iter(scans))])) == [2, 3]
    scans.put(None)
    assert list(scans) == []


def test_publications_keep_their_distance(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr(ros2_node.time, "monotonic", lambda: now[0])
    show = ros2_node.at_most_every(2.0, calls.append)
    for now[0] in (0.0, 1.0, 1.9, 2.0, 3.0, 4.5):
        show(now[0])
    assert calls == [0.0, 2.0, 4.5]


class Message:
    """A message with all fields that the node sets, and others refused where they are nested."""

    TRIANGLE_LIST, ADD = 11, 0

    def __init__(self, **fields):
        nested = SimpleNamespace
        self.header = nested(frame_id="", stamp=None)
        self.info = nested(
            resolution=0.0,
            width=0,
            height=0,
            origin=nested(position=nested(), orientation=nested()),
        )
        self.pose, self.scale, self.color = nested(orientation=nested()), nested(), nested()
        vars(self).update(fields)


class FakeNode:
    """What the node uses of rclpy.node.Node; published messages are kept by topic."""

    def __init__(self, name):
        self.published, self.warnings, self.callbacks = {}, [], {}
        self.context = SimpleNamespace(ok=lambda: True)

    def declare_parameter(self, name, value):
        changed = {"period": 0.0, "heights": [0.3, 1.5], "resolution": 0.2, **self.changes}
        return SimpleNamespace(value=changed.get(name, value))

    def create_publisher(self, kind, topic, qos):
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind, topic, callback, qos):
        self.callbacks[topic] = callback

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))


@pytest.fixture
def fake_ros(monkeypatch):
    """Stand-ins for the ROS modules; the poses of clouds are their stamps."""

    class TransformException(Exception):  # noqa: N818
        pass

    def lookup(target, source, time, timeout):
        if time is None:
            raise TransformException(f"no transform from {source} to {target}")
        return SimpleNamespace(transform=time)

    simple = {
        "rclpy": {"try_shutdown": lambda: None},
        "rclpy.duration": {"Duration": SimpleNamespace},
        "rclpy.node": {"Node": FakeNode},
        "rclpy.qos": {
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1),
            "QoSProfile": SimpleNamespace,
            "qos_profile_sensor_data": None,
        },
        "rclpy.time": {"Time": SimpleNamespace(from_msg=lambda stamp: stamp)},
        "tf2_ros": {
            "Buffer": lambda: SimpleNamespace(lookup_transform=lookup),
            "TransformException": TransformException,
            "TransformListener": lambda buffer, node: None,
        },
    }
    kinds = {
        "geometry_msgs": ["Point"],
        "nav_msgs": ["OccupancyGrid"],
        "octomap_msgs": ["Octomap"],
        "sensor_msgs": ["PointCloud2"],
        "std_msgs": ["ColorRGBA"],
        "visualization_msgs": ["Marker"],
    }
    for package, names in kinds.items():
        simple[package] = {}
        simple[f"{package}.msg"] = dict.fromkeys(names, Message)
    for name, content in simple.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)


def test_the_node_learns_clouds_and_publishes(fake_ros, tmp_path, monkeypatch):
    monkeypatch.setattr(
        FakeNode, "changes", {"path": str(tmp_path / "map.pt"), "period": 1e9}, raising=False
    )
    node = ros2_node.make_node()
    room = simulate_room(1500, seed=0)
    lost = cloud_of(np.ones((2, 3)))
    node.callbacks["cloud"](lost)
    assert node.warnings == ["a cloud was left out: no transform from lidar to map"]
    for number in range(room.num_scans):
        seen = (room.scan_id == number) & room.is_return
        place = room.origins[number]
        cloud = cloud_of((room.ends[seen] - place).numpy(), stamp=transform_of(place.tolist()))
        node.callbacks["cloud"](cloud)
    node.close()
    assert not any(thread is node.worker for thread in threading.enumerate())
    assert len(LardHilbertMap.load(tmp_path / "map.pt")) == len(node.model) > 0
    node.publish(node.model)
    grid, marker = node.published["grid"][-1], node.published["surface"][-1]
    for message in (grid, marker):
        assert message.header == SimpleNamespace(frame_id="map", stamp="now")
    assert len(grid.data) == grid.info.width * grid.info.height > 0
    assert {-1} < set(grid.data) <= set(range(-1, 101))
    assert marker.type == 11
    assert len(marker.points) == len(marker.colors) > 0
    assert len(marker.points) % 3 == 0
    corners = np.array([[p.x, p.y, p.z] for p in marker.points])
    distances = torch.cdist(torch.from_numpy(corners), simulate_room(20_000, seed=1).hits).amin(
        dim=1
    )
    assert distances.median() < 0.15
    if node.published["octomap"]:
        octomap = node.published["octomap"][-1]
        assert (octomap.binary, octomap.id, octomap.resolution) == (True, "OcTree", 0.2)
        assert len(octomap.data) > 100


def test_after_a_shutdown_the_map_is_still_written(fake_ros, tmp_path, monkeypatch):
    path = tmp_path / "map.pt"
    monkeypatch.setattr(FakeNode, "changes", {"path": str(path)}, raising=False)
    node, is_up = ros2_node.make_node(), [True]

    def publish(message):
        is_up[0] = False
        raise RuntimeError("the context was shut down")

    node.context.ok = lambda: is_up[0]
    node.grids.publish = publish
    points = np.random.default_rng(0).normal(size=(200, 3)) + np.array([4, 0, 0])
    for _ in range(3):
        node.callbacks["cloud"](cloud_of(points, stamp=transform_of()))
    node.close()
    assert not is_up[0]
    assert resume_stream(path)[1].scans == 3
