"""Rays from ROS bags: messages that are scans, and their sensor positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.bag_files import BagParts, Message, bag_parts, read_messages
from lardhm_torch.io.bag_poses import CloudPoses, PoseSources, PoseTopic, cloud_poses
from lardhm_torch.io.channel_columns import joined_columns
from lardhm_torch.io.notes import Note
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.ros_clouds import CLOUDS, Cloud, read_cloud
from lardhm_torch.io.ros_messages import (
    POSE_OF,
    TRANSFORMS,
    frame_name,
    message_decoder,
    pose_row,
    stamp_and_frame,
)
from lardhm_torch.io.trajectories import MAX_STAMP_GAP, move_points
from lardhm_torch.io.transforms import TransformTree


@dataclass
class _Bag:
    kinds: dict[str, str] = field(default_factory=dict)  # of each topic
    clouds: dict[str, list[Cloud]] = field(default_factory=dict)
    poses: dict[str, PoseTopic] = field(default_factory=dict)
    tree: TransformTree = field(default_factory=TransformTree)
    num_messages: int = 0


def read_bag(
    path: Path,
    topics: Sequence[str] = (),
    poses_frame: str | None = None,
    sensor_frame: str | None = None,
) -> Readout:
    """Each PointCloud2, LaserScan or Livox CustomMsg is a scan, moved by the pose at its stamp.

    The pose comes from tf, if the transforms from the cloud's frame up to its root, which is the
    world, change. If not, or if a pose topic is named: from the only topic of poses (PoseStamped,
    PoseWithCovarianceStamped, Odometry, TransformStamped), with tf between the frame it moves and
    the cloud's. If there is none, from tf that stands still.

    Registered clouds, in a fixed frame such as odom or map, are in the world already; their rays
    start at the sensor, whose frame is the only one at the end of a branch of tf below, or that of
    the only topic of poses.

    Between two stamps poses are interpolated. Clouds before the first pose, after the last one or
    farther than 0.25 s from any are left out, with a warning. A transform that tf has once holds
    for all times. Motion within a scan is not undone. Scans are in the order of recording.

    Args:
        path: a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.
        topics: the topic of the clouds, of the poses, or both; the rest is found if there is one.
        poses_frame: the frame of tf whose poses the topic of poses holds, if it does not say so.
        sensor_frame: the frame of the sensor, if clouds are in another one.

    Raises:
        ValueError: the bag is damaged, has no clouds or no poses, or more than one topic of them.
        ImportError: rosbags is not installed.
    """
    parts = bag_parts(path)
    bag = _read_parts(parts, topics, message_decoder(path))
    unknown = [topic for topic in topics if topic not in bag.kinds]
    if unknown:
        raise ValueError(_topic_error(f"the name {unknown[0]}", [], bag))
    cloud_topics = _topics_of(bag, CLOUDS, topics)
    if len(cloud_topics) != 1:
        raise ValueError(
            _topic_error("clouds (PointCloud2, LaserScan, CustomMsg)", cloud_topics, bag)
        )
    clouds = sorted(bag.clouds[cloud_topics[0]], key=lambda cloud: cloud.recorded)
    frame = _common_frame(clouds)
    pose_topics = _topics_of(bag, POSE_OF, topics)
    sources = PoseSources(
        bag.tree,
        tuple(bag.poses[topic] for topic in pose_topics),
        any(topic in topics for topic in pose_topics),
        poses_frame,
        sensor_frame,
    )
    poses = cloud_poses(sources, frame, np.array([cloud.stamp for cloud in clouds]))
    if poses is None:
        kinds = f"poses (or tf of the clouds' frame {frame})"
        raise ValueError(_topic_error(kinds, pose_topics, bag))
    return _readout(clouds, poses, _bag_notes(parts, bag, cloud_topics[0]))


def _read_parts(parts: BagParts, topics: Sequence[str], decode: Any) -> _Bag:
    bag = _Bag()
    for file in parts.files:
        for message in read_messages(file):
            bag.num_messages += 1
            _take_in(bag, message, topics, decode)
    return bag


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
        stamp, frame = stamp_and_frame(pose.header, 1e-9 * message.recorded)
        child = frame_name(getattr(pose, "child_frame_id", ""))
        for name in POSE_OF[kind]:
            pose = getattr(pose, name)
        bag.poses.setdefault(topic, PoseTopic(topic, frame, child)).add(stamp, pose_row(pose))
    elif kind in CLOUDS and _topics_of(bag, CLOUDS, topics) == [topic]:
        bag.clouds.setdefault(topic, []).append(read_cloud(message, decode))


def _topics_of(bag: _Bag, kinds: Iterable[str], topics: Sequence[str]) -> list[str]:
    """The topics of some kinds: those that are named, or, if none of them is, all."""
    found = [topic for topic, kind in bag.kinds.items() if kind in kinds]
    return [topic for topic in found if topic in topics] or found


def _topic_error(what: str, found: list[str], bag: _Bag) -> str:
    if found:
        return (
            f"{len(found)} topics hold {what}: {', '.join(sorted(found))}. Name one: "
            "load_scans(path, topic=...), --topic on the command line"
        )
    seen = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.kinds.items())[:12])
    return f"a topic of {what} is needed; got {seen or 'no message'}"


def _common_frame(clouds: list[Cloud]) -> str:
    frames = sorted({cloud.frame for cloud in clouds})
    if len(frames) > 1:
        raise ValueError(f"all clouds must be in one frame; got {', '.join(frames)}")
    return frames[0]


def _bag_notes(parts: BagParts, bag: _Bag, topic: str) -> list[Note]:
    notes = [Note(f"rays from {topic} ({bag.kinds[topic]})")]
    notes += parts.notes
    if parts.num_messages is not None and parts.num_messages != bag.num_messages:
        text = f"messages, but metadata.yaml declares {parts.num_messages}"
        notes.append(Note(text, bag.num_messages, is_loss=True))
    ignored = bag.tree.num_ignored + sum(poses.num_ignored for poses in bag.poses.values())
    if ignored:
        notes.append(Note("poses ignored: not finite, without rotation or name", ignored))
    return notes


def _readout(clouds: list[Cloud], poses: CloudPoses, notes: list[Note]) -> Readout:
    """The rays of the clouds that have a pose."""
    is_placed = poses.gaps <= MAX_STAMP_GAP
    if not is_placed.any():
        nearest = poses.gaps.min()
        got = "all clouds are before the first or after the last one"
        if np.isfinite(nearest):
            got = f"the nearest is off by {nearest:.3g} s"
        raise ValueError(f"a pose within {MAX_STAMP_GAP} s of a cloud is needed; {got}")
    num_outside, num_far = np.isinf(poses.gaps).sum(), np.isfinite(poses.gaps[~is_placed]).sum()
    if num_outside:
        text = f"of {len(clouds)} clouds left out: before the first or after the last pose"
        notes.append(Note(text, int(num_outside), is_loss=True))
    if num_far:
        text = f"of {len(clouds)} clouds left out: farther than {MAX_STAMP_GAP} s from any pose"
        notes.append(Note(text, int(num_far), is_loss=True))
    placed = np.flatnonzero(is_placed)
    num_invalid = sum(clouds[i].num_invalid for i in placed)
    if num_invalid:
        notes.append(Note("points left out: 0 0 0 or no valid range", num_invalid))
    ends = [move_points(poses.world_from_cloud[i], clouds[i].points) for i in placed]
    if not any(map(len, ends)):
        raise ValueError("at least one point is needed; got none")
    return Readout(
        np.concatenate(ends),
        origins=poses.sensors[placed],
        scan_id=np.repeat(np.arange(len(placed)), [len(points) for points in ends]),
        is_return=_returns([clouds[i] for i in placed]),
        notes=(*notes, *poses.notes),
        channels=joined_columns([(clouds[i].channels, len(clouds[i].points)) for i in placed]),
        scan_times=np.array([clouds[i].stamp for i in placed]),
    )


def _returns(clouds: list[Cloud]) -> NDArray[np.bool_] | None:
    if all(cloud.is_return is None for cloud in clouds):
        return None
    return np.concatenate(
        [
            np.ones(len(cloud.points), bool) if cloud.is_return is None else cloud.is_return
            for cloud in clouds
        ]
    )
