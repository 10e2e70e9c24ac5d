"""The script that estimates poses with KISS-ICP: its files, and the odometry where it is installed."""

import numpy as np
import pytest
from drives import room_drive
from kiss_icp_poses import estimate_poses, scan_files, usable, write_poses

from lardhm_torch import load_scans

POSES = np.tile(np.eye(4), (2, 1, 1))
POSES[1, :3] = [[0, -1, 0, 1 / 3], [1, 0, 0, 2], [0, 0, 1, 1e-7]]


def test_written_poses_are_read_for_the_scans_beside_them(tmp_path):
    scan = np.random.default_rng(0).uniform(1, 5, (50, 3)).astype(np.float32)
    for name in ("b", "a"):
        np.c_[scan, np.zeros(50)].astype("<f4").tofile(tmp_path / f"{name}.bin")
    assert [path.name for path in scan_files(tmp_path)] == ["a.bin", "b.bin"]
    assert write_poses(tmp_path / "poses.txt", iter(POSES)) == 2
    scans = load_scans(tmp_path, poses_frame="lidar")  # names without numbers: lines in order
    np.testing.assert_allclose(scans.origins.numpy(), POSES[:, :3, 3], atol=1e-12)
    moved = scan.astype(float) @ POSES[1, :3, :3].T + POSES[1, :3, 3]
    np.testing.assert_allclose(scans.ends[50:].numpy(), moved, atol=1e-6)


def test_missing_returns_are_left_out():
    points = np.array([[0, 0, 0], [1, 0, 0], [np.nan, 1, 1], [0, 0, np.inf]], float)
    assert usable(points).tolist() == [[1, 0, 0]]


def test_a_folder_of_two_formats_is_refused(tmp_path):
    for name in ("a.bin", "b.pcd"):
        (tmp_path / name).touch()
    with pytest.raises(SystemExit, match=r"one format.*found \.bin, \.pcd"):
        scan_files(tmp_path)


def test_kiss_icp_follows_a_sensor_through_the_room():
    pytest.importorskip("kiss_icp", reason="kiss-icp is not installed (extra kiss-icp)")
    seen = room_drive(num_scans=25, num_rays=3000)
    first = np.linalg.inv(seen.poses[0])
    found = np.stack(list(estimate_poses(map(usable, seen.scans), max_range=10.0)))
    assert (
        np.linalg.norm((first @ seen.poses)[-1, :3, 3]) > 2.5
    )  # what not to move would be wrong by
    np.testing.assert_allclose(found[:, :3, 3], (first @ seen.poses)[:, :3, 3], atol=0.1)
