"""The tree of frames that tf describes: each frame has one parent; some frames move."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.trajectories import poses_from_quaternions, trajectory_from


@dataclass
class _Edge:
    """parent_from_child over time."""

    parent: str
    stamps: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)  # x y z, qx qy qz qw
    is_static: bool = False

    @property
    def moves(self) -> bool:
        """Whether the transform changes; one that never does is valid at all times."""
        return not self.is_static and any(row != self.rows[0] for row in self.rows)

    def at(self, stamps: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 4, 4) parent_from_child at (n,) stamps, and (n,) distances to known ones [s]."""
        rows = np.array(self.rows if self.moves else self.rows[-1:])
        poses = poses_from_quaternions(rows[:, :3], rows[:, 3:])
        if not self.moves:
            return np.repeat(poses, len(stamps), axis=0), np.zeros(len(stamps))
        return trajectory_from(np.array(self.stamps), poses).at(stamps)


class TransformTree:
    """Frames by name, each with the transform to its parent.

    A frame that was published with two parents is an error only where a transform through it is
    asked for. As in tf2, transforms that are no rotation or have no names are ignored.
    """

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, _Edge]] = {}
        self.num_ignored = 0

    def add(self, child: str, parent: str, stamp: float | None, row: list[float]) -> None:
        """Add one transform x y z, qx qy qz qw; stamp None [s]: it holds for all times."""
        if not child or not parent or child == parent or not is_pose_row(row):
            self.num_ignored += 1
            return
        edge = self._edges.setdefault(child, {}).setdefault(parent, _Edge(parent))
        if stamp is None:
            edge.is_static, edge.rows = True, [row]
        elif not edge.is_static:
            edge.stamps.append(stamp)
            edge.rows.append(row)

    @property
    def frames(self) -> set[str]:
        """All frames that have a parent or a child."""
        return set(self._edges).union(*self._edges.values())

    @property
    def roots(self) -> list[str]:
        """The frames without a parent, sorted by name."""
        return sorted(self.frames - set(self._edges))

    def has_parent(self, frame: str) -> bool:
        """Whether a frame has a parent."""
        return frame in self._edges

    def moves(self, frame: str) -> bool:
        """Whether a transform between a frame and its root changes over time."""
        return any(edge.moves for edge in self._above(frame))

    def carrier(self, frame: str) -> str:
        """The topmost frame that a frame is rigidly mounted on, possibly itself."""
        for edge in self._above(frame):
            if edge.moves:
                break
            frame = edge.parent
        return frame

    def below(self, frame: str) -> list[str]:
        """All frames below a frame, sorted by name."""
        found, waiting = set[str](), {frame}
        while waiting:
            parents, waiting = waiting, set()
            for child, edges in self._edges.items():
                if child not in found and child != frame and not parents.isdisjoint(edges):
                    waiting.add(child)
            found |= waiting
        return sorted(found)

    def leaves(self, frame: str) -> list[str]:
        """The frames below a frame that have no child, sorted by name."""
        parents = {parent for edges in self._edges.values() for parent in edges}
        return [name for name in self.below(frame) if name not in parents]

    def has_moving_below(self, frame: str) -> bool:
        """Whether a frame moves relative to the given one, which is above it."""
        return any(edge.moves for name in self.below(frame) for edge in self._edges[name].values())

    def root_from(
        self, frame: str, stamps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 4, 4) root_from_frame at (n,) stamps, and how far the nearest known ones are [s].

        Raises:
            ValueError: a frame above has two parents, or is above itself.
        """
        return _chained(self._above(frame), stamps)

    def between(
        self, frame: str, other: str, stamps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """The same for frame_from_other; None if no transforms connect the two.

        Raises:
            ValueError: they might be connected through a frame that has two parents.
        """
        above = [self._above(name, is_lenient=True) for name in (frame, other)]
        names = [
            [name, *(edge.parent for edge in edges)]
            for name, edges in zip((frame, other), above, strict=True)
        ]
        common = next((name for name in names[0] if name in names[1]), None)
        if common is None:
            for name in (frame, other):
                self._above(name)  # raises if a frame with two parents ended the way up
            return None
        paths = [e[: n.index(common)] for e, n in zip(above, names, strict=True)]
        (left, left_gaps), (right, right_gaps) = (_chained(path, stamps) for path in paths)
        return np.linalg.inv(left) @ right, np.maximum(left_gaps, right_gaps)

    def _above(self, frame: str, is_lenient: bool = False) -> list[_Edge]:
        """The transforms from a frame up to its root, or up to the first frame with two parents."""
        seen, edges = {frame}, list[_Edge]()
        while frame in self._edges:
            if len(self._edges[frame]) > 1:
                if is_lenient:
                    break
                raise ValueError(
                    f"frame {frame} must have one parent; got "
                    f"{' and '.join(sorted(self._edges[frame]))}. Name a topic of poses instead: "
                    "load_scans(path, topic=...), --topic on the command line"
                )
            (edge,) = self._edges[frame].values()
            edges.append(edge)
            frame = edge.parent
            if frame in seen:
                raise ValueError(f"frames must form a tree; {frame} is above itself")
            seen.add(frame)
        return edges


def is_pose_row(row: list[float]) -> bool:
    """Whether x y z, qx qy qz qw are finite and the quaternion is not 0."""
    return all(map(math.isfinite, row)) and math.hypot(*row[3:]) > 1e-6


def _chained(
    edges: list[_Edge], stamps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 4, 4) poses of a frame in the frame above all edges, and the largest gaps [s]."""
    poses, farthest = np.tile(np.eye(4), (len(stamps), 1, 1)), np.zeros(len(stamps))
    for edge in edges:
        found, gaps = edge.at(stamps)
        poses, farthest = found @ poses, np.maximum(farthest, gaps)
    return poses, farthest
