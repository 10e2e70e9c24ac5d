"""Messages of bags that hold rays: LaserScan, Livox's CustomMsg, organized clouds, zeros."""

import numpy as np
import pytest
import torch
from drives import MOUNT, assert_rays, room_drive, write_bag

from lardhm_torch.io.notes import ScanReport
from lardhm_torch.io.scan_files import load_scans
from lardhm_torch.sampling import sample_rays
from lardhm_torch.simulation import true_ranges

pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")

ONE_OF_EACH = ["a.bag", "a.db3", "a.mcap"]
DRIVE = room_drive()
INF, NAN = np.inf, np.nan


def flat_poses(count: int) -> np.ndarray:
    """A laser that turns about the vertical axis, 0.3 m above the floor."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, (pose, angle) in enumerate(zip(poses, np.linspace(0, 2, count), strict=True)):
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = 1.5 + 0.5 * i, 1.9, 0.3
    return poses


def beams(angles: tuple[float, float], count: int) -> np.ndarray:
    """(count, 3) directions; the message holds its angles in float32."""
    first = float(np.float32(angles[0]))
    step = float(np.float32((angles[1] - angles[0]) / max(1, count - 1)))
    turn = first + step * np.arange(count)
    return np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("angles", [(-2.0, 2.0), (np.pi, -np.pi), (0.0, 6.2)])
def test_laser_scans_of_the_room_are_rays_in_its_plane(tmp_path, name, angles):
    poses, count = flat_poses(3), 90
    directions = np.concatenate([beams(angles, count) @ pose[:3, :3].T for pose in poses])
    starts = np.repeat(poses[:, :3, 3], count, axis=0)
    ranges = true_ranges(torch.as_tensor(starts), torch.as_tensor(directions)).numpy()
    ranges = ranges.astype(np.float32).astype(np.float64)
    is_return = ranges < 4.0
    assert 0 < is_return.sum() < len(ranges)
    assert np.isinf(ranges).any()  # through the doorway

    def messages(maker):
        yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, pose in enumerate(poses):
            yield maker.odometry(pose @ np.linalg.inv(MOUNT), 10.0 + number, child="base")
            seen = ranges[count * number : count * (number + 1)]
            yield maker.laser(seen, 10.0 + number, angles, limits=(0.1, 4.0))

    scans = load_scans(write_bag(tmp_path / name, messages))
    assert scans.num_scans == 3
    ends = starts + directions * np.minimum(ranges, 4.0)[:, None]
    np.testing.assert_allclose(scans.ends, ends, rtol=0, atol=1e-6)
    np.testing.assert_allclose(scans.ray_origins, starts, rtol=0, atol=1e-9)
    assert np.array_equal(scans.is_return, is_return)
    flat = scans.drop_constant_column()
    assert flat.dim == 2
    samples = sample_rays(flat, seed=0)
    assert int((samples.labels == 1).sum()) == is_return.sum()


@pytest.mark.parametrize(
    ("limits", "lengths", "returns", "num_invalid"),
    [
        ((0.5, 8.0), [1.0, 8.0, 8.0, 8.0, 0.5], [True, False, False, False, True], 4),
        ((0.0, 8.0), [1.0, 8.0, 8.0, 8.0, 0.2, 0.5], [1, 0, 0, 0, 1, 1], 3),
        ((0.5, INF), [1.0, 8.0, 9.0, 0.5], [True, True, True, True], 5),
    ],
)
def test_beams_without_return_and_invalid_beams_are_told_apart(
    tmp_path, limits, lengths, returns, num_invalid
):
    ranges = [1.0, INF, NAN, 8.0, 9.0, -INF, 0.0, 0.2, 0.5]

    def messages(maker):
        yield maker.pose(np.eye(4), 1.0)
        yield maker.laser(np.array(ranges), 1.0, (0.0, 1.0), limits)

    report = ScanReport()
    scans = load_scans(write_bag(tmp_path / "a.bag", messages), report=report)
    np.testing.assert_allclose(scans.ranges, lengths, atol=1e-6)
    assert scans.is_return.tolist() == [bool(value) for value in returns]
    assert f"{num_invalid} points left out: 0 0 0 or no valid range" in str(report)


def test_laser_scans_and_clouds_in_one_bag_are_told_apart_by_name(tmp_path):
    def messages(maker):
        for number, pose in enumerate(DRIVE.poses):
            yield maker.odometry(pose, 10.0 + number)
            yield maker.cloud(DRIVE.scans[number], 10.0 + number)
            yield maker.laser(np.ones(10), 10.0 + number)

    path = write_bag(tmp_path / "a.mcap", messages)
    with pytest.raises(ValueError, match=r"2 topics hold clouds .*: /points, /scan\. Name one"):
        load_scans(path)
    assert_rays(load_scans(path, topic="/points"), DRIVE)
    assert len(load_scans(path, topic="/scan")) == 30


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_livox_clouds_are_read_without_their_zeros(tmp_path, name):
    def messages(maker):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            yield maker.transform(pose, 10.0 + number, ("odom", "lidar"))
            with_zeros = np.insert(scan, [0, 7, len(scan)], 0.0, axis=0)
            yield maker.livox(with_zeros, 10.0 + number)

    report = ScanReport()
    assert_rays(load_scans(write_bag(tmp_path / name, messages), report=report), DRIVE)
    assert "rays from /livox/lidar (livox_ros_driver2/CustomMsg)" in str(report)
    assert "9 points left out: 0 0 0" in str(report)


@pytest.mark.parametrize("frame", ["l", "li", "lid", "lida", "livox_frame"])  # CDR pads strings
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_points_of_livox_are_what_rosbags_unpacks(tmp_path, name, frame):
    def messages(maker):
        yield maker.pose(np.eye(4), 10.0)
        topic, kind, stamp, cloud = maker.livox(DRIVE.scans[0], 10.0)
        cloud.header.frame_id = frame
        pack = maker.store.serialize_ros1 if maker.is_ros1 else maker.store.serialize_cdr
        unpack = maker.store.deserialize_ros1 if maker.is_ros1 else maker.store.deserialize_cdr
        seen.extend((p.x, p.y, p.z) for p in unpack(pack(cloud, kind), kind).points)
        yield topic, kind, stamp, cloud

    seen: list[tuple[float, float, float]] = []
    assert np.array_equal(load_scans(write_bag(tmp_path / name, messages)).ends, seen)


@pytest.mark.parametrize("cut", [1, 12, 400, 790])
def test_a_livox_cloud_that_is_cut_short_is_an_error(tmp_path, cut):
    from lardhm_torch.io.bag_chunks import Message
    from lardhm_torch.io.ros_clouds import read_cloud

    for is_ros1 in (True, False):
        content: list[bytes] = []

        def messages(maker, content=content):
            message = maker.livox(DRIVE.scans[0], 10.0)
            pack = maker.store.serialize_ros1 if maker.is_ros1 else maker.store.serialize_cdr
            content.append(bytes(pack(message[3], message[1])))
            yield message

        write_bag(tmp_path / f"{is_ros1}{'.bag' if is_ros1 else '.mcap'}", messages)
        kind = "livox_ros_driver2/CustomMsg"
        message = Message("/l", kind, 0, memoryview(content[0])[:-cut], is_ros1)
        with pytest.raises(ValueError, match=r"declares 40 points; got|ends before its header"):
            read_cloud(message, None)


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("row_step", ["row", "cloud", "zero", "points", "padded"])
def test_organized_clouds_are_read_whatever_their_row_step_says(tmp_path, name, row_step):
    height, width = 4, len(DRIVE.scans[0]) // 4

    def messages(maker):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            yield maker.transform(pose, 10.0 + number, ("odom", "lidar"))
            topic, kind, stamp, cloud = maker.cloud(scan, 10.0 + number)
            cloud.height, cloud.width = height, width
            row = width * cloud.point_step
            steps = {"row": row, "cloud": height * row, "zero": 0, "points": width}
            cloud.row_step = steps.get(row_step, row + 8)
            if row_step == "padded":
                rows = np.full((height, row + 8), 7, np.uint8)
                rows[:, :row] = cloud.data.reshape(height, row)
                cloud.data = rows.reshape(-1)
            yield topic, kind, stamp, cloud

    assert_rays(load_scans(write_bag(tmp_path / name, messages)), DRIVE)


@pytest.mark.parametrize("frame", ["lidar", "odom"])
def test_points_at_zero_are_no_points_in_any_frame(tmp_path, frame):
    def messages(maker):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            yield maker.transform(pose, 10.0 + number, ("odom", "lidar"))
            points = scan if frame == "lidar" else scan @ pose[:3, :3].T + pose[:3, 3]
            points = np.insert(points, [0, 5, 5, len(points)], 0.0, axis=0)
            yield maker.cloud(points, 10.0 + number, frame=frame)

    report = ScanReport()
    scans = load_scans(write_bag(tmp_path / "a.mcap", messages), report=report)
    assert_rays(scans, DRIVE, 2e-6)
    assert "12 points left out: 0 0 0" in str(report)
