"""Where the sensor stood for each cloud of a bag: frames, mounts and times."""

import numpy as np
import pytest
from drives import MOUNT, assert_rays, room_drive, write_bag

from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import load_scans

pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")

ONE_OF_EACH = ["a.bag", "a.db3", "a.mcap"]
DRIVE = room_drive()


def drift(number: int) -> np.ndarray:
    """map_from_odom, corrected a little with every scan."""
    pose = np.eye(4)
    pose[:3, 3] = 0.5 + 0.01 * number, 0.02 * number, 0
    return pose


def registered(maker, fixed="odom", sensor_links=("lidar",), mount=MOUNT):
    """Clouds in a fixed frame below the map; the base moves in it and carries sensors."""
    for link in sensor_links:
        pose = mount if link == "lidar" else np.eye(4)
        yield maker.transform(pose, 0.0, ("base", link), topic="/tf_static")
    for number, (pose, scan) in enumerate(zip(DRIVE.of_base, DRIVE.scans, strict=True)):
        in_fixed = np.linalg.inv(drift(number)) @ pose
        yield maker.transform(drift(number), 10.0 + number, ("map", fixed))
        yield maker.transform(in_fixed, 10.0 + number, (fixed, "base"))
        sensor = in_fixed @ MOUNT
        points = scan @ sensor[:3, :3].T + sensor[:3, 3]
        yield maker.cloud(points, 10.0 + number, frame=fixed)


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("fixed", ["odom", "robot1/odom", "camera_init", "local_map"])
def test_rays_of_registered_clouds_start_at_the_sensor(tmp_path, name, fixed):
    report = ScanReport()
    path = write_bag(tmp_path / name, lambda maker: registered(maker, fixed))
    assert_rays(load_scans(path, report=report), DRIVE, 2e-6)
    assert f"clouds are in {fixed}; sensor assumed to be at lidar (guess: sensor_frame=" in str(
        report
    )
    with pytest.raises(ValueError, match="strict reading refuses a guess: clouds are in"):
        load_scans(path, strict=True)
    assert_rays(load_scans(path, sensor_frame="lidar", strict=True), DRIVE, 2e-6)


def test_of_several_possible_sensors_of_registered_clouds_one_must_be_named(tmp_path):
    links = ("lidar", "imu", "camera")
    path = write_bag(tmp_path / "a.mcap", lambda maker: registered(maker, sensor_links=links))
    with pytest.raises(
        ValueError, match=r"may be any of camera, imu, lidar\. Name it: .*sensor_fr"
    ):
        load_scans(path)
    assert_rays(load_scans(path, sensor_frame="lidar"), DRIVE, 2e-6)
    of_imu = load_scans(path, sensor_frame="imu")
    np.testing.assert_allclose(of_imu.origins, DRIVE.of_base[:, :3, 3], atol=1e-9)
    with pytest.raises(
        ValueError, match="frame laser must be a frame of tf; got base, camera, imu"
    ):
        load_scans(path, sensor_frame="laser")


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_root_that_sensors_move_below_is_fixed_whatever_its_name(tmp_path, name):
    def messages(maker):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            yield maker.transform(pose, 10.0 + number, ("start", "lidar"))
            yield maker.cloud(scan @ pose[:3, :3].T + pose[:3, 3], 10.0 + number, frame="start")

    assert_rays(load_scans(write_bag(tmp_path / name, messages)), DRIVE, 2e-6)


@pytest.mark.parametrize("has_mount", [True, False])
def test_registered_clouds_are_seen_from_the_sensor_that_odometry_carries(tmp_path, has_mount):
    def messages(maker):
        if has_mount:
            yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, scan in enumerate(DRIVE.scans):
            pose = DRIVE.poses[number]
            of_child = DRIVE.of_base[number] if has_mount else pose
            yield maker.odometry(of_child, 10.0 + number, child="base" if has_mount else "lidar")
            yield maker.cloud(scan @ pose[:3, :3].T + pose[:3, 3], 10.0 + number, frame="odom")

    path = write_bag(tmp_path / "a.bag", messages)
    for arguments in ({}, {"topic": "/odom"}, {"topic": ["/odom", "/points"]}):
        assert_rays(load_scans(path, **arguments), DRIVE, 2e-6)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_registered_clouds_are_seen_from_the_mount_on_poses_without_a_frame(tmp_path, name):
    def messages(maker, links):
        for link in links:
            yield maker.transform(MOUNT, 0.0, ("base", link), topic="/tf_static")
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            yield maker.pose(DRIVE.of_base[number], 10.0 + number, frame="map")
            yield maker.cloud(scan @ pose[:3, :3].T + pose[:3, 3], 10.0 + number, frame="map")

    path, report = (
        write_bag(tmp_path / name, lambda maker: messages(maker, ["lidar"])),
        ScanReport(),
    )
    assert_rays(load_scans(path, report=report), DRIVE, 2e-6)
    assert "sensor assumed to be at lidar (guess:" in str(report)
    path = write_bag(tmp_path / f"b{name}", lambda maker: messages(maker, ["lidar", "imu"]))
    with pytest.warns(ScanFileWarning, match="sensor at the poses of /pose .*poses_frame names"):
        load_scans(path)
    scans = load_scans(path, poses_frame="base", sensor_frame="lidar", strict=True)
    assert_rays(scans, DRIVE, 2e-6)


def test_registered_clouds_without_any_pose_of_the_sensor_are_refused(tmp_path):
    def messages(maker):
        for number, scan in enumerate(DRIVE.scans):
            yield maker.transform(drift(number), 10.0 + number, ("map", "odom"))
            yield maker.cloud(scan, 10.0 + number, frame="odom")

    path = write_bag(tmp_path / "a.db3", messages)
    with pytest.raises(ValueError, match=r"in odom, a fixed frame: the sensor position must come"):
        load_scans(path)
    assert load_scans(path, sensor_frame="odom").num_scans == 3


@pytest.mark.parametrize("source", ["tf", "odometry"])
def test_clouds_moved_to_the_robots_base_are_seen_from_the_sensor_on_it(tmp_path, source):
    def messages(maker, links):
        for link in links:
            yield maker.transform(MOUNT, 0.0, ("base_link", link), topic="/tf_static")
        for number, (pose, scan) in enumerate(zip(DRIVE.of_base, DRIVE.scans, strict=True)):
            if source == "tf":
                yield maker.transform(pose, 10.0 + number, ("odom", "base_link"))
            else:
                yield maker.odometry(pose, 10.0 + number, child="base_link")
            points = scan @ MOUNT[:3, :3].T + MOUNT[:3, 3]
            yield maker.cloud(points, 10.0 + number, frame="base_link")

    path = write_bag(tmp_path / "a.mcap", lambda maker: messages(maker, ["lidar"]))
    assert_rays(load_scans(path), DRIVE, 2e-6)
    path = write_bag(tmp_path / "b.mcap", lambda maker: messages(maker, ["lidar", "imu"]))
    assert_rays(load_scans(path, sensor_frame="lidar", strict=True), DRIVE, 2e-6)
    with pytest.warns(
        ScanFileWarning, match="assumed to be at the origin of base_link .*imu, lidar"
    ):
        scans = load_scans(path)
    np.testing.assert_allclose(scans.origins, DRIVE.of_base[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("kind", ["odometry", "pose"])
def test_a_mount_counts_where_poses_do_not_say_their_frame(tmp_path, name, kind):
    def messages(maker):
        yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, (pose, scan) in enumerate(zip(DRIVE.of_base, DRIVE.scans, strict=True)):
            if kind == "odometry":
                yield maker.odometry(pose, 10.0 + number, child="")
            else:
                yield maker.pose(pose, 10.0 + number)
            yield maker.cloud(scan, 10.0 + number)

    path, report = write_bag(tmp_path / name, messages), ScanReport()
    assert_rays(load_scans(path, report=report), DRIVE)
    assert "does not name the frame of its poses: assumed to be base (guess:" in str(report)
    assert_rays(load_scans(path, poses_frame="base", strict=True), DRIVE)
    without = load_scans(path, poses_frame="lidar", strict=True)
    np.testing.assert_allclose(without.origins, DRIVE.of_base[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("source", ["tf", "odometry", "pose"])
def test_clouds_beyond_the_trajectory_are_left_out_with_a_warning(tmp_path, source):
    def messages(maker, stamps, times):
        for number, time in enumerate(times):
            pose = np.eye(4)
            pose[0, 3] = 15 * 0.1 * number
            if source == "tf":
                yield maker.transform(pose, time, ("map", "lidar"))
            elif source == "odometry":
                yield maker.odometry(pose, time)
            else:
                yield maker.pose(pose, time)
        for stamp in stamps:
            yield maker.cloud(DRIVE.scans[0], stamp)

    times = 10 + 0.1 * np.arange(10)
    path = write_bag(
        tmp_path / "a.bag", lambda maker: messages(maker, (9.9, 10.45, 10.9005, 11.1), times)
    )
    with pytest.warns(ScanFileWarning, match="2 of 4 clouds left out: before the first or after"):
        scans = load_scans(path)
    np.testing.assert_allclose(scans.origins[:, 0], [15 * 0.45, 15 * 0.9], atol=1e-6)
    path = write_bag(tmp_path / "b.bag", lambda maker: messages(maker, (9.8, 11.2), times))
    with pytest.raises(ValueError, match=r"a pose .* is needed; all clouds are before the first"):
        load_scans(path)
    times = times[[0, 9]]
    path = write_bag(tmp_path / "c.bag", lambda maker: messages(maker, (10.2, 10.5), times))
    with pytest.warns(ScanFileWarning, match=r"1 of 2 clouds left out: farther than 0\.25 s from"):
        assert load_scans(path).num_scans == 1


def test_two_parents_are_an_error_only_for_frames_above_the_clouds(tmp_path):
    def messages(maker, above):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            if above != "lidar":
                yield maker.transform(pose, 10.0 + number, ("map", "lidar"))
            for parent in ("gnss", "odom"):
                yield maker.transform(pose, 10.0 + number, (parent, above))
            yield maker.odometry(pose, 10.0 + number)
            yield maker.cloud(scan, 10.0 + number)

    path = write_bag(tmp_path / "a.mcap", lambda maker: messages(maker, "arm"))
    assert_rays(load_scans(path), DRIVE)
    path = write_bag(tmp_path / "b.mcap", lambda maker: messages(maker, "lidar"))
    with pytest.raises(
        ValueError, match=r"lidar must have one parent; got gnss and odom. .*topic="
    ):
        load_scans(path)
    assert_rays(load_scans(path, topic="/odom"), DRIVE)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_mount_below_a_frame_with_two_parents_can_be_used(tmp_path, name):
    def messages(maker):
        yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, (pose, scan) in enumerate(zip(DRIVE.of_base, DRIVE.scans, strict=True)):
            for parent in ("map", "gnss"):
                yield maker.transform(pose, 10.0 + number, (parent, "base"))
            yield maker.odometry(pose, 10.0 + number, child="base")
            yield maker.cloud(scan, 10.0 + number)

    assert_rays(load_scans(write_bag(tmp_path / name, messages), topic="/odom"), DRIVE)


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.parametrize("stamp", [0.0, 11.0, 99.0])
def test_a_transform_that_tf_has_once_holds_for_all_times(tmp_path, name, stamp):
    def messages(maker):
        yield maker.transform(MOUNT, stamp, ("base", "lidar"))
        for number, (pose, scan) in enumerate(zip(DRIVE.of_base, DRIVE.scans, strict=True)):
            yield maker.transform(pose, 10.0 + number, ("odom", "base"))
            yield maker.cloud(scan, 10.0 + number)

    assert_rays(load_scans(write_bag(tmp_path / name, messages)), DRIVE)


@pytest.mark.parametrize("source", ["tf", "odometry"])
@pytest.mark.parametrize("broken", ["zeros", "nan"])
def test_poses_that_are_none_are_ignored_as_tf2_ignores_them(tmp_path, source, broken):
    def messages(maker):
        for number, (pose, scan) in enumerate(zip(DRIVE.poses, DRIVE.scans, strict=True)):
            for time in (10.0 + number, 10.1 + number):
                if source == "tf":
                    message = maker.transform(pose, time, ("odom", "lidar"))
                    one = message[3].transforms[0].transform
                    place, turn = one.translation, one.rotation
                else:
                    message = maker.odometry(pose, time)
                    one = message[3].pose.pose
                    place, turn = one.position, one.orientation
                if time % 1 > 0.05 and broken == "zeros":
                    turn.x = turn.y = turn.z = turn.w = 0.0
                elif time % 1 > 0.05:
                    place.x = np.nan
                yield message
            yield maker.cloud(scan, 10.0 + number)

    report = ScanReport()
    assert_rays(load_scans(write_bag(tmp_path / "a.bag", messages), report=report), DRIVE)
    assert "3 poses ignored" in str(report)
