"""Pose files beside scans, and the frame of points that do not say it."""

import numpy as np
import pytest
from healthy_files import write_tum
from hypothesis import given, settings
from hypothesis import strategies as st
from scan_files import (
    pcd_header,
    real_scans,
    some_points,
    turning_poses,
    write_by_hand,
    write_kitti,
    write_poses,
)

from lardhm_torch.io.pose_files import read_trajectory
from lardhm_torch.io.scan_files import load_scans
from lardhm_torch.io.trajectories import Trajectory

STAMPS = 1.7e9 + np.arange(3)


def write_sensor_scans(folder, stems, points, poses):
    """PLY scans, their points moved from the world into their sensors' frames."""
    for stem, pose in zip(stems, poses, strict=True):
        sensor = (points - pose[:3, 3]) @ pose[:3, :3]
        write_by_hand(folder, "ply-little", sensor).rename(folder / f"{stem}.ply")


def test_tum_poses_come_back_as_they_were_written(data, tmp_path):
    poses = real_scans(data, "sevenscenes_rgbd")["poses"]
    stamps = 1.7e9 + 0.1 * np.arange(len(poses))
    shuffled = np.random.default_rng(0).permutation(len(poses))
    write_tum(tmp_path / "poses.txt", stamps[shuffled], poses[shuffled])
    trajectory = read_trajectory(tmp_path / "poses.txt")
    assert np.array_equal(trajectory.stamps, stamps)
    assert np.allclose(trajectory.poses, poses, atol=3e-4)  # the stored ones are no exact rotations


@settings(deadline=None)
@given(share=st.floats(0, 1), angle=st.floats(-3, 3), start=st.sampled_from([0.0, 1.7e9]))
def test_between_two_stamps_a_pose_moves_and_turns_evenly(share, angle, start):
    poses = turning_poses(2)
    cos, sin = np.cos(angle), np.sin(angle)
    poses[1, :2, :2] = [[cos, -sin], [sin, cos]]
    found, gaps = Trajectory(start + np.array([0.0, 4.0]), poses).at(np.array([start + 4 * share]))
    turned = share * angle
    assert np.allclose(found[0, 0, :2], [np.cos(turned), -np.sin(turned)], atol=1e-6)
    assert np.allclose(found[0, :3, 3], [share, 2 * share, 0.5], atol=1e-6)
    assert gaps[0] == pytest.approx(4 * min(share, 1 - share), abs=1e-6)


def test_outside_its_stamps_a_trajectory_knows_nothing():
    poses = turning_poses(3)
    found, gaps = Trajectory(np.array([1.0, 2.0, 3.0]), poses).at(
        np.array([0.5, 0.9995, 1, 2, 3, 3.0005, 5])
    )
    assert np.allclose(found[1:6], poses[[0, 0, 1, 2, 2]])
    assert np.allclose(gaps, [np.inf, 5e-4, 0, 0, 0, 5e-4, np.inf])  # stamps are rounded to 1 ms
    found, gaps = Trajectory(np.array([1.0]), poses[1:2]).at(np.array([0.5, 1]))
    assert np.array_equal(found, poses[[1, 1]])
    assert gaps.tolist() == [np.inf, 0]


@pytest.mark.parametrize(
    "stems",
    [
        [f"{stamp:.3f}" for stamp in STAMPS],
        [str(int(stamp) * 10**9) for stamp in STAMPS],
        [str(int(stamp) * 10**6) for stamp in STAMPS],
        ["a", "b", "c"],
        ["000007", "000008", "000009"],
    ],
)
def test_tum_lines_follow_stamps_in_the_names_or_their_order(tmp_path, stems):
    poses, points = turning_poses(3), some_points()
    write_kitti(tmp_path, stems, points, poses)
    write_tum(tmp_path / "poses.txt", STAMPS, poses)
    scans = load_scans(tmp_path)
    assert np.allclose(scans.origins, poses[:, :3, 3])
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-5)


def test_more_tum_lines_than_scans_are_told_apart_by_the_stamps(tmp_path):
    poses = turning_poses(3)
    write_kitti(tmp_path, [f"{STAMPS[1] + 0.1:.3f}"], some_points(), poses[1:2])
    write_tum(tmp_path / "groundtruth.txt", STAMPS, poses)
    expected = 0.9 * poses[1, :3, 3] + 0.1 * poses[2, :3, 3]
    assert np.allclose(load_scans(tmp_path).origins, expected, atol=1e-6)
    (file,) = tmp_path.glob("*.bin")
    file.rename(tmp_path / f"{STAMPS[0] - 9:.3f}.bin")
    with pytest.raises(
        ValueError, match=r"has none for 1699999991\.000\.bin .* are 1700000000\.000"
    ):
        load_scans(tmp_path)


@pytest.mark.parametrize("layout", ["kitti", "tum"])
def test_scans_in_the_sensors_frame_are_moved_by_the_poses(data, tmp_path, layout):
    arrays = real_scans(data, "kitti00_mulls")
    points, poses = arrays["points"][::2000].astype(np.float64), arrays["poses"]
    write_sensor_scans(tmp_path, ["0", "1", "2", "3"], points, poses)
    if layout == "kitti":
        write_poses(tmp_path / "poses.txt", poses)
    else:
        write_tum(tmp_path / "poses.txt", [0.0, 1.0, 2.0, 3.0], poses)
    scans = load_scans(tmp_path, frame="sensor")
    # The stored rotations drift by 1e-6, and a quaternion has no drift.
    assert np.allclose(scans.ends, np.tile(points, (4, 1)), rtol=0, atol=2e-4)
    assert np.allclose(scans.origins, poses[:, :3, 3])


def test_scans_in_the_world_take_only_their_origins_from_the_poses(tmp_path):
    points, poses = some_points(), turning_poses(2)
    for stem in ("a", "b"):
        write_by_hand(tmp_path, "xyz-spaces", points).rename(tmp_path / f"{stem}.xyz")
    write_poses(tmp_path / "poses.txt", poses)
    scans = load_scans(tmp_path, frame="world")
    assert np.array_equal(scans.ends, np.tile(points, (2, 1)))
    assert np.array_equal(scans.origins, poses[:, :3, 3])
    with pytest.raises(ValueError, match=r'poses\.txt.* frame="sensor" or frame="world"'):
        load_scans(tmp_path)


def test_the_viewpoint_of_a_pcd_moves_points_of_the_sensors_frame(data, tmp_path):
    arrays = real_scans(data, "la3dm_sim_structured")
    points = arrays["points"][arrays["scan_id"] == 0].astype(np.float64)
    half = np.sqrt(0.5)  # a quarter turn about z
    content = pcd_header("binary", len(points), viewpoint=f"1 2 3 {half} 0 0 {half}")
    (tmp_path / "scan.pcd").write_bytes(content + points.tobytes())
    scans = load_scans(tmp_path / "scan.pcd", frame="sensor")
    turned = np.c_[-points[:, 1], points[:, 0], points[:, 2]] + [1, 2, 3]
    assert np.allclose(scans.ends, turned, rtol=0, atol=1e-12)
    assert scans.origins.tolist() == [[1, 2, 3]]
    in_world = load_scans(tmp_path / "scan.pcd", frame="world")
    assert np.array_equal(in_world.ends, points)


def test_a_frame_without_a_pose_or_of_a_format_that_says_it_is_an_error(tmp_path):
    path = write_by_hand(tmp_path, "ply-little", some_points())
    with pytest.raises(ValueError, match=r'frame="sensor" needs a pose .* poses\.txt'):
        load_scans(path, frame="sensor")
    with pytest.raises(ValueError, match="must contain the sensor position"):
        load_scans(path, frame="world")
    write_kitti(tmp_path / "kitti", ["0"], some_points(), np.eye(4)[None])
    with pytest.raises(ValueError, match=r'frame="world" is for \.ply .*state their frame'):
        load_scans(tmp_path / "kitti", origin=(0, 0, 0), frame="world")
    with pytest.raises(ValueError, match=r'frame must be "sensor", "world" or None; got \'map\''):
        load_scans(path, frame="map")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "12 numbers a line .* or 8 .*; got 0"),
        ("# nothing\n", "got 0"),
        ("1 2 3\n", "got 3"),
        ("0 0 0 0 0 0 0 1\n1 0 0\n", "must have 8 numbers a line"),
        ("0 0 0 0 0 0 0 0\n", "quaternions x y z w that are not all 0; no line does"),
        ("0 0 0 nan 0 0 0 1\n", "finite numbers, .*; no line does"),
        ("inf 0 0 0 0 0 0 1\n", "finite numbers, .*; no line does"),
        ("nan " * 12 + "\n", "finite poses; no line does"),
        ("1.5 1 0 0 0 0 1 0 0 0 0 1 0\n", "begin its lines of 13 numbers with the number of a"),
        ("0 1 2 3\n", "LAS files with GPS times"),
    ],
)
def test_broken_pose_files_say_what_is_wrong(tmp_path, content, message):
    write_kitti(tmp_path, ["0"], some_points(), np.eye(4)[None])
    (tmp_path / "poses.txt").write_text(content)
    with pytest.raises(ValueError, match=rf"0\.bin cannot be read: .*poses\.txt.*{message}"):
        load_scans(tmp_path)
