"""The tree of frames that tf describes: each frame has one parent, some move."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.trajectories import poses_from_quaternions, trajectory_from


@dataclass
class _Edge:
    """parent_from_child over time; stamps None: it never changes."""

    parent: str
    stamps: list[float] | None
    rows: list[list[float]] = field(default_factory=list)  # x y z, qx qy qz qw


class TransformTree:
    """Frames by name, each with the transform to its parent."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, child: str, parent: str, stamp: float | None, row: list[float]) -> None:
        """Take in one transform x y z, qx qy qz qw; stamp None [s]: it holds for all times.

        Raises:
            ValueError: a frame gets a second parent.
        """
        edge = self._edges.setdefault(child, _Edge(parent, None if stamp is None else []))
        if edge.parent != parent:
            raise ValueError(f"frame {child} must have one parent; got {edge.parent} and {parent}")
        if stamp is None:
            edge.stamps, edge.rows = None, [row]
        elif edge.stamps is not None:
            edge.stamps.append(stamp)
            edge.rows.append(row)

    def knows(self, frame: str) -> bool:
        """Whether a frame has a parent."""
        return frame in self._edges

    def moves(self, frame: str) -> bool:
        """Whether something between a frame and its root changes over time."""
        return any(any(row != edge.rows[0] for row in edge.rows) for edge in self._above(frame))

    def root_from(
        self, frame: str, stamps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 4, 4) root_from_frame at (n,) stamps, and how far the nearest known ones are [s]."""
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        farthest = np.zeros(len(stamps))
        for edge in self._above(frame):
            rows = np.array(edge.rows)
            found = poses_from_quaternions(rows[:, :3], rows[:, 3:])
            if edge.stamps is not None:
                found, gaps = trajectory_from(np.array(edge.stamps), found).at(stamps)
                farthest = np.maximum(farthest, gaps)
            poses = found @ poses
        return poses, farthest

    def between(
        self, frame: str, other: str, stamps: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """(n, 4, 4) frame_from_other at (n,) stamps; None if no transforms connect them."""
        roots = [
            [name, *(edge.parent for edge in self._above(name))][-1] for name in (frame, other)
        ]
        if roots[0] != roots[1]:
            return None
        poses, _ = self.root_from(frame, stamps)
        return np.linalg.inv(poses) @ self.root_from(other, stamps)[0]

    def _above(self, frame: str) -> list[_Edge]:
        """The transforms from a frame up to its root."""
        seen, edges = {frame}, list[_Edge]()
        while frame in self._edges:
            edges.append(self._edges[frame])
            frame = edges[-1].parent
            if frame in seen:
                raise ValueError(f"frames must form a tree; {frame} is above itself")
            seen.add(frame)
        return edges
