"""ROS bags to rays: which messages are the scans, and where the sensor stood."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.bag_files import Message, read_messages
from lardhm_torch.io.paths import natural_key
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.ros_messages import (
    CLOUD,
    POSE_OF,
    TRANSFORMS,
    cloud_points,
    frame_name,
    message_decoder,
    pose_row,
    stamp_and_frame,
)
from lardhm_torch.io.trajectories import (
    MAX_STAMP_GAP,
    move_points,
    poses_from_quaternions,
    trajectory_from,
)
from lardhm_torch.io.transforms import TransformTree


@dataclass(frozen=True)
class _Cloud:
    stamp: float  # [s]
    frame: str
    points: NDArray[np.float64]  # (n, 3), in that frame


@dataclass
class _PoseTopic:
    """The messages of one topic: where child was in frame."""

    frame: str
    child: str  # empty where the kind of message does not say
    stamps: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)  # x y z, qx qy qz qw


@dataclass
class _Bag:
    kinds: dict[str, str] = field(default_factory=dict)  # of each topic
    clouds: dict[str, list[_Cloud]] = field(default_factory=dict)
    poses: dict[str, _PoseTopic] = field(default_factory=dict)
    tree: TransformTree = field(default_factory=TransformTree)


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (folder / "metadata.yaml").is_file()


def read_bag(path: Path, topics: Sequence[str] = ()) -> Readout:
    """Each PointCloud2 message is a scan, its points moved by the pose at its stamp.

    The pose comes from tf, if the transforms from the cloud's frame up to its root, which is the
    world, change. If not, or if a pose topic is named: from the only topic of poses (PoseStamped,
    PoseWithCovarianceStamped, Odometry, TransformStamped), with tf between the frame it moves and
    the cloud's. If there is none, from tf that stands still. Clouds in the frame that the poses
    are in are in the world already, and the pose is their origin. Between two stamps poses are
    interpolated; clouds farther than 0.25 s from any pose are left out, with a warning. Motion
    within a scan is not undone.

    Args:
        path: a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.
        topics: the topic of the clouds, of the poses, or both; the rest is found if there is one.

    Raises:
        ValueError: the bag is damaged, has no clouds or no poses, or more than one topic of them.
        ImportError: rosbags is not installed.
    """
    bag = _Bag()
    decode = message_decoder(path)
    for file in _bag_files(path):
        for message in read_messages(file):
            _take_in(bag, message, topics, decode)
    unknown = [topic for topic in topics if topic not in bag.kinds]
    if unknown:
        raise ValueError(_topic_error(f"the name {unknown[0]}", [], bag))
    cloud_topics = _topics_of(bag, [CLOUD], topics)
    if len(cloud_topics) != 1:
        raise ValueError(_topic_error("PointCloud2", cloud_topics, bag))
    clouds = bag.clouds[cloud_topics[0]]
    poses, gaps = _world_from_clouds(bag, clouds, topics)
    placed = np.flatnonzero(gaps <= MAX_STAMP_GAP)
    if not len(placed):
        raise ValueError(
            f"a pose within {MAX_STAMP_GAP} s of a cloud is needed; the nearest is off by "
            f"{gaps.min():.3g} s"
        )
    if len(placed) < len(gaps):
        warnings.warn(
            f"{path}: {len(gaps) - len(placed)} of {len(gaps)} clouds are farther than "
            f"{MAX_STAMP_GAP} s from any pose and are left out",
            stacklevel=2,
        )
    ends = [move_points(poses[i, 0], clouds[i].points) for i in placed]
    if not any(map(len, ends)):
        raise ValueError("at least one point is needed; got none")
    return Readout(
        np.concatenate(ends),
        origins=poses[placed, 1, :3, 3],
        scan_id=np.repeat(np.arange(len(placed)), [len(points) for points in ends]),
    )


def _bag_files(path: Path) -> list[Path]:
    """The file itself, or the storage files of a ROS 2 bag's folder in natural order."""
    if not path.is_dir():
        return [path]
    files = sorted(path.iterdir(), key=lambda file: natural_key(file.name))
    storage = [file for file in files if file.suffix.lower() in (".db3", ".mcap")]
    if not storage:
        packed = any(file.suffix == ".zstd" for file in files)
        cure = ". Unpack it: zstd -d *.zstd" if packed else ""
        raise ValueError(f"a ROS 2 bag has a .db3 or .mcap file; this folder has none{cure}")
    return storage


def _take_in(bag: _Bag, message: Message, topics: Sequence[str], decode: Any) -> None:
    """Keep what of a message is needed to place clouds."""
    topic, kind = message.topic, message.kind
    bag.kinds[topic] = kind
    if kind in TRANSFORMS:
        for transform in decode(message).transforms:
            stamp, frame = stamp_and_frame(transform.header, 0.0)
            child = frame_name(transform.child_frame_id)
            is_fixed = topic.endswith("static")
            bag.tree.add(child, frame, None if is_fixed else stamp, pose_row(transform.transform))
    elif kind in POSE_OF:
        pose = decode(message)
        stamp, frame = stamp_and_frame(pose.header, message.stamp)
        child = frame_name(getattr(pose, "child_frame_id", ""))
        for name in POSE_OF[kind]:
            pose = getattr(pose, name)
        known = bag.poses.setdefault(topic, _PoseTopic(frame, child))
        known.stamps.append(stamp)
        known.rows.append(pose_row(pose))
    elif kind == CLOUD and _topics_of(bag, [CLOUD], topics) == [topic]:
        cloud = decode(message)
        clouds = bag.clouds.setdefault(topic, [])
        clouds.append(_Cloud(*stamp_and_frame(cloud.header, message.stamp), cloud_points(cloud)))


def _topics_of(bag: _Bag, kinds: Iterable[str], topics: Sequence[str]) -> list[str]:
    """The topics of some kinds: those that are named, or, if none of them is, all."""
    found = [topic for topic, kind in bag.kinds.items() if kind in kinds]
    return [topic for topic in found if topic in topics] or found


def _topic_error(what: str, found: list[str], bag: _Bag) -> str:
    if found:
        return (
            f"{len(found)} topics are {what}: {', '.join(sorted(found))}. Name one: "
            "load_scans(path, topic=...), --topic on the command line"
        )
    seen = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.kinds.items())[:12])
    return f"a topic of {what} is needed; got {seen or 'no message'}"


def _world_from_clouds(
    bag: _Bag, clouds: list[_Cloud], topics: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 2, 4, 4): what moves each cloud's points, and where its sensor stood; (n,) gaps [s]."""
    frame = clouds[0].frame
    others = sorted({cloud.frame for cloud in clouds} - {frame})
    if others:
        raise ValueError(f"all clouds must be in one frame; got {frame}, {', '.join(others)}")
    stamps = np.array([cloud.stamp for cloud in clouds])
    pose_topics = _topics_of(bag, POSE_OF, topics)
    is_named = any(topic in topics for topic in pose_topics)
    if not is_named and (bag.tree.moves(frame) or (not pose_topics and bag.tree.knows(frame))):
        poses, gaps = bag.tree.root_from(frame, stamps)
        return np.stack([poses, poses], axis=1), gaps
    if len(pose_topics) != 1:
        kinds = "poses (or tf of the clouds' frame)"
        raise ValueError(_topic_error(kinds, pose_topics, bag))
    topic = bag.poses[pose_topics[0]]
    rows = np.array(topic.rows)
    moving = trajectory_from(
        np.array(topic.stamps), poses_from_quaternions(rows[:, :3], rows[:, 3:])
    )
    poses, gaps = moving.at(stamps)
    if topic.frame == frame:
        return np.stack([np.tile(np.eye(4), (len(poses), 1, 1)), poses], axis=1), gaps
    if topic.child and topic.child != frame:
        mounted = bag.tree.between(topic.child, frame, stamps)
        if mounted is None:
            warnings.warn(
                f"tf does not connect {topic.child} of the poses with {frame} of the clouds: they "
                "are taken to be the same",
                stacklevel=3,
            )
        else:
            poses = poses @ mounted
    return np.stack([poses, poses], axis=1), gaps
