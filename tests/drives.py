"""A lidar that drives through the simulated room: what the reader tests write into bags and folders."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from healthy_files import BagMaker
from scipy.spatial.transform import Rotation

from lardhm_torch.simulation import true_ranges

MOUNT = np.eye(4)  # of the lidar on the robot: ahead, up, turned by 90 degrees
MOUNT[:3] = [[0, -1, 0, 0.2], [1, 0, 0, 0.05], [0, 0, 1, 0.4]]


class Drive(NamedTuple):
    """Scans of a moving lidar; what is written is exact in float32."""

    poses: np.ndarray  # (S, 4, 4) world_from_lidar
    scans: list[np.ndarray]  # (n, 3) each, in the lidar's frame
    ends: np.ndarray  # (S n, 3), world frame

    @property
    def ray_origins(self) -> np.ndarray:
        counts = [len(scan) for scan in self.scans]
        return np.repeat(self.poses[:, :3, 3], counts, axis=0)

    @property
    def of_base(self) -> np.ndarray:
        """(S, 4, 4) poses of the robot that carries the lidar on MOUNT."""
        return self.poses @ np.linalg.inv(MOUNT)


def room_drive(num_scans: int = 3, num_rays: int = 40, seed: int = 0) -> Drive:
    """Beams in all directions from poses along a line through the room, with all axes turning."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (num_scans, 1, 1))
    along = np.linspace(0, 1, num_scans)
    poses[:, :3, 3] = [1.5, 1.9, 1.1] + along[:, None] * [2.5, 0.3, 0.2]
    turns = along[:, None] * [0.7, 0.1, -0.05] + [0.3, 0.05, 0.02]
    poses[:, :3, :3] = Rotation.from_euler("zyx", turns).as_matrix()
    scans, ends = [], []
    for pose in poses:
        beams = rng.normal(size=(num_rays, 3))
        beams /= np.linalg.norm(beams, axis=1, keepdims=True)
        starts = torch.as_tensor(np.tile(pose[:3, 3], (num_rays, 1)))
        ranges = true_ranges(starts, torch.as_tensor(beams @ pose[:3, :3].T)).numpy()
        points = (beams * np.where(np.isfinite(ranges), ranges, 3.0)[:, None]).astype(np.float32)
        scans.append(points.astype(np.float64))
        ends.append(scans[-1] @ pose[:3, :3].T + pose[:3, 3])
    return Drive(poses, scans, np.concatenate(ends))


def assert_rays(scans, drive: Drive, atol: float = 1e-6) -> None:
    """Every ray ends and starts where the drive says."""
    np.testing.assert_allclose(scans.ends.numpy(), drive.ends, rtol=0, atol=atol)
    np.testing.assert_allclose(scans.ray_origins.numpy(), drive.ray_origins, rtol=0, atol=atol)


def write_bag(path: Path, messages_of, compression: str = "") -> Path:
    """A bag of the messages that a function makes with a maker for its format."""
    maker = BagMaker(is_ros1=path.suffix == ".bag")
    return maker.write(path, list(messages_of(maker)), compression)
