"""Poses of a moving sensor, and interpolation between two stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_STAMP_GAP = 0.25  # [s] largest distance in time to the nearest pose
_ROWS = 4096  # moved at a time, which fit in the cache: three times as fast
STAMP_ROUNDING = 1e-3  # [s] stamps are often written in milliseconds


@dataclass(frozen=True)
class Trajectory:
    """Poses over time.

    Args:
        stamps: (L,) float64, strictly ascending [s].
        poses: (L, 4, 4) world_from_sensor.
    """

    stamps: NDArray[np.float64]
    poses: NDArray[np.float64]

    def at(self, stamps: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n, 4, 4) poses between the two nearest, and (n,) distances to the nearest stamp [s].

        Positions are interpolated linearly, rotations along the great circle. Before the first
        stamp and after the last one the distance is infinite: the motion there is not known.
        """
        from scipy.spatial.transform import Rotation, Slerp

        right = np.searchsorted(self.stamps, stamps).clip(max=len(self.stamps) - 1)
        gaps = np.minimum(
            abs(stamps - self.stamps[right]), abs(stamps - self.stamps[(right - 1).clip(min=0)])
        )
        is_outside = (stamps < self.stamps[0] - STAMP_ROUNDING) | (
            stamps > self.stamps[-1] + STAMP_ROUNDING
        )
        gaps = np.where(is_outside, np.inf, gaps)
        if len(self.stamps) == 1:
            return np.repeat(self.poses, len(stamps), axis=0), gaps
        # From the first stamp on: seconds since 1970 have a quarter of a microsecond left.
        times, wanted = self.stamps - self.stamps[0], stamps - self.stamps[0]
        wanted = wanted.clip(0, times[-1])
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        rotations = Rotation.from_matrix(self.poses[:, :3, :3])
        poses[:, :3, :3] = Slerp(times, rotations)(wanted).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(wanted, times, self.poses[:, axis, 3])
        return poses, gaps


def trajectory_from(stamps: NDArray[np.float64], poses: NDArray[np.float64]) -> Trajectory:
    """Poses in any order as a Trajectory; of two with one stamp the first is kept."""
    unique, first = np.unique(stamps, return_index=True)
    return Trajectory(unique, poses[first])


def move_points(pose: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) points of the sensor frame, moved into the world by a (4, 4) world_from_sensor."""
    moved, turn = np.empty(points.shape), np.ascontiguousarray(pose[:3, :3].T)
    for start in range(0, len(points), _ROWS):
        rows = slice(start, start + _ROWS)
        np.matmul(points[rows], turn, out=moved[rows])
        for axis in range(3):
            moved[rows, axis] += pose[axis, 3]
    return moved


def poses_from_quaternions(
    positions: NDArray[np.float64], quaternions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(L, 4, 4) from (L, 3) positions and (L, 4) quaternions x y z w of any length but 0.

    Raises:
        ValueError: a number is not finite, or a quaternion is 0.
    """
    from scipy.spatial.transform import Rotation

    lengths = np.linalg.norm(quaternions, axis=1)
    is_pose = np.isfinite(positions).all(axis=1) & np.isfinite(lengths) & (lengths > 1e-6)
    if not is_pose.all():
        raise ValueError(
            f"poses must be finite positions and quaternions x y z w, not all 0; "
            f"pose {int(np.argmin(is_pose))} is none"
        )
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    if len(positions):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def check_rigid(poses: NDArray[np.float64], name: str) -> None:
    """Raise a ValueError unless all (L, 4, 4) poses are a rotation and a finite position."""
    rigid = is_rigid(poses)
    if not rigid.all():
        raise ValueError(
            f"{name} must hold rotations and positions; line {int(np.argmin(rigid))} is none"
        )


def is_rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(L,) whether each of (L, 4, 4) poses is a rotation and a finite position."""
    rotations = poses[:, :3, :3]
    drift = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_finite = np.isfinite(poses).all(axis=(1, 2))
    return (drift < 1e-3) & (np.linalg.det(rotations) > 0) & is_finite
