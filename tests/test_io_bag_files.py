"""Files of bags: parts, order, logs of killed recorders, and what other libraries write and read."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from drives import assert_rays, room_drive, write_bag
from healthy_files import BagMaker, bag_messages

from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import load_scans

pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")

ONE_OF_EACH = ["a.bag", "a.db3", "a.mcap"]
DRIVE = room_drive()


def drive_messages(maker):
    return bag_messages(maker, DRIVE.scans, DRIVE.poses)


def write_parts(folder: Path, ending: str = ".mcap", metadata: str | None = None) -> Path:
    """A folder of three parts with one scan each; metadata.yaml lists them unless it is given."""
    folder.mkdir()
    messages = drive_messages(BagMaker(is_ros1=False))
    for number in range(3):
        part = messages[2 * number : 2 * number + 2]
        path = BagMaker(is_ros1=False).write(folder.parent / f"part_{number}{ending}", part)
        path.rename(folder / f"bag_{number}{ending}")
        shutil.rmtree(path.with_suffix(""))
    if metadata is None:
        metadata = metadata_of([f"bag_{number}{ending}" for number in range(3)], 6)
    if metadata:
        (folder / "metadata.yaml").write_text(metadata)
    return folder


def metadata_of(names, count) -> str:
    lines = ["rosbag2_bagfile_information:", "  version: 5", "  storage_identifier: mcap"]
    lines += ["  relative_file_paths:", *(f"    - {name}" for name in names)]
    return "\n".join([*lines, f"  message_count: {count}", '  compression_format: ""', ""])


def messages_by_rosbags(path: Path) -> list[tuple[str, int]]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return [(connection.topic, stamp) for connection, stamp, _ in reader.messages()]


def clouds_by_rosbags(path: Path) -> np.ndarray:
    """(S, n, 3) points of the clouds in the order in which rosbags gives them."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    clouds = []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [c for c in reader.connections if c.topic == "/points"]
        for connection, _, raw in reader.messages(connections=wanted):
            cloud = reader.deserialize(raw, connection.msgtype)
            clouds.append(cloud.data.view("<f4").reshape(-1, 4)[:, :3].astype(np.float64))
    return np.array(clouds)


def in_the_world(clouds: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return np.concatenate([c @ p[:3, :3].T + p[:3, 3] for c, p in zip(clouds, poses, strict=True)])


@pytest.mark.parametrize("ending", [".mcap", ".db3"])
@pytest.mark.parametrize("metadata", [None, "", "rosbag2_bagfile_information:\n"])
def test_all_parts_of_a_bag_are_read(tmp_path, ending, metadata):
    assert_rays(load_scans(write_parts(tmp_path / "bag", ending, metadata)), DRIVE)


def test_metadata_with_folder_names_in_its_paths_is_understood(tmp_path):
    names = [f"bag/bag_{number}.mcap" for number in range(3)]  # as ROS 2 Dashing wrote them
    bag = write_parts(tmp_path / "bag", metadata=metadata_of(names, 6))
    assert_rays(load_scans(bag), DRIVE)


@pytest.mark.parametrize("ending", [".mcap", ".db3"])
def test_a_part_that_metadata_lists_and_is_missing_is_an_error(tmp_path, ending):
    bag = write_parts(tmp_path / "bag", ending)
    (bag / f"bag_1{ending}").unlink()
    with pytest.raises(
        ValueError, match=rf"bag cannot.*lists bag_1{ending}, which is missing.*rein"
    ):
        load_scans(bag)


def test_a_gap_in_the_numbers_of_parts_warns_where_there_is_no_metadata(tmp_path):
    bag = write_parts(tmp_path / "bag", metadata="")
    (bag / "bag_1.mcap").unlink()
    with pytest.warns(ScanFileWarning, match="parts 1 of bag are missing"):
        assert load_scans(bag).num_scans == 2


def test_recordings_in_one_folder_are_no_parts_of_a_bag(tmp_path):
    bag = write_parts(tmp_path / "bag", metadata="")
    for number in (2, 1, 0):
        (bag / f"bag_{number}.mcap").rename(bag / f"run_{number + 1}.mcap")
    report = ScanReport()
    assert_rays(load_scans(bag, report=report), DRIVE)
    assert len(report.files) == 3


def test_a_part_that_is_still_compressed_is_an_error(tmp_path):
    bag = write_parts(tmp_path / "bag")
    (bag / "bag_1.mcap").rename(bag / "bag_1.mcap.zstd")
    with pytest.raises(
        ValueError, match=r"bag_1\.mcap\.zstd is still compressed\. Unpack it: zstd"
    ):
        load_scans(bag)
    names = [f"bag_{number}.mcap.zstd" for number in range(3)]
    (bag / "metadata.yaml").write_text(metadata_of(names, 6))
    with pytest.raises(ValueError, match=r"bag_1\.mcap\.zstd is still compressed"):
        load_scans(bag)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(ValueError, match=r"bag_1\.mcap\.zstd is still compressed"):
        load_scans(bag)
    (bag / "bag_1.mcap.zstd").rename(bag / "bag_1.mcap")
    (bag / "metadata.yaml").write_text(metadata_of(names, 6))
    assert_rays(load_scans(bag), DRIVE)


def test_a_bag_and_its_conversion_in_one_folder_are_not_read_twice(tmp_path):
    bag, report = write_parts(tmp_path / "bag"), ScanReport()
    other = write_parts(tmp_path / "other", ".db3")
    for part in other.glob("*.db3"):
        shutil.copy(part, bag)
    assert_rays(load_scans(bag, report=report), DRIVE)
    assert "bag_0.db3, bag_1.db3, bag_2.db3 left out: not in metadata.yaml" in str(report)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(ValueError, match=r"has \.db3 and \.mcap files.* may be a conversion"):
        load_scans(bag)


def test_fewer_messages_than_metadata_promises_are_reported(tmp_path):
    names = [f"bag_{number}.mcap" for number in range(3)]
    bag = write_parts(tmp_path / "bag", metadata=metadata_of(names, 9))
    with pytest.warns(ScanFileWarning, match="6 messages, but metadata.yaml declares 9"):
        assert_rays(load_scans(bag), DRIVE)


def test_metadata_that_is_no_yaml_is_an_error(tmp_path):
    bag = write_parts(tmp_path / "bag", metadata="rosbag2_bagfile_information: [1, {\n")
    with pytest.raises(ValueError, match=r"metadata\.yaml is no YAML"):
        load_scans(bag)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_scans_come_in_the_order_of_recording_as_rosbags_reads_them(tmp_path, name):
    maker = BagMaker(is_ros1=name.endswith(".bag"))
    messages = drive_messages(maker)
    shuffled = [messages[i] for i in (4, 1, 3, 0, 5, 2)]
    path = maker.write(tmp_path / name, shuffled)
    assert_rays(load_scans(path), DRIVE)
    stamps = [stamp for topic, stamp in messages_by_rosbags(path) if topic == "/points"]
    assert stamps == sorted(stamps)
    assert np.allclose(load_scans(path).ends, in_the_world(clouds_by_rosbags(path), DRIVE.poses))


def killed_recorder(folder: Path, journal: str) -> Path:
    """A database whose recorder was killed: all but two messages are in the log beside it."""
    folder.mkdir()
    whole = write_bag(folder / "whole.db3", drive_messages)
    path = folder / "bag_0.db3"
    with sqlite3.connect(whole) as source:
        tables = [sql for (sql,) in source.execute("SELECT sql FROM sqlite_master") if sql]
        topics = source.execute("SELECT * FROM topics").fetchall()
        messages = source.execute("SELECT * FROM messages ORDER BY id").fetchall()
    source.close()
    live = folder / "live.db3"
    target = sqlite3.connect(live, isolation_level=None)
    target.execute(f"PRAGMA journal_mode={journal}")
    target.execute("PRAGMA wal_autocheckpoint=0")
    for sql in tables:
        if "sqlite_" not in sql.split("(")[0]:
            target.execute(sql)
    marks = ",".join("?" * len(topics[0]))
    target.executemany(f"INSERT INTO topics VALUES ({marks})", topics)
    insert = f"INSERT INTO messages VALUES ({','.join('?' * len(messages[0]))})"
    target.executemany(insert, messages[:2])
    if journal == "WAL":
        target.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        target.executemany(insert, messages[2:])
    else:
        target.executemany(insert, messages[2:])
        target.execute("PRAGMA cache_size=1")
        target.execute("BEGIN")
        target.execute("UPDATE messages SET timestamp = 1")  # a change that was never completed
        target.execute("DELETE FROM messages")
        target.executemany(insert, [(i, 1, 1, bytes(9000)) for i in range(50)])
    for ending in ("", "-wal", "-journal"):
        log = live.with_name(live.name + ending)
        if log.is_file():
            shutil.copy(log, path.with_name(path.name + ending))
    target.close()
    for file in [*folder.glob("live*"), whole]:
        file.unlink()
    shutil.rmtree(folder / "whole")
    return path


@pytest.mark.parametrize("journal", ["WAL", "DELETE"])
def test_the_log_that_a_killed_recorder_left_is_merged(tmp_path, journal):
    path = killed_recorder(tmp_path / "bag", journal)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert set(before) == {
        "bag_0.db3",
        "bag_0.db3-wal" if journal == "WAL" else "bag_0.db3-journal",
    }
    report = ScanReport()
    for place in (path, path.parent):  # there is no metadata.yaml yet either
        assert_rays(load_scans(place, report=report), DRIVE)
    assert "the recorder was killed: bag_0.db3-" in str(report)
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_a_log_too_large_to_copy_says_how_to_merge_it(tmp_path, monkeypatch):
    path = killed_recorder(tmp_path / "bag", "WAL")
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(ValueError, match=r"left bag_0\.db3-wal, .*Run: sqlite3 bag_0\.db3"):
        load_scans(path)


MCAP_OPTIONS = [
    {},
    {"use_chunking": False},
    {"compression": "LZ4"},
    {"compression": "ZSTD", "chunk_size": 2000},
    {"compression": "NONE", "enable_crcs": False},
    {"use_statistics": False, "use_summary_offsets": False, "index_types": "NONE"},
]


@pytest.mark.parametrize("options", MCAP_OPTIONS)
def test_files_of_the_mcap_library_are_read_as_rosbags_reads_them(tmp_path, options):
    writer_module = pytest.importorskip("mcap.writer")
    maker = BagMaker(is_ros1=False)
    messages = drive_messages(maker)
    path = tmp_path / "a.mcap"
    options = dict(options)
    for key, kinds in (("compression", "CompressionType"), ("index_types", "IndexType")):
        if key in options:
            options[key] = getattr(getattr(writer_module, kinds), options[key])
    with open(path, "wb") as file:
        writer = writer_module.Writer(file, **options)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for number in (5, 0, 4, 1, 3, 2):  # log times need not ascend
            topic, kind, stamp, message = messages[number]
            if topic not in channels:
                definition, _ = maker.store.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            content = bytes(maker.store.serialize_cdr(message, kind))
            writer.add_message(channels[topic], round(stamp * 1e9), content, round(stamp * 1e9))
        writer.add_metadata("note", {"made": "here"})
        writer.add_attachment(0, 0, "readme", "text/plain", b"nothing")
        writer.finish()
    scans = load_scans(path)
    assert_rays(scans, DRIVE)
    if options.get("use_chunking", True) and "index_types" not in options:
        # Without an index rosbags refuses messages that are not in time order.
        assert np.allclose(scans.ends, in_the_world(clouds_by_rosbags(path), DRIVE.poses))


@pytest.mark.parametrize("compression", ["", "zstd"])
def test_files_of_rosbags_are_read_as_the_mcap_library_reads_them(tmp_path, compression):
    reader_module = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    path = write_bag(tmp_path / "a.mcap", drive_messages, compression)
    clouds, poses = [], []
    with open(path, "rb") as file:
        reader = reader_module.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            if channel.topic == "/points":
                values = np.frombuffer(bytes(message.data), "<f4").reshape(-1, 4)[:, :3]
                clouds.append(values.astype(np.float64))
            else:
                at = message.pose.pose.position
                poses.append([at.x, at.y, at.z])
    scans = load_scans(path)
    assert np.allclose(scans.ends, in_the_world(np.array(clouds), DRIVE.poses), atol=1e-9)
    assert np.array_equal(scans.origins, poses)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_ros1_bag_and_its_conversion_by_rosbags_hold_the_same_scans(tmp_path, storage):
    from rosbags.convert import convert
    from rosbags.typesys import Stores, get_typestore

    path, target = write_bag(tmp_path / "a.bag", drive_messages), tmp_path / "converted"
    everything = dict.fromkeys(
        ("exclude_topics", "include_topics", "exclude_msgtypes", "include_msgtypes"), ()
    )
    convert(
        [path],
        target,
        dst_storage=storage,
        dst_version=8,
        compress=None,
        compress_mode="none",
        default_typestore=None,
        typestore=get_typestore(Stores.ROS2_HUMBLE),
        **everything,
    )
    scans, converted = load_scans(path), load_scans(target)
    assert_rays(scans, DRIVE)
    assert np.array_equal(scans.ends, converted.ends)
    assert np.array_equal(scans.origins, converted.origins)
