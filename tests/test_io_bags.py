"""ROS 1 and ROS 2 bags and MCAP, written by rosbags."""

import bz2
import shutil
import sqlite3
import struct
import sys

import numpy as np
import pytest
from healthy_files import CLOUD_TOPIC, BagMaker, bag_messages
from scan_files import real_scans, some_points, turning_poses

from lardhm_torch.io.bag_chunks import Unpacker
from lardhm_torch.io.scan_files import load_points, load_scans

pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")

BAGS = [
    *(("a.bag", ""), ("a.bag", "bz2"), ("a.bag", "lz4")),
    *(("a.db3", ""), ("a.db3", "zstd-message")),
    *(("a.mcap", ""), ("a.mcap", "zstd"), ("a.mcap", "zstd-message")),
]
ONE_OF_EACH = ["a.bag", "a.db3", "a.mcap"]
MOUNT = np.eye(4)
MOUNT[:3] = [[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 1.5]]


def maker_for(name: str) -> BagMaker:
    return BagMaker(is_ros1=name.endswith(".bag"))


def to_sensor(points, pose):
    return (points - pose[:3, 3]) @ pose[:3, :3]


def write_bag(path, messages_of):
    maker = maker_for(path.name)
    return maker.write(path, messages_of(maker))


@pytest.mark.parametrize(("name", "compression"), BAGS)
def test_real_scans_come_back_from_a_bag(data, tmp_path, name, compression):
    arrays = real_scans(data, "kitti00_mulls")
    points, scan_id = arrays["points"][::50].astype(np.float64), arrays["scan_id"][::50]
    poses, maker = arrays["poses"], maker_for(name)
    scans = [to_sensor(points[scan_id == i], pose) for i, pose in enumerate(poses)]
    path = maker.write(tmp_path / name, bag_messages(maker, scans, poses), compression)
    loaded = load_scans(path)
    assert np.allclose(loaded.origins, poses[:, :3, 3], rtol=0, atol=1e-9)
    assert np.array_equal(loaded.scan_id, scan_id)
    # float32 in the sensor's frame; the stored rotations drift by 1e-6, and a quaternion does not
    assert np.allclose(loaded.ends, points, rtol=0, atol=2e-4)
    assert np.array_equal(load_points(path), loaded.ends)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_tf_places_the_clouds_by_all_frames_up_to_the_root(tmp_path, name):
    points, poses = some_points(), turning_poses(3)

    def messages(maker):
        yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, pose in enumerate(poses):
            yield maker.transform(pose, 10.0 + number, ("odom", "base"))
            yield maker.transform(np.eye(4), 10.0 + number, ("base", "arm"))
            yield maker.transform(MOUNT, 10.0 + number, ("map", "odom"))
            yield maker.cloud(to_sensor(points, MOUNT @ pose @ MOUNT), 10.0 + number)

    scans = load_scans(write_bag(tmp_path / name, messages))
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-5)
    assert np.allclose(scans.origins, (MOUNT @ poses @ MOUNT)[:, :3, 3])
    assert scans.times.tolist() == [10, 11, 12]


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_odometry_of_the_base_and_a_fixed_mount_place_the_clouds(tmp_path, name):
    points, poses = some_points(), turning_poses(2)

    def messages(maker):
        yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        for number, pose in enumerate(poses):
            yield maker.odometry(pose, 5.0 + number, child="/base")  # ROS 1 wrote it so once
            yield maker.cloud(to_sensor(points, pose @ MOUNT), 5.0 + number)

    scans = load_scans(write_bag(tmp_path / name, messages))
    assert np.allclose(scans.ends, np.tile(points, (2, 1)), atol=1e-5)
    assert np.allclose(scans.origins, (poses @ MOUNT)[:, :3, 3])


def test_frames_that_nothing_connects_are_taken_as_one_with_a_warning(tmp_path):
    def messages(maker):
        yield maker.odometry(turning_poses(2)[1], 5.0, child="imu")
        yield maker.cloud(some_points(), 5.0)

    path = write_bag(tmp_path / "a.bag", messages)
    with pytest.warns(UserWarning, match="tf does not connect imu of the poses with lidar"):
        assert load_scans(path).origins.tolist() == [[1, 2, 0.5]]


def test_clouds_in_the_frame_of_the_poses_are_in_the_world_already(tmp_path):
    points, pose = some_points(), turning_poses(2)[1]

    def messages(maker):
        yield maker.pose(pose, 5.0, frame="map")
        yield maker.cloud(points, 5.0, frame="map")

    scans = load_scans(write_bag(tmp_path / "a.mcap", messages))
    assert np.allclose(scans.ends, points, atol=1e-6)
    assert scans.origins.tolist() == [[1, 2, 0.5]]


def test_a_cloud_between_two_poses_is_placed_between_them(tmp_path):
    first, second = np.eye(4), np.eye(4)
    second[0, 3] = 1

    def messages(maker):
        yield maker.cloud(some_points(), 10.1)
        yield maker.pose(second, 10.2)
        yield maker.pose(first, 10.0)

    scans = load_scans(write_bag(tmp_path / "a.db3", messages))
    assert np.allclose(scans.origins, [[0.5, 0, 0]], atol=1e-6)


def test_a_stamp_of_zero_gives_way_to_the_time_of_recording(tmp_path):
    def messages(maker):
        topic, kind, _, cloud = maker.cloud(some_points(), 0.0)
        yield topic, kind, 7.0, cloud
        yield maker.pose(turning_poses(2)[1], 7.0)

    assert load_scans(write_bag(tmp_path / "a.mcap", messages)).origins.tolist() == [[1, 2, 0.5]]


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_of_several_topics_one_must_be_named(tmp_path, name):
    points = some_points()

    def messages(maker):
        for shift in (0.0, 1.0):
            pose = np.eye(4)
            pose[0, 3] = shift
            yield maker.pose(pose, 1.0, topic=f"/pose_{shift:.0f}")
            yield maker.cloud(points + shift, 1.0, topic=f"/cloud_{shift:.0f}")

    path = write_bag(tmp_path / name, messages)
    with pytest.raises(ValueError, match=r"2 topics hold clouds .*: /cloud_0, /cloud_1\. .*topic="):
        load_scans(path)
    with pytest.raises(ValueError, match=r"2 topics hold poses .*: /pose_0, /pose_1\. Name one"):
        load_scans(path, topic="/cloud_1")
    for topics in (["/cloud_1", "/pose_0"], ["/pose_0", "/cloud_1"]):
        scans = load_scans(path, topic=topics)
        assert np.allclose(scans.ends, points + 1, atol=1e-6)
        assert scans.origins.tolist() == [[0, 0, 0]]


def test_a_name_that_no_topic_has_is_an_error(tmp_path):
    path = write_bag(
        tmp_path / "a.bag", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    with pytest.raises(ValueError, match=r"a topic of the name /typo is needed; got /odom \(nav"):
        load_scans(path, topic="/typo")


def test_tf_that_stands_still_gives_way_to_a_pose_topic(tmp_path):
    """ROS 1 says a fixed mount again and again on /tf."""
    points, poses = some_points(), turning_poses(2)

    def messages(maker, has_odometry):
        for number, pose in enumerate(poses):
            yield maker.transform(MOUNT, 5.0 + number, ("base", "lidar"))
            if has_odometry:
                yield maker.odometry(pose, 5.0 + number, child="base")
            yield maker.cloud(to_sensor(points, pose @ MOUNT), 5.0 + number)

    scans = load_scans(write_bag(tmp_path / "a.bag", lambda maker: messages(maker, True)))
    assert np.allclose(scans.ends, np.tile(points, (2, 1)), atol=1e-5)
    scans = load_scans(write_bag(tmp_path / "b.bag", lambda maker: messages(maker, False)))
    assert np.allclose(scans.origins, MOUNT[:3, 3])  # a scanner on its tripod
    with pytest.raises(ValueError, match="refuses a guess: lidar never moves in tf"):
        load_scans(tmp_path / "b.bag", strict=True)
    strict = load_scans(tmp_path / "b.bag", strict=True, sensor_frame="lidar")
    assert np.array_equal(strict.origins, scans.origins)


def test_a_named_pose_topic_goes_before_tf(tmp_path):
    def messages(maker):
        for stamp, pose in zip((0.0, 1.0), turning_poses(2), strict=True):
            yield maker.transform(pose, stamp, ("odom", "lidar"))
        yield maker.pose(np.eye(4), 1.0)
        yield maker.cloud(some_points(), 1.0)

    path = write_bag(tmp_path / "a.bag", messages)
    assert load_scans(path).origins.tolist() == [[1, 2, 0.5]]
    assert load_scans(path, topic="/pose").origins.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_bag_without_clouds_or_without_poses_says_what_it_has(tmp_path, name):
    path = write_bag(tmp_path / name, lambda maker: [maker.pose(np.eye(4), 1.0)])
    with pytest.raises(ValueError, match=r"of clouds .* is needed; got /pose \(geometry_msgs/Pose"):
        load_scans(path)
    path = write_bag(tmp_path / f"b{name}", lambda maker: [maker.cloud(some_points(), 1.0)])
    with pytest.raises(ValueError, match=r"of poses .* is needed; got /points \(sensor_msgs/Point"):
        load_scans(path)


def test_a_folder_of_a_ros2_bag_is_one_bag_of_several_files(tmp_path):
    poses, points = turning_poses(3), some_points()
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")

    def messages(maker, number):
        if number == 0:  # said once, at the start of the recording
            yield maker.transform(MOUNT, 0.0, ("base", "lidar"), topic="/tf_static")
        yield maker.transform(poses[number], 10.0 + number, ("odom", "base"))
        yield maker.cloud(to_sensor(points, poses[number] @ MOUNT), 10.0 + number)

    for number in range(3):
        path = tmp_path / f"part_{number}.mcap"
        write_bag(path, lambda maker, number=number: messages(maker, number)).rename(
            bag / f"bag_{number}.mcap"
        )
    scans = load_scans(bag)
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-5)
    assert np.allclose(scans.origins, (poses @ MOUNT)[:, :3, 3])
    for path in bag.glob("*.mcap"):
        path.rename(path.with_suffix(".mcap.zstd"))
    with pytest.raises(ValueError, match=r"bag_1\.mcap.*is still compressed\. Unpack it: zstd -d"):
        load_scans(bag)


@pytest.mark.parametrize("big_endian", [False, True])
def test_fields_of_a_cloud_are_found_by_their_offsets(tmp_path, big_endian):
    order = ">" if big_endian else "<"
    row = np.zeros(3, np.dtype(f"V2,{order}f8,{order}f4,V3,{order}f4"))
    row["f1"], row["f2"], row["f4"] = [1, 2, 3], [4, 5, np.nan], [7, 8, 9]
    padded = (row[:2].tobytes() + b"padding") + (row[1:].tobytes() + b"padding")  # 2 x 2, organized

    def messages(maker):
        yield maker.pose(np.eye(4), 1.0)
        topic, kind, stamp, cloud = maker.cloud(some_points(1), 1.0)
        cloud.fields[:] = [
            maker.store.types["sensor_msgs/msg/PointField"](name, offset, number, 1)
            for name, offset, number in (("z", 17, 7), ("y", 10, 7), ("x", 2, 8))
        ]
        cloud.height, cloud.width, cloud.is_bigendian = 2, 2, big_endian
        cloud.point_step, cloud.row_step = row.itemsize, 2 * row.itemsize + 7
        cloud.data = np.frombuffer(padded, np.uint8)
        yield topic, kind, stamp, cloud

    ends = load_scans(write_bag(tmp_path / "a.bag", messages)).ends
    expected = [[1, 4, 7], [2, 5, 8], [2, 5, 8], [np.nan] * 3]  # a pose mixes coordinates
    assert np.array_equal(ends, expected, equal_nan=True)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("width", 201, "declares 1 x 201 points of 16 bytes; got 3200 bytes"),
        ("height", 2**31, "declares 2147483648 x 200 points"),
        ("point_step", 11, "declares 1 x 200 points of 11 bytes"),
        ("row_step", 2**32 - 1, None),  # of no matter where there is one row
        ("width", 0, "at least one point is needed"),
        ("fields", [], "needs the fields x, y, z; got none"),
    ],
)
def test_a_cloud_that_promises_more_than_it_holds_is_refused(tmp_path, name, value, message):
    def messages(maker):
        yield maker.pose(np.eye(4), 1.0)
        cloud = maker.cloud(some_points(), 1.0)
        setattr(cloud[3], name, value)
        yield cloud

    path = write_bag(tmp_path / "a.mcap", messages)
    if message is None:
        assert len(load_scans(path)) == 200
        return
    with pytest.raises(ValueError, match=message):
        load_scans(path)


def test_clouds_of_one_topic_are_in_one_frame(tmp_path):
    def messages(maker):
        yield maker.cloud(some_points(), 1.0, frame="front")
        yield maker.cloud(some_points(), 1.0, frame="rear")

    with pytest.raises(ValueError, match="in one frame; got front, rear"):
        load_scans(write_bag(tmp_path / "a.bag", messages))


def test_frames_must_form_a_tree(tmp_path):
    def circle(maker):
        yield maker.transform(np.eye(4), 1.0, ("lidar", "base"))
        yield maker.transform(np.eye(4), 1.0, ("base", "lidar"))
        yield maker.cloud(some_points(), 1.0)

    def two_parents(maker):
        yield maker.transform(np.eye(4), 1.0, ("map", "lidar"))
        yield maker.transform(np.eye(4), 1.0, ("odom", "lidar"))
        yield maker.cloud(some_points(), 1.0)

    with pytest.raises(ValueError, match=r"must form a tree; lidar is above itself"):
        load_scans(write_bag(tmp_path / "a.bag", circle))
    with pytest.raises(ValueError, match=r"lidar must have one parent; got map and odom"):
        load_scans(write_bag(tmp_path / "b.bag", two_parents))


def test_recordings_that_were_not_closed_say_how_to_mend_them(tmp_path):
    path = write_bag(
        tmp_path / "a.bag", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    with pytest.raises(ValueError, match=r"a\.bag cannot be read: .*rosbag reindex"):
        load_scans(path)
    path = write_bag(
        tmp_path / "a.mcap", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"a\.mcap cannot be read: .*mcap recover"):
        load_scans(path)


def test_a_small_chunk_that_unpacks_to_gigabytes_is_refused_before():
    zeros = bz2.compress(bytes(1 << 26))
    unpack = Unpacker(file_size=1000)
    with pytest.raises(ValueError, match="declares 4294967295 bytes, more than the file can hold"):
        unpack(memoryview(zeros), "bz2", 2**32 - 1)
    with pytest.raises(ValueError, match="declares 1000 bytes; got 1001 or more"):
        unpack(memoryview(zeros), "bz2", 1000)
    with pytest.raises(ValueError, match="declares None bytes; got 16977217 or more"):
        unpack(memoryview(zeros), "bz2", None)


def test_small_chunks_may_not_unpack_to_gigabytes_together():
    unpack = Unpacker(file_size=1000)
    zeros = bz2.compress(bytes(1 << 23))
    assert len(unpack(memoryview(zeros), "bz2", 1 << 23)) == 1 << 23
    unpack(memoryview(zeros), "bz2", 1 << 23)
    with pytest.raises(ValueError, match="more than the file can hold"):
        unpack(memoryview(zeros), "bz2", 1 << 23)


def test_a_database_with_a_view_is_refused(tmp_path):
    path = write_bag(
        tmp_path / "a.db3", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    for statement in (
        "CREATE VIEW endless AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x FROM n) "
        "SELECT x FROM n",
        "CREATE TABLE computed (n INTEGER, a BLOB AS (zeroblob(1000000000)))",
    ):
        broken = tmp_path / "b.db3"
        shutil.copy(path, broken)
        connection = sqlite3.connect(broken)
        connection.execute(statement)
        connection.close()
        with pytest.raises(ValueError, match=r"b\.db3 cannot be read: plain tables are needed"):
            load_scans(broken)


def test_a_chunk_with_a_wrong_checksum_is_refused(tmp_path):
    path = write_bag(
        tmp_path / "a.mcap", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    content = path.read_bytes()
    at = content.index(CLOUD_TOPIC.encode()) - 100  # within the first chunk's header and schema
    chunk = content.index(struct.pack("<B", 6), 8 + 9)
    assert chunk < at
    (checksum,) = struct.unpack_from("<I", content, chunk + 9 + 24)
    wrong = struct.pack("<I", checksum ^ 1 or 2)
    path.write_bytes(content[: chunk + 33] + wrong + content[chunk + 37 :])
    with pytest.raises(ValueError, match="the checksum of a chunk is wrong"):
        load_scans(path)


def test_without_rosbags_the_error_names_the_extra(tmp_path, monkeypatch):
    path = write_bag(
        tmp_path / "a.bag", lambda maker: bag_messages(maker, [some_points()], MOUNT[None])
    )
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(ImportError, match=r"a\.bag needs rosbags.*lardhm_torch\[io\]"):
        load_scans(path)
