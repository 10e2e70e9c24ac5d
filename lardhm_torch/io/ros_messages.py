"""The few ROS messages that hold poses, unpacked by rosbags (extra "io")."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lardhm_torch.io.bag_chunks import Message

TRANSFORMS = ("tf2_msgs/TFMessage", "tf/tfMessage")
POSE_OF = {  # where in a message of this kind the pose is
    "geometry_msgs/PoseStamped": ("pose",),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", "pose"),
    "nav_msgs/Odometry": ("pose", "pose"),
    "geometry_msgs/TransformStamped": ("transform",),
}


def message_decoder(path: Path) -> Any:
    """A function of a message that gives it as an object with the fields of its kind."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ImportError(
            f"{path} needs rosbags. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    if TRANSFORMS[0].replace("/", "/msg/") not in ros1.fielddefs:  # in no ROS 1 store so far
        definition = "geometry_msgs/TransformStamped[] transforms"
        ros1.register(get_types_from_msg(definition, TRANSFORMS[0].replace("/", "/msg/")))

    def decode(message: Message) -> Any:
        kind = "tf2_msgs/TFMessage" if message.kind in TRANSFORMS else message.kind
        kind, content = kind.replace("/", "/msg/"), bytes(message.content)
        if message.is_ros1:
            return ros1.deserialize_ros1(content, kind)
        return ros2.deserialize_cdr(content, kind)

    return decode


def frame_name(name: str) -> str:
    """A frame's name; ROS 1 once wrote a slash before it."""
    return str(name).lstrip("/")


def stamp_and_frame(header: Any, recorded: float) -> tuple[float, str]:
    """(stamp [s], frame) of a header; the time of recording stands in for a stamp of 0."""
    stamp = header.stamp.sec + 1e-9 * header.stamp.nanosec
    return stamp or recorded, frame_name(header.frame_id)


def pose_row(pose: Any) -> list[float]:
    """X y z, qx qy qz qw of a Pose or a Transform."""
    at = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
