"""Small valid files of every format that is read, written by the libraries of the formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

CLOUD_TOPIC, POSE_TOPIC, FRAME = "/points", "/odom", "lidar"
LIVOX_TYPES = {  # https://github.com/Livox-SDK/livox_ros_driver2/tree/master/msg
    "livox_ros_driver2/msg/CustomPoint": """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
""",
    "livox_ros_driver2/msg/CustomMsg": """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
""",
}


def write_ply(path: Path, points: np.ndarray, encoding: str) -> None:
    """A PLY file with points and one origin per point."""
    header = f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {len(points)}\n"
    header += "".join(f"property double {name}\n" for name in ("x", "y", "z", "ox", "oy", "oz"))
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.hstack([points, np.ones_like(points)])
    if encoding == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()).encode() + b"\n3 0 1 2"
    else:
        order = "<" if "little" in encoding else ">"
        body = rows.astype(f"{order}f8").tobytes() + b"\3" + np.arange(3, dtype="<i4").tobytes()
    path.write_bytes(header.encode() + body)


def write_ply_lists(path: Path, points: np.ndarray, is_ascii: bool) -> None:
    """Vertices that each have a list after their coordinates, and a list element before them."""
    encoding = "ascii" if is_ascii else "binary_little_endian"
    lines = ["ply", f"format {encoding} 1.0", "element strip 2", "property list uchar int i"]
    lines += [f"element vertex {len(points)}", *(f"property double {name}" for name in "xyz")]
    header = "\n".join([*lines, "property list uchar float seen", "end_header", ""])
    lengths = np.arange(len(points)) % 4
    if is_ascii:
        rows = [
            f"{' '.join(map(repr, row))} {n}{' 0.5' * n}"
            for row, n in zip(points.tolist(), lengths, strict=True)
        ]
        path.write_text(header + "2 1 2\n0\n" + "\n".join(rows) + "\n")
        return
    seen = [bytes([n]) + np.full(n, 0.5, "<f4").tobytes() for n in lengths]
    rows = [row.astype("<f8").tobytes() + tail for row, tail in zip(points, seen, strict=True)]
    strips = b"\2" + np.arange(2, dtype="<i4").tobytes() + b"\0"
    path.write_bytes(header.encode() + strips + b"".join(rows))


def write_pts(path: Path, scans: Sequence[np.ndarray]) -> None:
    """Tables of points, each with a count line before it."""
    tables = [
        f"{len(points)}\n" + "".join(f"{x} {y} {z} -1200 1 2 3\n" for x, y, z in points)
        for points in scans
    ]
    path.write_text("".join(tables))


def grid_of_angles(columns: int, rows: int) -> np.ndarray:
    """Points on a sphere, column by column: each column has one azimuth, each row one elevation."""
    azimuth, elevation = np.meshgrid(np.arange(columns) / 10, np.arange(rows) / 20, indexing="ij")
    beams = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)]
    return 3 * np.stack([*beams, np.sin(elevation)], axis=-1).reshape(-1, 3).round(6)


def write_ptx(path: Path, points: np.ndarray, poses: np.ndarray, with_zeros: bool) -> None:
    """One scan a pose, its points on a grid of 15 columns; with_zeros: a grid of angles with gaps."""
    rows = len(points) // 15
    points = points[: 15 * rows]
    if with_zeros:
        points = grid_of_angles(15, rows)
        points[::7] = 0
    text = ""
    for pose in poses:
        header = [pose[:3, 3], *pose[:3, :3].T, *pose.T]
        lines = [" ".join(map(repr, row.tolist())) for row in [*header, *points]]
        text += (
            f"15\n{rows}\n" + "\n".join(lines[:8] + [f"{line} 0.5" for line in lines[8:]]) + "\n"
        )
    path.write_text(text)


def write_pcd(path: Path, points: np.ndarray, encoding: str) -> None:
    """A PCD file with VIEWPOINT; compressed ones hold copies that run into themselves."""
    header = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
    header += f"COUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\n"
    header += f"POINTS {len(points)}\nDATA {encoding}\n"
    rows = np.hstack([points, np.zeros((len(points), 1))]).astype("<f4")
    if encoding == "ascii":
        body = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    elif encoding == "binary":
        body = rows.tobytes()
    else:
        packed, size = compress_lzf(np.ascontiguousarray(rows.T).tobytes()), rows.nbytes
        body = len(packed).to_bytes(4, "little") + size.to_bytes(4, "little") + packed
    path.write_bytes(header.encode() + body)


def write_organized_pcd(path: Path, columns: int, rows: int) -> None:
    """A PCD file of a grid of angles, every seventh point of which is NaN."""
    points = grid_of_angles(columns, rows).reshape(columns, rows, 3).swapaxes(0, 1).reshape(-1, 3)
    points[::7] = np.nan
    write_pcd(path, points + np.array([1, 2, 3]), "binary")
    old, new = f"WIDTH {len(points)}\nHEIGHT 1\n", f"WIDTH {columns}\nHEIGHT {rows}\n"
    path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))


def compress_lzf(content: bytes) -> bytes:
    """LZF of content: runs of one byte as copies that run into themselves, the rest as literals."""
    packed, literal, i = bytearray(), bytearray(), 0
    while i < len(content) or literal:
        run = 0
        while i and i + run < len(content) and run < 264 and content[i + run] == content[i - 1]:
            run += 1
        if literal and (run >= 3 or len(literal) == 32 or i == len(content)):
            packed += bytes([len(literal) - 1]) + literal
            literal = bytearray()
        if run >= 9:
            packed += bytes([7 << 5, run - 9, 0])
        elif run >= 3:
            packed += bytes([(run - 2) << 5, 0])
        elif i < len(content):
            literal.append(content[i])
            run = 1
        i += run
    return bytes(packed)


def write_las(path: Path, points: np.ndarray, point_format: int) -> None:
    """A LAS 1.4 or LAZ file; formats from 6 on are compressed in layers, older ones are not."""
    import laspy

    las = laspy.create(file_version="1.4", point_format=point_format)
    las.header.scales = [1e-3] * 3
    las.x, las.y, las.z = points.T
    las.return_number = np.ones(len(points), dtype=np.uint8)
    las.write(path)


def write_kitti(folder: Path, points: np.ndarray) -> Path:
    """A KITTI scan; the folder gets its poses.txt too."""
    (folder / "poses.txt").write_text("1 0 0 5 0 1 0 6 0 0 1 7\n")
    np.hstack([points, abs(points[:, :1])]).astype("<f4").tofile(folder / "000000.bin")
    return folder / "000000.bin"


def checksums_mended(content: bytes) -> bytes:
    """An E57 file whose pages have the right checksums again (CRC-32C), so that readers go on."""
    pages = np.frombuffer(content[: len(content) // 1024 * 1024], np.uint8).reshape(-1, 1024).copy()
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> 1) ^ np.where(table & 1, np.uint32(0x82F63B78), np.uint32(0))
    checksums = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages[:, :1020].T:
        checksums = table[(checksums ^ column) & 0xFF] ^ (checksums >> 8)
    pages[:, 1020:] = (checksums ^ 0xFFFFFFFF).astype(">u4").view(np.uint8).reshape(-1, 4)
    return pages.tobytes() + content[pages.size :]


def write_e57(path: Path, scans: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """Scans in their scanners' frames, float32, each with its (4, 4) pose."""
    import pye57
    from scipy.spatial.transform import Rotation

    with pye57.E57(str(path), mode="w") as file:
        for points, pose in zip(scans, poses, strict=True):
            columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            turn = np.array([w, x, y, z])
            file.write_scan_raw(columns, rotation=turn, translation=pose[:3, 3])
    return path


def write_depth_images(folder: Path, images: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """16-bit images with their poses and a camera in the 7-Scenes layout."""
    from PIL import Image

    for number, (image, pose) in enumerate(zip(images, poses, strict=True)):
        name = f"frame-{number:06d}"
        Image.fromarray(image.astype(np.uint16)).save(folder / f"{name}.depth.png")
        np.savetxt(folder / f"{name}.pose.txt", pose, fmt="%.17g")
    np.savetxt(folder / "camera-intrinsics.txt", [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    return folder / "frame-000000.depth.png"


def write_tum(path: Path, stamps: Sequence[float], poses: np.ndarray) -> Path:
    """Poses as lines stamp tx ty tz qx qy qz qw."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(path, np.c_[stamps, poses[:, :3, 3], turns], fmt="%.17g", header="stamp tx ty tz q")
    return path


class BagMaker:
    """Messages for ROS 1 and ROS 2, and the bags that hold them.

    Messages are (topic, kind, stamp [s], message); poses are (4, 4) world_from_sensor.
    """

    def __init__(self, is_ros1: bool) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.is_ros1 = is_ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        definitions = dict(LIVOX_TYPES)
        if is_ros1:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            definitions["tf2_msgs/msg/TFMessage"] = transforms
        for kind, definition in definitions.items():
            self.store.register(get_types_from_msg(definition, kind))

    def _make(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def header(self, stamp: float, frame: str) -> Any:
        """A header; ROS 1's has a number too."""
        whole = int(stamp)
        time = self._make("builtin_interfaces/msg/Time", whole, round((stamp - whole) * 1e9))
        return self._make("std_msgs/msg/Header", *([0] if self.is_ros1 else []), time, frame)

    def cloud(self, points: np.ndarray, stamp: float, frame: str = FRAME, topic: str = CLOUD_TOPIC):
        """A PointCloud2 of float32 x, y, z and an intensity."""
        content = np.c_[points, np.zeros(len(points))].astype("<f4").view(np.uint8).reshape(-1)
        fields = [
            self._make("sensor_msgs/msg/PointField", name, 4 * i, 7, 1)
            for i, name in enumerate(("x", "y", "z", "intensity"))
        ]
        size = (1, len(points)), (16, 16 * len(points))
        cloud = self._make(
            "sensor_msgs/msg/PointCloud2",
            self.header(stamp, frame), *size[0], fields, False, *size[1], content, True,
        )  # fmt: skip
        return topic, "sensor_msgs/msg/PointCloud2", stamp, cloud

    def laser(
        self,
        ranges: np.ndarray,
        stamp: float,
        angles: tuple[float, float] = (-np.pi, np.pi),
        limits: tuple[float, float] = (0.1, 10.0),
        topic: str = "/scan",
    ):
        """A LaserScan from the first to the last angle [rad], with range_min and range_max [m]."""
        kind = "sensor_msgs/msg/LaserScan"
        step = (angles[1] - angles[0]) / max(1, len(ranges) - 1)
        values = np.asarray(ranges, dtype=np.float32)
        nothing = np.empty(0, np.float32)
        scan = self._make(
            kind, self.header(stamp, FRAME), *angles, step, 0.0, 0.0, *limits, values, nothing
        )
        return topic, kind, stamp, scan

    def livox(self, points: np.ndarray, stamp: float, topic: str = "/livox/lidar"):
        """A CustomMsg of Livox's driver."""
        kind, whole = "livox_ros_driver2/msg/CustomMsg", round(stamp * 1e9)
        rows = [
            self._make(
                "livox_ros_driver2/msg/CustomPoint", 1000 * i, *map(float, row), 7, 16, i % 4
            )
            for i, row in enumerate(points)
        ]
        unused = np.zeros(3, np.uint8)
        header = self.header(stamp, FRAME)
        return topic, kind, stamp, self._make(kind, header, whole, len(rows), 1, unused, rows)

    def _parts(self, pose: np.ndarray, kind: str) -> Any:
        from scipy.spatial.transform import Rotation

        x, y, z = pose[:3, 3].tolist()
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        vector = "Point" if kind == "Pose" else "Vector3"
        return self._make(
            f"geometry_msgs/msg/{kind}",
            self._make(f"geometry_msgs/msg/{vector}", x, y, z),
            self._make("geometry_msgs/msg/Quaternion", *turn),
        )

    def pose(self, pose: np.ndarray, stamp: float, frame: str = "map", topic: str = "/pose"):
        """A PoseStamped."""
        kind = "geometry_msgs/msg/PoseStamped"
        return (
            topic,
            kind,
            stamp,
            self._make(kind, self.header(stamp, frame), self._parts(pose, "Pose")),
        )

    def odometry(
        self,
        pose: np.ndarray,
        stamp: float,
        child: str = FRAME,
        topic: str = POSE_TOPIC,
        frame: str = "odom",
    ):
        """An Odometry from frame to child."""
        nothing = self._make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self._make("geometry_msgs/msg/Twist", nothing, nothing)
        spread = np.zeros(36)
        kind = "nav_msgs/msg/Odometry"
        message = self._make(
            kind,
            self.header(stamp, frame),
            child,
            self._make("geometry_msgs/msg/PoseWithCovariance", self._parts(pose, "Pose"), spread),
            self._make("geometry_msgs/msg/TwistWithCovariance", twist, spread),
        )
        return topic, kind, stamp, message

    def transform(
        self, pose: np.ndarray, stamp: float, frames: tuple[str, str], topic: str = "/tf"
    ):
        """A TFMessage of one transform from frames[0] to frames[1], its child."""
        one = self._make(
            "geometry_msgs/msg/TransformStamped",
            self.header(stamp, frames[0]), frames[1], self._parts(pose, "Transform"),
        )  # fmt: skip
        kind = "tf2_msgs/msg/TFMessage"
        return topic, kind, stamp, self._make(kind, [one])

    def write(self, path: Path, messages: Sequence[Any], compression: str = "") -> Path:
        """A .bag, .db3 or .mcap at path; the file of a ROS 2 bag is taken out of its folder."""
        import rosbags.rosbag1 as ros1
        import rosbags.rosbag2 as ros2

        if self.is_ros1:
            writer = ros1.Writer(path)
            if compression:
                writer.set_compression(writer.CompressionFormat[compression.upper()])
        else:
            plugin = (
                ros2.StoragePlugin.MCAP if path.suffix == ".mcap" else ros2.StoragePlugin.SQLITE3
            )
            writer = ros2.Writer(path.with_suffix(""), version=9, storage_plugin=plugin)
            mode = {"": "NONE", "zstd": "STORAGE", "zstd-message": "MESSAGE"}[compression]
            writer.set_compression(ros2.CompressionMode[mode], ros2.CompressionFormat.ZSTD)
        pack = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        with writer:
            made: dict[str, Any] = {}
            for topic, kind, stamp, message in messages:
                if topic not in made:
                    made[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(made[topic], round(stamp * 1e9), pack(message, kind))
        if not self.is_ros1:
            next(path.with_suffix("").glob(f"*{path.suffix}")).rename(path)
        return path


def bag_messages(maker: BagMaker, scans: Sequence[np.ndarray], poses: np.ndarray) -> list[Any]:
    """Scans in their sensors' frames, one a second, each with an odometry at the same time."""
    messages = []
    for number, (points, pose) in enumerate(zip(scans, poses, strict=True)):
        messages.append(maker.odometry(pose, 100.0 + number))
        messages.append(maker.cloud(points, 100.0 + number))
    return messages
