"""Poses that writers put when they know none, and points that are none."""

import healthy_files
import numpy as np
import pytest
from room_scan import (
    POSITION,
    append_without_pose,
    pose,
    sensor_points,
    with_zeros,
    without_third,
    world_points,
)
from scan_files import file_content, needs_laspy, pcd_header, write_poses

from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import Reading, iter_pieces, iter_scans, load_points, load_scans

IDENTITY = "0 0 0 1 0 0 0"
FAR = np.array([500_000.0, 4_500_000.0, 100.0])


def write_pcd(path, points, viewpoint=IDENTITY):
    header = pcd_header("binary", len(points), viewpoint=viewpoint)
    path.write_bytes(header + points.astype("<f8").tobytes())


def write_e57(path, scans, rotations=None, translations=None):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")
    with pye57.E57(str(path), mode="w") as file:
        for number, points in enumerate(scans):
            columns = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
            rotation = None if rotations is None else rotations[number]
            translation = None if translations is None else translations[number]
            file.write_scan_raw(columns, rotation=rotation, translation=translation)


def ptx(points, matrix):
    """One scan of a PTX file with its pose: the matrix is for row vectors."""
    rows = [matrix[:3, 3].tolist(), *matrix[:3, :3].T.tolist(), *matrix.T.tolist()]
    lines = ["1", str(len(points)), *(" ".join(map(repr, row)) for row in rows)]
    return "\n".join(lines + [" ".join(map(repr, row)) + " 0.5" for row in points.tolist()]) + "\n"


def every_reader(path, **options):
    """The scans of a path by each of the public functions."""
    return [
        len(load_scans(path, **options)),
        sum(map(len, iter_scans(path, **options))),
        sum(map(len, iter_pieces(path, Reading(**options), max_rays=100))),
    ]


@pytest.mark.parametrize(
    "viewpoint", [IDENTITY, "0 0 0 0 0 0 0", "0 0 0 -1 0 0 0", "-0.0 0 0 1 0 0 0"]
)
def test_an_identity_viewpoint_far_from_the_points_is_no_sensor_position(tmp_path, viewpoint):
    write_pcd(tmp_path / "a.pcd", world_points() + FAR, viewpoint)
    message = r"a\.pcd must contain the sensor position.*points are \d+ m and more.*--origin"
    for read in (
        load_scans,
        lambda path: list(iter_scans(path)),
        lambda path: list(iter_pieces(path)),
    ):
        with pytest.raises(ValueError, match=message):
            read(tmp_path / "a.pcd")
    scans = load_scans(tmp_path / "a.pcd", origin=POSITION + FAR)
    np.testing.assert_array_equal(scans.origins[0], POSITION + FAR)
    np.testing.assert_array_equal(scans.ends, world_points() + FAR)


def test_a_single_scan_near_its_identity_viewpoint_is_read_and_the_guess_is_reported(tmp_path):
    write_pcd(tmp_path / "a.pcd", sensor_points())
    report = ScanReport()
    scans = load_scans(tmp_path / "a.pcd", report=report)
    assert scans.origins.tolist() == [[0, 0, 0]]
    assert "identity pose assumed to be that of a sensor at zero (guess: --origin 0,0,0" in str(
        report
    )
    with pytest.raises(ValueError, match=r"a\.pcd: strict reading refuses a guess.*--origin 0,0,0"):
        load_scans(tmp_path / "a.pcd", strict=True)
    assert len(load_scans(tmp_path / "a.pcd", origin=(0, 0, 0), strict=True)) == len(scans)


def test_several_scans_with_an_identity_viewpoint_prove_that_it_is_none(tmp_path):
    for name in ("a", "b", "c"):
        write_pcd(tmp_path / f"{name}.pcd", sensor_points())
    for read in (
        load_scans,
        lambda path: next(iter_scans(path)),
        lambda path: next(iter_pieces(path)),
    ):
        with pytest.raises(
            ValueError, match=r"a\.pcd must contain the sensor position.*\d scans have it"
        ):
            read(tmp_path)
    assert every_reader(tmp_path, origin=(0, 0, 0)) == [720, 720, 720]


def test_the_first_scan_of_a_drive_may_stand_at_zero(tmp_path):
    write_pcd(tmp_path / "a.pcd", sensor_points())
    write_pcd(tmp_path / "b.pcd", sensor_points() + POSITION, "1.5 -0.75 1.25 1 0 0 0")
    assert load_scans(tmp_path).origins.tolist() == [[0, 0, 0], POSITION.tolist()]
    assert every_reader(tmp_path) == [480, 480, 480]


def test_a_pose_file_beside_an_identity_viewpoint_must_be_used(tmp_path):
    write_pcd(tmp_path / "a.pcd", sensor_points())
    write_poses(tmp_path / "poses.txt", pose()[None])
    with pytest.raises(ValueError, match=r'poses\.txt beside it.*frame="sensor" or frame="world"'):
        load_scans(tmp_path / "a.pcd")
    scans = load_scans(tmp_path / "a.pcd", frame="sensor")
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-12)
    assert scans.origins[0].tolist() == POSITION.tolist()
    seen = load_scans(tmp_path / "a.pcd", frame="world")
    np.testing.assert_array_equal(seen.ends, sensor_points())
    assert seen.origins[0].tolist() == POSITION.tolist()


def test_a_viewpoint_that_rotates_asks_for_the_frame(tmp_path):
    half = 0.5**0.5
    write_pcd(tmp_path / "a.pcd", sensor_points(), f"1.5 -0.75 1.25 {half} 0 0 {half}")
    with pytest.raises(ValueError, match=r'a\.pcd .*has a rotation.*frame="sensor".*--frame'):
        load_scans(tmp_path / "a.pcd")
    scans = load_scans(tmp_path / "a.pcd", frame="sensor")
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(
        load_scans(tmp_path / "a.pcd", frame="world").ends, sensor_points()
    )


def test_a_viewpoint_that_shifts_alone_is_a_guess_that_frame_settles(tmp_path):
    write_pcd(tmp_path / "a.pcd", world_points(), "1.5 -0.75 1.25 2 0 0 0")  # w of any length
    np.testing.assert_array_equal(load_scans(tmp_path / "a.pcd").ends, world_points())
    with pytest.raises(ValueError, match=r'strict reading refuses a guess.*frame="world" confirms'):
        load_scans(tmp_path / "a.pcd", strict=True)
    np.testing.assert_array_equal(
        load_scans(tmp_path / "a.pcd", frame="world", strict=True).ends, world_points()
    )


@pytest.mark.parametrize("pose_given", ["rotation", "translation", "both"])
def test_identity_poses_of_an_e57_far_away_are_placeholders(tmp_path, pose_given):
    rotations = None if pose_given == "translation" else [[1.0, 0, 0, 0]]
    translations = None if pose_given == "rotation" else [np.zeros(3)]
    write_e57(tmp_path / "a.e57", [world_points() + FAR], rotations, translations)
    with pytest.raises(ValueError, match=r"a\.e57 must contain the sensor position.*--origin"):
        load_scans(tmp_path / "a.e57")
    assert load_scans(tmp_path / "a.e57", origin=FAR).origins.tolist() == [FAR.tolist()]


def test_two_scans_of_an_e57_at_identity_are_registered_points_without_poses(tmp_path):
    write_e57(tmp_path / "a.e57", [sensor_points()] * 2, [[1.0, 0, 0, 0]] * 2, [np.zeros(3)] * 2)
    with pytest.raises(ValueError, match="2 scans have it"):
        load_scans(tmp_path / "a.e57")


@pytest.mark.parametrize("suffix", ["e57", "ptx"])
@pytest.mark.parametrize(
    ("shifts", "wrong"),
    [([0, 4], []), ([4, 0, 7], []), ([4, 0, 0], [1, 2]), ([900, 0], [1]), ([0, 900, 901], [0])],
)
def test_an_identity_pose_among_others_is_one_of_the_first_scan_near_zero(
    tmp_path, suffix, shifts, wrong
):
    """Where it cannot be one, the registered points of the scan are as far away as the others."""
    poses = np.tile(np.eye(4), (len(shifts), 1, 1))
    poses[:, 0, 3] = shifts
    places = [shift or max(shifts) * (max(shifts) > 100) for shift in shifts]
    ahead = np.array([1.0, 0, 0])
    scans = [sensor_points() + gap * ahead for gap in np.subtract(places, shifts)]
    path = tmp_path / f"a.{suffix}"
    if suffix == "e57":
        pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")
        healthy_files.write_e57(path, scans, poses)
    else:
        path.write_text("".join(map(ptx, scans, poses)))
    if wrong:
        count = f"{len(wrong)} of {len(shifts)} scans, the first of them {wrong[0]}"
        with pytest.raises(
            ValueError, match=rf"a\.{suffix} must contain the sensor position.*for {count}"
        ):
            load_scans(path)
    report = ScanReport()
    read = load_scans(path, origin=(max(shifts), 2, 3) if wrong else None, report=report)
    expected = np.where(np.isin(range(len(shifts)), wrong), max(shifts), shifts)
    assert read.origins[:, 0].tolist() == expected.tolist()
    ends = np.concatenate([sensor_points() + place * ahead for place in places])
    np.testing.assert_allclose(read.ends, ends, rtol=0, atol=1e-4)
    assert ("is assumed to be valid (guess" in str(report)) == (not wrong)


@pytest.mark.parametrize("missing", [0, 1])
def test_an_origin_goes_to_the_scan_of_an_e57_that_has_no_pose(tmp_path, missing):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")
    shift = np.array([4.0, 5.0, 6.0])
    columns = {f"cartesian{axis}": sensor_points()[:, i] for i, axis in enumerate("XYZ")}
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        for number in range(2):
            if number == missing:
                append_without_pose(file, columns)
            else:
                file.write_scan_raw(columns, translation=shift)
    with pytest.raises(
        ValueError, match=rf"does not for 1 of 2 scans, the first of them {missing}"
    ):
        load_scans(tmp_path / "a.e57")
    scans = load_scans(tmp_path / "a.e57", origin=(1, 2, 3))
    assert scans.origins[missing].tolist() == [1, 2, 3]
    assert scans.origins[1 - missing].tolist() == [4, 5, 6]
    moved = scans.ends[scans.scan_id == 1 - missing]
    np.testing.assert_allclose(moved, sensor_points() + shift, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "name",
    [
        "ply-ascii",
        "ply-little",
        "ply-big",
        "pcd-ascii",
        "pcd-binary",
        "pcd-packed",
        "xyz-spaces",
        "csv-header",
    ],
)
def test_points_at_exactly_zero_are_left_out_and_counted(tmp_path, name):
    path = tmp_path / f"a.{name.partition('-')[0]}"
    path.write_bytes(file_content(name, with_zeros(world_points())))
    options = {"frame": "world"} if name.startswith("pcd") else {"origin": POSITION}
    report = ScanReport()
    with pytest.warns(ScanFileWarning, match=r"80 points at exactly zero are left out"):
        scans = load_scans(path, report=report, **options)
    np.testing.assert_array_equal(scans.ends, without_third(world_points()))
    assert "80 points at exactly zero are left out" in str(report)
    with pytest.warns(ScanFileWarning):
        assert every_reader(path, **options) == [160, 160, 160]


@needs_laspy
@pytest.mark.parametrize("offset", [0.0, 0.25, 3.5])
def test_points_of_a_las_file_at_exactly_zero_are_left_out(tmp_path, offset):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [1e-4] * 3, [offset] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = with_zeros(world_points()).T
    cloud.write(str(tmp_path / "a.las"))
    with pytest.warns(ScanFileWarning, match="80 points at exactly zero"):
        scans = load_scans(tmp_path / "a.las", origin=POSITION)
    np.testing.assert_allclose(scans.ends, without_third(world_points()), rtol=0, atol=1e-4)


def test_points_of_an_e57_at_exactly_zero_are_left_out_with_and_without_pose(tmp_path):
    write_e57(tmp_path / "a.e57", [with_zeros(sensor_points())], None, [POSITION])
    write_e57(tmp_path / "b.e57", [with_zeros(world_points())])
    with pytest.warns(ScanFileWarning, match="80 points at exactly zero"):
        posed = load_scans(tmp_path / "a.e57")
    np.testing.assert_allclose(posed.ends, without_third(sensor_points()) + POSITION, atol=1e-5)
    with pytest.warns(ScanFileWarning, match="80 points at exactly zero"):
        given = load_scans(tmp_path / "b.e57", origin=POSITION)
    np.testing.assert_allclose(given.ends, without_third(world_points()), atol=1e-5)


def test_a_file_of_zeros_alone_has_no_point(tmp_path):
    (tmp_path / "a.xyz").write_text("0 0 0\n" * 5)
    with (
        pytest.warns(ScanFileWarning),
        pytest.raises(
            ValueError, match=r"a\.xyz.*at least one point is needed.*5 points at exactly"
        ),
    ):
        load_scans(tmp_path / "a.xyz", origin=(1, 2, 3))


@needs_laspy
@pytest.mark.parametrize(
    ("version", "point_format"), [("1.2", 1), ("1.2", 3), ("1.4", 6), ("1.4", 7)]
)
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_withheld_points_are_left_out(tmp_path, version, point_format, suffix):
    laspy = pytest.importorskip("laspy")
    cloud = laspy.create(point_format=point_format, file_version=version)
    cloud.header.scales = [1e-4] * 3
    points = world_points()
    cloud.x, cloud.y, cloud.z = points.T
    cloud.withheld = np.arange(len(points)) % 4 == 0
    path = tmp_path / f"a.{suffix}"
    cloud.write(str(path))
    read = laspy.read(str(path))
    expected = np.stack([read.x, read.y, read.z], axis=1)[np.asarray(read.withheld) == 0]
    report = ScanReport()
    scans = load_scans(path, origin=POSITION, report=report)
    np.testing.assert_array_equal(scans.ends, expected)
    assert "60 points flagged as withheld are left out" in str(report)
    assert every_reader(path, origin=POSITION) == [180, 180, 180]
    np.testing.assert_array_equal(load_points(path), expected)


@needs_laspy
def test_a_las_file_with_the_legacy_count_alone_is_read(tmp_path):
    laspy = pytest.importorskip("laspy")
    cloud = laspy.create(point_format=1, file_version="1.4")
    cloud.header.scales = [1e-4] * 3
    cloud.x, cloud.y, cloud.z = world_points().T
    cloud.write(str(tmp_path / "a.las"))
    content = bytearray((tmp_path / "a.las").read_bytes())
    assert int.from_bytes(content[247:255], "little") == 240
    content[247:255] = bytes(8)
    content[107:111] = (240).to_bytes(4, "little")
    (tmp_path / "a.las").write_bytes(content)
    scans = load_scans(tmp_path / "a.las", origin=POSITION)
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-4)


def test_a_folder_of_files_with_and_without_position_takes_an_origin_for_the_latter(tmp_path):
    write_pcd(tmp_path / "a.pcd", world_points(), "1.5 -0.75 1.25 1 0 0 0")
    (tmp_path / "b.xyz").write_bytes(file_content("xyz-spaces", world_points()))
    assert every_reader(tmp_path, origin=(1, 2, 3)) == [480, 480, 480]
    assert load_scans(tmp_path, origin=(1, 2, 3)).origins.tolist() == [POSITION.tolist(), [1, 2, 3]]
    (tmp_path / "b.xyz").unlink()
    write_pcd(tmp_path / "b.pcd", world_points(), "1.5 -0.75 1.25 1 0 0 0")
    for scans in (
        iter_scans(tmp_path, origin=(1, 2, 3)),
        iter_pieces(tmp_path, Reading(origin=(1, 2, 3))),
    ):
        with pytest.raises(ValueError, match="origin must be left out"):
            list(scans)


@pytest.mark.parametrize("frame", ["sensor", "world"])
def test_a_pose_file_beside_an_e57_without_a_pose_is_used_when_the_frame_is_said(tmp_path, frame):
    points = sensor_points() if frame == "sensor" else world_points()
    write_e57(tmp_path / "a.e57", [points])
    write_poses(tmp_path / "poses.txt", pose()[None])
    with pytest.raises(ValueError, match=r'poses\.txt beside it.*frame="sensor" or frame="world"'):
        load_scans(tmp_path / "a.e57")
    scans = load_scans(tmp_path / "a.e57", frame=frame)
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-5)
    assert scans.origins.tolist() == [POSITION.tolist()]


def test_a_frame_is_refused_for_an_e57_with_poses(tmp_path):
    write_e57(tmp_path / "a.e57", [sensor_points()], None, [POSITION])
    with pytest.raises(ValueError, match=r"a\.e57.*other formats state their frame"):
        load_scans(tmp_path / "a.e57", frame="sensor")
