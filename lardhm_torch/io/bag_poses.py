"""Sensor position of each cloud of a ROS bag: from tf, or from a topic of poses."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.trajectories import Trajectory, poses_from_quaternions, trajectory_from
from lardhm_torch.io.transforms import TransformTree, is_pose_row

# Static frames, by their usual names (REP 105, LOAM): map, odom, camera_init, my_world, ...
_FIXED = {"map", "odom", "odometry", "world", "earth", "utm", "enu", "ned", "init", "global"}


@dataclass
class PoseTopic:
    """The messages of one topic of poses: where child was in frame.

    Args:
        name: of the topic.
        frame: in which the poses are.
        child: of which the poses are; empty where the messages do not say.
        num_ignored: messages that hold no pose: a number that is not finite, a quaternion of zeros.
    """

    name: str
    frame: str
    child: str
    stamps: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)  # x y z, qx qy qz qw
    num_ignored: int = 0

    def add(self, stamp: float, row: list[float]) -> None:
        """Add one pose."""
        if not is_pose_row(row):
            self.num_ignored += 1
            return
        self.stamps.append(stamp)
        self.rows.append(row)

    def trajectory(self) -> Trajectory:
        """The poses in the order of time."""
        if not self.rows:
            raise ValueError(f"topic {self.name} must hold poses; it has none")
        rows = np.array(self.rows)
        poses = poses_from_quaternions(rows[:, :3], rows[:, 3:])
        return trajectory_from(np.array(self.stamps), poses)


@dataclass(frozen=True)
class CloudPoses:
    """For each of n clouds, its pose in the world and the position of its sensor.

    Args:
        world_from_cloud: (n, 4, 4) poses that move the points.
        sensors: (n, 3) positions of the sensor, world frame [m].
        gaps: (n,) distance to the nearest known pose [s]; infinite beyond the first and the last.
        notes: what was assumed.
    """

    world_from_cloud: NDArray[np.float64]
    sensors: NDArray[np.float64]
    gaps: NDArray[np.float64]
    notes: tuple[Note, ...]


@dataclass(frozen=True)
class PoseSources:
    """The poses in a bag, and the frames that the caller named.

    Args:
        tree: of tf.
        topics: of poses that may be used: one, or several that cannot be distinguished.
        is_named: whether the caller named the topic.
        poses_frame: of which frame the poses of the topic are, if the caller says it.
        sensor_frame: the frame of the sensor, if the caller says it.
    """

    tree: TransformTree
    topics: tuple[PoseTopic, ...] = ()
    is_named: bool = False
    poses_frame: str | None = None
    sensor_frame: str | None = None


def cloud_poses(sources: PoseSources, frame: str, stamps: NDArray[np.float64]) -> CloudPoses | None:
    """The poses of clouds in a frame at (n,) stamps [s]; None if nothing in the bag gives them.

    Raises:
        ValueError: frames are not connected, have two parents, or it is not clear which one to use.
    """
    tree = sources.tree
    for name in (sources.sensor_frame, sources.poses_frame):
        if name is not None and name not in tree.frames | {frame}:
            known = ", ".join(sorted(tree.frames)) or "none"
            raise ValueError(f"frame {name} must be a frame of tf; got {known}")
    if _is_fixed(sources, frame):
        return _seen_in_fixed_frame(sources, frame, stamps)
    is_known_to_tf = tree.has_parent(frame) and not sources.is_named
    if is_known_to_tf and (not sources.topics or tree.moves(frame)):
        poses = _by_tf(sources, frame, stamps)
    elif len(sources.topics) == 1:
        poses = _by_topic(sources, frame, stamps)
    else:
        return None
    return _seen_from_sensor(sources, frame, poses, stamps)


def _is_fixed(sources: PoseSources, frame: str) -> bool:
    """Whether clouds are in a fixed frame, as registered clouds are: no sensor is at its origin."""
    tree = sources.tree
    if sources.sensor_frame == frame:
        return False
    if _has_fixed_name(frame):
        return True
    if tree.has_parent(frame) and not sources.is_named and tree.moves(frame):
        return False
    if len(sources.topics) == 1 and sources.topics[0].frame == frame:
        return True
    is_root = not tree.has_parent(frame)
    return is_root and bool(_sensors_below(tree, frame)) and tree.has_moving_below(frame)


def _has_fixed_name(frame: str) -> bool:
    return not _FIXED.isdisjoint(_words(frame))


def _words(frame: str) -> list[str]:
    return re.split(r"[/_\-.\s]+", frame.lower())


def _sensors_below(tree: TransformTree, frame: str) -> list[str]:
    """Frames at the ends of the branches below a frame: one of them may be the sensor's."""
    return [name for name in tree.leaves(frame) if not _has_fixed_name(name)]


def _by_tf(sources: PoseSources, frame: str, stamps: NDArray[np.float64]) -> CloudPoses:
    """Clouds in their sensor's frame, moved by all transforms up to the root."""
    poses, gaps = sources.tree.root_from(frame, stamps)
    notes = [Note(f"poses of {frame} from tf")]
    if not sources.tree.moves(frame):
        cure = "" if sources.sensor_frame else f"sensor_frame='{frame}' confirms it"
        notes = [Note(f"{frame} never moves in tf: assumed to be static", cure=cure)]
    return CloudPoses(poses, poses[:, :3, 3], gaps, tuple(notes))


def _seen_from_sensor(
    sources: PoseSources, frame: str, poses: CloudPoses, stamps: NDArray[np.float64]
) -> CloudPoses:
    """The same, seen from the sensor where it is not at the origin of the clouds' frame.

    Drivers publish clouds in the sensor's frame; clouds in that of a robot's base were moved there.
    """
    below = _sensors_below(sources.tree, frame)
    is_base = "base" in _words(frame)
    sensor = sources.sensor_frame or (below[0] if is_base and len(below) == 1 else frame)
    if sensor == frame:
        if not below or sources.sensor_frame:
            return poses
        cure = f"sensor_frame='{frame}' confirms it; below it are {', '.join(below[:5])}"
        note = Note(f"sensor assumed to be at the origin of {frame}", cure=cure, is_loss=is_base)
        return replace(poses, notes=(*poses.notes, note))
    found = sources.tree.between(frame, sensor, stamps)
    if found is None:
        raise ValueError(f"tf must connect {frame} and {sensor}; it does not")
    cure = "" if sources.sensor_frame else f"sensor_frame='{sensor}' confirms it"
    note = Note(f"clouds are in {frame}; sensor assumed to be at {sensor}", cure=cure)
    positions = (poses.world_from_cloud @ found[0])[:, :3, 3]
    gaps = np.maximum(poses.gaps, found[1])
    return CloudPoses(poses.world_from_cloud, positions, gaps, (*poses.notes, note))


def _seen_in_fixed_frame(
    sources: PoseSources, frame: str, stamps: NDArray[np.float64]
) -> CloudPoses | None:
    """Points that lie in a fixed frame already, seen from the sensor's position in tf."""
    tree = sources.tree
    if not sources.is_named and (sources.sensor_frame or _sensors_below(tree, frame)):
        sensor, note = _sensor_below(sources, frame)
        found = tree.between(frame, sensor, stamps)
        if found is not None:
            world, gaps = tree.root_from(frame, stamps)
            positions = (world @ found[0])[:, :3, 3]
            return CloudPoses(world, positions, np.maximum(gaps, found[1]), (note,))
    if len(sources.topics) == 1:
        return _seen_by_topic(sources, frame, stamps)
    if sources.topics:
        return None
    raise ValueError(
        f"clouds are in {frame}, a fixed frame: the sensor position must come from tf or a topic "
        f'of poses, and neither gives it. If {frame} is the sensor\'s: sensor_frame="{frame}"'
    )


def _seen_by_topic(
    sources: PoseSources, frame: str, stamps: NDArray[np.float64]
) -> CloudPoses | None:
    """The same by a topic of poses."""
    topic = sources.topics[0]
    world = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps))
    if topic.frame and topic.frame != frame:
        connected = sources.tree.between(topic.frame, frame, stamps)
        if connected is None:
            raise ValueError(
                f"clouds are in {frame}, a fixed frame, and poses of {topic.name} in "
                f"{topic.frame}; tf must connect the two, and does not"
            )
        world = connected
    poses, gaps = topic.trajectory().at(stamps)
    mount, mount_gaps, note = _mount_below(sources, topic, stamps)
    gaps = np.maximum(np.maximum(gaps, world[1]), mount_gaps)
    notes = (Note(f"clouds are in the fixed frame {frame}"), note)
    return CloudPoses(world[0], (poses @ mount)[:, :3, 3], gaps, notes)


def _mount_below(
    sources: PoseSources, topic: PoseTopic, stamps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], Note]:
    """Pose of the sensor in the frame of a pose topic."""
    child = sources.poses_frame or topic.child or _only_base(sources.tree)
    nowhere = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps))
    if not child or child not in sources.tree.frames:
        cure = f"poses_frame names the frame of {topic.name}" if sources.tree.frames else ""
        text = f"sensor at the poses of {topic.name}"
        return *nowhere, Note(text, cure=cure, is_loss=bool(cure))
    if sources.sensor_frame is None and not _sensors_below(sources.tree, child):
        return *nowhere, Note(f"sensor at {child}, by the poses of {topic.name}")
    sensor, note = _sensor_below(sources, child)
    found = sources.tree.between(child, sensor, stamps)
    if found is None:
        raise ValueError(f"tf must connect {child} and {sensor}; it does not")
    return *found, note


def _only_base(tree: TransformTree) -> str:
    """The frame that carries the only sensor of tf; empty where there are none, or several."""
    bases = [root for root in tree.roots if not _has_fixed_name(root)]
    is_clear = len(bases) == 1 and len(_sensors_below(tree, bases[0])) == 1
    return bases[0] if is_clear and not tree.has_moving_below(bases[0]) else ""


def _sensor_below(sources: PoseSources, frame: str) -> tuple[str, Note]:
    """The frame of the sensor: as the caller says, or the only one at the end of a branch."""
    if sources.sensor_frame is not None:
        return sources.sensor_frame, Note(f"sensor at {sources.sensor_frame}, as given")
    candidates = _sensors_below(sources.tree, frame)
    if len(candidates) > 1:
        raise ValueError(
            f"clouds are in {frame}, which is not the sensor's frame; the sensor may be any of "
            f'{", ".join(candidates)}. Name it: load_scans(path, sensor_frame="{candidates[0]}"), '
            "--sensor-frame on the command line"
        )
    cure = f"sensor_frame='{candidates[0]}' confirms it"
    return candidates[0], Note(
        f"clouds are in {frame}; sensor assumed to be at {candidates[0]}", cure=cure
    )


def _by_topic(sources: PoseSources, frame: str, stamps: NDArray[np.float64]) -> CloudPoses:
    """Clouds in their sensor's frame, moved by a topic of poses and by the sensor's mount."""
    tree, topic = sources.tree, sources.topics[0]
    poses, gaps = topic.trajectory().at(stamps)
    notes = [Note(f"poses from {topic.name}")]
    child = sources.poses_frame or topic.child
    if not child:
        child = tree.carrier(frame)
        if child != frame:
            notes.append(
                Note(
                    f"{topic.name} does not name the frame of its poses: assumed to be {child}",
                    cure=f"poses_frame='{child}' confirms it, poses_frame='{frame}' ignores the mount",
                )
            )
    if child != frame:
        mount = tree.between(child, frame, stamps)
        if mount is None:
            notes.append(
                Note(
                    f"tf does not connect {child} of the poses with {frame} of the clouds: they are "
                    "assumed to be the same",
                    cure=f"poses_frame='{frame}' confirms it",
                    is_loss=True,
                )
            )
        else:
            poses, gaps = poses @ mount[0], np.maximum(gaps, mount[1])
            notes.append(Note(f"mount of {frame} on {child} from tf"))
    return CloudPoses(poses, poses[:, :3, 3], gaps, tuple(notes))
