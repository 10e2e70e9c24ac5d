"""KITTI scans and their poses."""

import numpy as np
import pytest
from scan_files import real_scans, some_points, turning_poses, write_kitti, write_poses

from lardhm_torch.io.scan_files import load_scans


@pytest.mark.parametrize("where", ["beside", "above"])
def test_real_kitti_scans_come_back_from_their_sensor_frames(data, tmp_path, where):
    arrays = real_scans(data, "kitti00_mulls")
    points = arrays["points"][::500].astype(np.float64)
    folder = tmp_path / "velodyne"
    write_kitti(folder, ["000000", "000005", "000010", "000015"], points, arrays["poses"])
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[::5] = arrays["poses"]
    write_poses((folder if where == "beside" else tmp_path) / "poses.txt", poses)
    scans = load_scans(folder)
    assert np.array_equal(scans.origins, arrays["poses"][:, :3, 3])
    assert scans.num_scans == 4
    # float32 in the sensor frame, up to 50 m away: 4e-6 m; the stored rotations drift by 1e-6
    assert np.allclose(scans.ends.reshape(4, -1, 3), points, rtol=0, atol=1e-4)


def test_poses_follow_the_order_of_names_that_are_no_line_numbers(tmp_path):
    poses, points = turning_poses(3), some_points()
    write_kitti(tmp_path, ["scan_2", "scan_9", "scan_10"], points, poses)
    write_poses(tmp_path / "poses.txt", poses)
    scans = load_scans(tmp_path)
    assert np.array_equal(scans.origins, poses[:, :3, 3])
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-6)
    assert load_scans(tmp_path / "scan_9.bin").origins.tolist() == [poses[1, :3, 3].tolist()]


def test_numbers_past_the_last_pose_mean_order(tmp_path):
    poses = turning_poses(2)
    write_kitti(tmp_path, ["100", "101"], some_points(), poses)
    write_poses(tmp_path / "poses.txt", poses)
    assert np.array_equal(load_scans(tmp_path).origins, poses[:, :3, 3])


def test_new_poses_are_seen_at_once(tmp_path):
    poses = turning_poses(2)
    write_kitti(tmp_path, ["0", "1"], some_points(), poses)
    for shift in (0, 10, 20):
        poses[:, 0, 3] += shift
        (tmp_path / "poses.txt").unlink(missing_ok=True)
        write_poses(tmp_path / "poses.txt", poses)
        assert np.array_equal(load_scans(tmp_path).origins, poses[:, :3, 3])


def test_camera_poses_become_laser_poses_by_the_calibration(tmp_path):
    points, laser = some_points(), turning_poses(3)
    camera_from_laser = np.eye(4)
    camera_from_laser[:3] = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3]]
    camera = camera_from_laser @ laser @ np.linalg.inv(camera_from_laser)
    write_kitti(tmp_path / "velodyne", ["0", "1", "2"], points, laser)
    write_poses(tmp_path / "poses.txt", camera)
    rows = " ".join(map(repr, camera_from_laser[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 2 3\nTr: {rows}\n")
    scans = load_scans(tmp_path / "velodyne")
    assert np.allclose(scans.origins, laser[:, :3, 3])
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-6)


def test_without_poses_a_kitti_scan_is_taken_as_it_is_from_a_given_origin(tmp_path):
    points = some_points().astype(np.float32)
    write_kitti(tmp_path, ["0"], points, np.eye(4)[None])
    assert np.array_equal(load_scans(tmp_path, origin=(0, 0, 0)).ends, points)
    with pytest.raises(
        ValueError, match=r"0\.bin must contain the sensor position.*Put its poses\.txt beside it"
    ):
        load_scans(tmp_path)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "2 lines for 3 scans, a to c"),
        ("1 0 0 0\n" * 3, "poses.txt must have 12 numbers a line"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n" * 3, "rotations and positions; line 0 is none"),
        ("1 0 0 0 0 1 0 0 0 0 1 nan\n" * 3, "must hold finite poses; no line does"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n" * 3, "rotations and positions; line 0 is none"),
    ],
)
def test_poses_that_cannot_be_right_are_an_error(tmp_path, poses, message):
    write_kitti(tmp_path, ["a", "b", "c"], some_points(), turning_poses(3))
    (tmp_path / "poses.txt").write_text(poses)
    with pytest.raises(ValueError, match=message):
        load_scans(tmp_path)
