"""The ROS messages that hold rays: PointCloud2, LaserScan and Livox's CustomMsg."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.bag_chunks import Message
from lardhm_torch.io.channel_columns import CHANNEL_COLUMNS, channels_from_columns
from lardhm_torch.io.ros_messages import frame_name, stamp_and_frame

CLOUDS = (
    "sensor_msgs/PointCloud2",
    "sensor_msgs/LaserScan",
    "livox_ros_driver/CustomMsg",
    "livox_ros_driver2/CustomMsg",
    "livox_interfaces/CustomMsg",
)
_FLOATS = {7: "f4", 8: "f8"}  # PointField's numbers of FLOAT32 and FLOAT64
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", **_FLOATS}
_LIVOX_POINT = [("time", "u4"), ("xyz", "3f4"), ("rest", "3u1")]  # reflectivity, tag, line


@dataclass(frozen=True)
class Cloud:
    """The rays of one message, in the frame of its header.

    Args:
        stamp: of the header [s].
        recorded: when the message was recorded [ns].
        frame: which the points are in.
        points: (n, 3) ends of the rays [m].
        is_return: (n,) False where the beam met nothing up to its end; None: all met something.
        num_invalid: points or beams of the message that are none, and were left out.
        channels: (n, ...) values of the points by name, see `channel_columns`.
    """

    stamp: float
    recorded: int
    frame: str
    points: NDArray[np.float64]
    is_return: NDArray[np.bool_] | None = None
    num_invalid: int = 0
    channels: dict[str, NDArray] = field(default_factory=dict)


def read_cloud(message: Message, decode: Any) -> Cloud:
    """The rays of a message of one of the kinds CLOUDS.

    Points at exactly 0 0 0 are how drivers write "no return": they are left out and counted.

    Raises:
        ValueError: the message declares more than it holds.
    """
    seconds, channels = 1e-9 * message.recorded, dict[str, NDArray]()
    if message.kind.endswith("/CustomMsg"):
        stamp, frame, points = _livox_points(message)
        stamp = stamp or seconds
    else:
        content = decode(message)
        stamp, frame = stamp_and_frame(content.header, seconds)
        if message.kind.endswith("/LaserScan"):
            points, is_return, num_invalid = laser_points(content)
            return Cloud(stamp, message.recorded, frame, points, is_return, num_invalid)
        points, channels = cloud_points(content), cloud_channels(content)
    is_zero = points[:, 0] == 0
    if is_zero.any():
        is_zero &= ~points.any(axis=1)
        points = points[~is_zero]
        channels = {name: values[~is_zero] for name, values in channels.items()}
    return Cloud(stamp, message.recorded, frame, points, None, int(is_zero.sum()), channels)


def laser_points(
    scan: Any,
) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None, int]:
    """(n, 3) ray ends of a LaserScan, (n,) whether something is there, and beams left out.

    Ranges of +inf, of range_max and beyond are beams that met nothing: their rays end at range_max.
    NaN, -inf and ranges below range_min say nothing (REP 117) and are left out, as are beams
    without return if range_max is no distance.
    """
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    if not np.isfinite(angles).all():
        raise ValueError("a LaserScan must have finite angles; it does not")
    farthest = float(scan.range_max)
    is_return = ranges < farthest
    has_end = np.isfinite(farthest) and farthest > 0
    is_valid = (ranges >= max(scan.range_min, 0)) & (ranges > 0) & (is_return | has_end)
    lengths = np.minimum(ranges, farthest)[is_valid]
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    return (
        directions[is_valid] * lengths[:, None],
        is_return[is_valid],
        int(len(ranges) - is_valid.sum()),
    )


def cloud_points(cloud: Any) -> NDArray[np.float64]:
    """(n, 3) fields x, y, z of a PointCloud2."""
    fields = {f.name: f for f in cloud.fields if f.name in ("x", "y", "z")}
    if len(fields) != 3:
        raise ValueError(f"a cloud needs the fields x, y, z; got {', '.join(fields) or 'none'}")
    _row_step(cloud)  # refuses clouds that are too short before anything is allocated
    points = np.empty((cloud.height * cloud.width, 3))
    for column, name in enumerate(("x", "y", "z")):
        if fields[name].datatype not in _FLOATS:
            raise ValueError(f"field {name} must be float32 or float64; it is neither")
        points[:, column] = _field_values(cloud, fields[name])
    return points


def cloud_channels(cloud: Any) -> dict[str, NDArray]:
    """Fields rgb, rgba, intensity, label, ring and others of `channel_columns` of a PointCloud2."""
    fields = [f for f in cloud.fields if f.name in CHANNEL_COLUMNS and f.datatype in _NUMBERS]
    columns = {f.name: _field_values(cloud, f) for f in fields if getattr(f, "count", 1) <= 1}
    return channels_from_columns(columns)


def _field_values(cloud: Any, entry: Any) -> NDArray:
    """(n,) values of a field of a PointCloud2."""
    kind = np.dtype((">" if cloud.is_bigendian else "<") + _NUMBERS[entry.datatype])
    if entry.offset + kind.itemsize > cloud.point_step:
        raise _too_short(cloud)
    strides, shape = (_row_step(cloud), cloud.point_step), (cloud.height, cloud.width)
    if not cloud.height * cloud.width:
        return np.empty(0, kind.newbyteorder("="))
    values = np.ndarray(shape, kind, cloud.data, entry.offset, strides)
    return values.reshape(-1).astype(kind.newbyteorder("="))


def _row_step(cloud: Any) -> int:
    """Bytes from one row of a PointCloud2 to the next.

    Some drivers put the bytes of the whole cloud into row_step, others none: where the data is
    just as long as rows without padding are, they have none.
    """
    row_bytes, size = cloud.width * cloud.point_step, len(cloud.data)
    if not cloud.height * cloud.width:
        return row_bytes
    step = row_bytes if size == cloud.height * row_bytes else max(row_bytes, cloud.row_step)
    if cloud.height > 1 and cloud.row_step == cloud.height * row_bytes <= size:
        step = row_bytes
    if step * (cloud.height - 1) + row_bytes > size:
        raise _too_short(cloud)
    return step


def _too_short(cloud: Any) -> ValueError:
    return ValueError(
        f"a cloud declares {cloud.height} x {cloud.width} points of {cloud.point_step} bytes; "
        f"got {len(cloud.data)} bytes"
    )


def _livox_points(message: Message) -> tuple[float, str, NDArray[np.float64]]:
    """(stamp [s], frame, (n, 3) points) of a CustomMsg, whose points are too many for objects.

    Source: https://github.com/Livox-SDK/livox_ros_driver2 (msg/CustomMsg.msg, CustomPoint.msg).
    """
    content, at = message.content, 4
    if not message.is_ros1:  # behind four bytes that name the encoding, CDR aligns each value
        if bytes(content[:2]) != b"\0\1":
            raise ValueError(f"CDR must be little-endian; got {bytes(content[:4])!r}")
        content, at = content[4:], 0
    seconds, nanoseconds, length = _values(content, at, "iII")
    at += 12 + length
    frame = bytes(content[at - length : at]).rstrip(b"\0").decode("latin-1")
    at += 0 if message.is_ros1 else -at % 8
    (count,) = _values(content, at + 16, "I")  # behind timebase, point_num, lidar_id and rsvd[3]
    at += 20
    kind = np.dtype(_LIVOX_POINT).newbyteorder("<")
    size = kind.itemsize if message.is_ros1 else kind.itemsize + 1
    if count * size - (size - kind.itemsize) > len(content) - at:
        raise ValueError(f"a cloud declares {count} points; got {len(content) - at} bytes")
    points = np.ndarray(count, kind, content, at, (size,)) if count else np.empty(0, kind)
    stamp = seconds + 1e-9 * nanoseconds
    return stamp, frame_name(frame), points["xyz"].astype(np.float64).reshape(-1, 3)


def _values(content: memoryview, at: int, layout: str) -> tuple[Any, ...]:
    layout = "<" + layout
    if at + struct.calcsize(layout) > len(content):
        raise ValueError(f"a message of {len(content)} bytes ends before its header does")
    return struct.unpack_from(layout, content, at)
