"""Which line of a pose file belongs to which scan, and of which frame its poses are."""

from pathlib import Path

import numpy as np
import pytest
from drives import Drive, assert_rays, room_drive
from healthy_files import write_tum
from scan_files import pcd_header, write_poses
from scipy.spatial.transform import Rotation

from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import iter_scans, load_scans

DRIVE = room_drive()
CAMERA_FROM_LIDAR = np.eye(4)
CAMERA_FROM_LIDAR[:3] = [[0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]
CAMERA_FROM_LIDAR[:3, :3] = (
    Rotation.from_euler("xyz", [0.01, -0.02, 0.015]).as_matrix() @ CAMERA_FROM_LIDAR[:3, :3]
)
STEMS = ["000000", "000001", "000002"]
ENDINGS = [".bin", ".pcd", ".xyz"]


def write_scans(folder: Path, stems=STEMS, ending: str = ".bin", drive: Drive = DRIVE) -> dict:
    """The scans of a drive, each in its sensor's frame, and how to read them."""
    folder.mkdir(exist_ok=True)
    for stem, scan in zip(stems, drive.scans, strict=True):
        path = folder / f"{stem}{ending}"
        if ending == ".bin":
            np.c_[scan, np.zeros(len(scan))].astype("<f4").tofile(path)
        elif ending == ".pcd":
            header = pcd_header("binary", len(scan), viewpoint="0 0 0 1 0 0 0")
            path.write_bytes(header + scan.tobytes())
        else:
            np.savetxt(path, scan, fmt="%.17g")
    return {} if ending == ".bin" else {"frame": "sensor"}


def entry(name: str, matrix: np.ndarray) -> str:
    return f"{name} {' '.join(map(repr, matrix.reshape(-1).tolist()))}\n"


def of_camera(poses: np.ndarray) -> np.ndarray:
    """Poses of the camera in the frame of its first image, as KITTI publishes them."""
    first = np.linalg.inv(poses[0])
    return CAMERA_FROM_LIDAR @ first @ poses @ np.linalg.inv(CAMERA_FROM_LIDAR)


def from_first() -> Drive:
    """The drive in the frame of its first scan."""
    first = np.linalg.inv(DRIVE.poses[0])
    return Drive(first @ DRIVE.poses, DRIVE.scans, DRIVE.ends @ first[:3, :3].T + first[:3, 3])


PROJECTION = entry("P0:", np.eye(4)[:3])
ROTATED = Rotation.from_euler("xyz", [0.002, 0.004, -0.003]).as_matrix()
BEFORE_ROTATION = CAMERA_FROM_LIDAR.copy()
BEFORE_ROTATION[:3] = ROTATED.T @ CAMERA_FROM_LIDAR[:3]
CALIBS = {
    "odometry": PROJECTION + entry("Tr:", CAMERA_FROM_LIDAR[:3]),
    "object": entry("R0_rect:", ROTATED) + entry("Tr_velo_to_cam:", BEFORE_ROTATION[:3]),
    "tracking": entry("R_rect", ROTATED) + entry("Tr_velo_cam", BEFORE_ROTATION[:3]),
    "without rectification": entry("Tr_velo_to_cam:", CAMERA_FROM_LIDAR[:3]),
}


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("calib", list(CALIBS))
def test_poses_of_the_camera_are_moved_to_the_lidar_by_calib(tmp_path, ending, calib):
    how = write_scans(tmp_path / "velodyne", ending=ending)
    write_poses(tmp_path / "poses.txt", of_camera(DRIVE.poses))
    (tmp_path / "calib.txt").write_text(CALIBS[calib])
    report = ScanReport()
    assert_rays(load_scans(tmp_path / "velodyne", report=report, **how), from_first())
    assert "poses assumed to be the camera's, as KITTI publishes them" in str(report)
    given = load_scans(tmp_path / "velodyne", poses_frame="camera", strict=True, **how)
    assert_rays(given, from_first())


def test_the_calibration_of_raw_recordings_is_read(tmp_path):
    write_scans(tmp_path)
    write_poses(tmp_path / "poses.txt", of_camera(DRIVE.poses))
    rotation, position = entry("R:", BEFORE_ROTATION[:3, :3]), entry("T:", BEFORE_ROTATION[:3, 3])
    (tmp_path / "calib_velo_to_cam.txt").write_text(rotation + position)
    (tmp_path / "calib_cam_to_cam.txt").write_text(entry("R_rect_00:", ROTATED))
    assert_rays(load_scans(tmp_path), from_first())


@pytest.mark.parametrize("ending", ENDINGS)
def test_poses_of_the_lidar_beside_a_complete_calib_must_be_said_to_be_so(tmp_path, ending):
    how = write_scans(tmp_path, ending=ending)
    write_poses(tmp_path / "poses.txt", DRIVE.poses)
    (tmp_path / "calib.txt").write_text(CALIBS["odometry"])
    assert_rays(load_scans(tmp_path, poses_frame="lidar", strict=True, **how), DRIVE)
    assert abs(load_scans(tmp_path, **how).ends.numpy() - DRIVE.ends).max() > 0.1
    with pytest.raises(
        ValueError, match="strict reading refuses a guess: poses assumed to be the cam"
    ):
        load_scans(tmp_path, strict=True, **how)


def test_a_lidar_that_drives_straight_on_by_its_own_poses_warns_beside_calib(tmp_path):
    write_scans(tmp_path)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0, 4, 8
    write_poses(tmp_path / "poses.txt", poses)
    (tmp_path / "calib.txt").write_text(CALIBS["odometry"])
    with pytest.warns(
        ScanFileWarning, match="they would move it sideways or up.*'lidar'"
    ) as warned:
        load_scans(tmp_path)
    assert len(warned) == 1
    np.testing.assert_allclose(load_scans(tmp_path, poses_frame="lidar").origins, poses[:, :3, 3])


def test_a_camera_that_looks_ahead_warns_where_there_is_no_calib(tmp_path):
    write_scans(tmp_path)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 0, 4, 8
    write_poses(tmp_path / "poses.txt", poses)
    with pytest.warns(ScanFileWarning, match="poses assumed to be the lidar's .*uses Tr of calib"):
        load_scans(tmp_path)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("calib", [PROJECTION, "", entry("Tr_imu_to_velo:", np.eye(4)[:3])])
def test_calib_without_the_lidar_asks_for_it(tmp_path, ending, calib):
    how = write_scans(tmp_path, ending=ending)
    write_poses(tmp_path / "poses.txt", of_camera(DRIVE.poses))
    (tmp_path / "calib.txt").write_text(calib)
    with pytest.raises(
        ValueError, match=r"poses\.txt holds poses of the camera; .*calib\.txt.* Tr:"
    ):
        load_scans(tmp_path, **how)
    assert load_scans(tmp_path, poses_frame="lidar", **how).num_scans == 3


@pytest.mark.parametrize("numbers", ["1 2 3", "1 0 0 0 0 2 0 0 0 0 1 0", "a 0 0 0 0 1 0 0 0 0 1 0"])
def test_a_tr_that_is_no_rotation_is_an_error(tmp_path, numbers):
    write_scans(tmp_path)
    write_poses(tmp_path / "poses.txt", of_camera(DRIVE.poses))
    (tmp_path / "calib.txt").write_text(f"Tr: {numbers}\n")
    with pytest.raises(ValueError, match=r"calib\.txt must have .* after tr"):
        load_scans(tmp_path)


def test_poses_of_an_unknown_frame_name_are_an_error(tmp_path):
    write_scans(tmp_path)
    write_poses(tmp_path / "poses.txt", DRIVE.poses)
    with pytest.raises(
        ValueError, match=r'poses_frame must be "camera" or "lidar" .* got \'body\''
    ):
        load_scans(tmp_path, poses_frame="body")


KITTI_360_STEMS = ["0000000003", "0000000004", "0000000009"]


def write_kitti_360(path: Path, numbers: list[int], poses: np.ndarray) -> None:
    rows = np.c_[numbers, poses[:, :3].reshape(-1, 12)]
    np.savetxt(path, rows, fmt=["%d", *["%.17g"] * 12])


def test_kitti_360_lines_are_found_by_their_number_and_moved_to_the_lidar(tmp_path):
    folder = tmp_path / "data"
    write_scans(folder, KITTI_360_STEMS)
    vehicle_from_camera = np.eye(4)
    vehicle_from_camera[:3, 3] = 1.5, 0.3, 0.9
    vehicle_from_camera[:3, :3] = CAMERA_FROM_LIDAR[:3, :3].T
    of_vehicle = DRIVE.poses @ np.linalg.inv(CAMERA_FROM_LIDAR) @ np.linalg.inv(vehicle_from_camera)
    others = np.tile(np.eye(4), (2, 1, 1))
    poses = np.concatenate([others[:1], of_vehicle, others[1:]])
    write_kitti_360(tmp_path / "poses.txt", [1, 3, 4, 9, 12], poses)
    with pytest.raises(
        ValueError, match=r"poses\.txt begins .* KITTI-360 .*calib_cam_to_velo\.txt"
    ):
        load_scans(folder)
    (tmp_path / "calibration").mkdir()
    for name, text in (
        ("calib_cam_to_velo.txt", entry("", np.linalg.inv(CAMERA_FROM_LIDAR)[:3])),
        ("calib_cam_to_pose.txt", entry("image_00:", vehicle_from_camera[:3])),
    ):
        (tmp_path / "calibration" / name).write_text(text)
    assert_rays(load_scans(folder), DRIVE)


def test_kitti_360_scans_without_a_line_are_left_out(tmp_path):
    write_scans(tmp_path, KITTI_360_STEMS)
    write_kitti_360(tmp_path / "poses.txt", [0, 3, 9], DRIVE.poses)
    with pytest.warns(
        ScanFileWarning, match=r"0000000004\.bin: 1 scans left out: poses\.txt has no"
    ):
        scans = load_scans(tmp_path, poses_frame="lidar")
    assert np.allclose(scans.origins, DRIVE.poses[[1, 2], :3, 3])
    (tmp_path / "0000000003.bin").rename(tmp_path / "a.bin")
    with pytest.raises(
        ValueError, match="begins its lines with numbers of scans; names must be num"
    ):
        load_scans(tmp_path, poses_frame="lidar")


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_numbers_of_files_are_no_stamps(tmp_path, ending, start):
    drive = room_drive(30)
    how = write_scans(tmp_path, [f"{i:06d}" for i in range(3)], ending, Drive(
        drive.poses[:3], drive.scans[:3], drive.ends
    ))  # fmt: skip
    write_tum(tmp_path / "poses.txt", start + 0.1 * np.arange(30), drive.poses)
    scans, report = load_scans(tmp_path, **how), ScanReport()
    assert np.allclose(scans.origins, drive.poses[:3, :3, 3])
    load_scans(tmp_path, report=report, **how)
    assert "poses by line number (from 0)" in str(report)


def test_line_numbers_where_stamps_have_a_gap_are_a_guess(tmp_path):
    write_scans(tmp_path)
    poses = np.concatenate([DRIVE.poses, DRIVE.poses])
    write_tum(tmp_path / "poses.txt", [0.0, 0.1, 0.5, 0.6, 0.7, 0.8], poses)
    assert_rays(load_scans(tmp_path), DRIVE)
    with pytest.raises(
        ValueError, match=r"refuses a guess: poses by line number .* stamps have a gap"
    ):
        load_scans(tmp_path, strict=True)


@pytest.mark.parametrize("digits", [10, 13, 16, 19])
def test_names_that_are_stamps_find_their_poses_by_time(tmp_path, digits):
    stamps = 1_700_000_000 + np.arange(3)
    write_scans(tmp_path, [f"{stamp}{'0' * (digits - 10)}" for stamp in stamps])
    between = (DRIVE.poses[:1] + DRIVE.poses[1:2]) / 2
    between[0, :3, :3] = np.eye(3)
    poses = np.concatenate([DRIVE.poses, between])
    write_tum(tmp_path / "trajectory.txt", [*stamps.astype(float), 1_700_000_000.5], poses)
    assert_rays(load_scans(tmp_path), DRIVE)


@pytest.mark.parametrize("ending", ENDINGS)
def test_scans_beyond_the_trajectory_or_in_a_gap_are_left_out(tmp_path, ending):
    drive = room_drive(5)
    stems = ["99.800", "100.000", "100.600", "101.100", "101.300"]
    how = write_scans(tmp_path, stems, ending, drive)
    stamps = [100.0, 100.1, 101.0, 101.1, 101.2]  # as many as there are scans
    write_tum(tmp_path / "trajectory.txt", stamps, drive.poses)
    with pytest.warns(
        ScanFileWarning, match=r"scans left out: trajectory\.txt has no pose"
    ) as warned:
        scans = load_scans(tmp_path, report=(report := ScanReport()), **how)
    assert np.allclose(scans.origins, drive.poses[[0, 3], :3, 3])
    assert len(warned) == 3
    assert f"5 files: 2 scans, {len(scans)} rays" in str(report)  # the first file has no scan
    with pytest.warns(ScanFileWarning):
        assert len(list(iter_scans(tmp_path, report=ScanReport(), **how))) == 2
    for stem in stems:
        (tmp_path / f"{stem}{ending}").rename(tmp_path / f"9{stem}{ending}")
    with pytest.raises(
        ValueError, match=r"has none for 999\.800.*Its stamps are 100\.000 to 101\.2"
    ):
        load_scans(tmp_path, **how)


def test_lines_in_the_order_of_the_names_must_advance_as_they_do(tmp_path):
    write_scans(tmp_path, ["000007", "000008", "000013"])
    write_tum(tmp_path / "poses.txt", [50.0, 50.1, 50.6], DRIVE.poses)
    report = ScanReport()
    assert_rays(load_scans(tmp_path, report=report), DRIVE)
    assert "poses by the order of the names (guess: " in str(report)
    write_tum(tmp_path / "poses.txt", [50.0, 50.1, 50.2], DRIVE.poses)
    with pytest.raises(
        ValueError, match=r"not of the same times: 000008 and 000013 would be 0\.1 s"
    ):
        load_scans(tmp_path)


TUM_COMMENTS = [
    ("# timestamp tx ty tz qw qx qy qz\n", [0, 1, 2, 3, 7, 4, 5, 6]),
    ("# Trajectory\n# time[s] x y z q_w q_x q_y q_z\n# made here\n", [0, 1, 2, 3, 7, 4, 5, 6]),
    ("timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n", [0, 1, 2, 3, 7, 4, 5, 6]),
    ("# qx qy qz qw tx ty tz stamp\n", [4, 5, 6, 7, 1, 2, 3, 0]),
    ("# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n", list(range(8))),
    ("# a comment of eight words that says nothing\n", list(range(8))),
]


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize(("comment", "order"), TUM_COMMENTS)
def test_columns_of_a_trajectory_are_those_that_its_comment_names(tmp_path, comment, order, comma):
    how = write_scans(tmp_path, ["5.000", "5.100", "5.200"], ".pcd")
    turns = Rotation.from_matrix(DRIVE.poses[:, :3, :3]).as_quat()
    rows = np.c_[[5.0, 5.1, 5.2], DRIVE.poses[:, :3, 3], turns][:, order]
    path = tmp_path / "trajectory.txt"
    lines = [("," if comma else " ").join(map(repr, row)) for row in rows.tolist()]
    path.write_text(comment + "\n".join(lines) + "\n")
    assert_rays(load_scans(tmp_path, **how), DRIVE)


def test_a_ground_truth_of_euroc_is_read_by_its_names(tmp_path):
    write_scans(tmp_path, ["1403636580838555648", "1403636581838555648", "1403636582838555648"])
    names = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    )
    names += "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]\n"
    lines = [names]
    for number, pose in enumerate(DRIVE.poses):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        values = [*pose[:3, 3], w, x, y, z, 9.0, 9.0, 9.0]
        lines.append(
            f"{1403636580838555648 + number * 10**9}," + ",".join(map(repr, values)) + "\n"
        )
    (tmp_path / "groundtruth.txt").write_text(
        "".join(lines).replace("np.float64(", "").replace(")", "")
    )
    assert_rays(load_scans(tmp_path), DRIVE)


@pytest.mark.parametrize(("unit", "factor"), [("ns", 1e9), ("us", 1e6), ("ms", 1e3), ("s", 1)])
@pytest.mark.parametrize("says_unit", [True, False])
def test_stamps_of_a_trajectory_may_be_in_other_units(tmp_path, unit, factor, says_unit):
    start = 1_700_000_000.0 if not says_unit else 20.0
    write_scans(tmp_path, [f"{start + i:.3f}" for i in range(3)])
    comment = f"# timestamp[{unit}] tx ty tz qx qy qz qw" if says_unit else "# no unit"
    turns = Rotation.from_matrix(DRIVE.poses[:, :3, :3]).as_quat()
    rows = np.c_[(start + np.arange(3)) * factor, DRIVE.poses[:, :3, 3], turns]
    np.savetxt(
        tmp_path / "poses.txt", rows, fmt=["%d", *["%.17g"] * 7], header=comment, comments=""
    )
    assert_rays(load_scans(tmp_path), DRIVE)


def test_a_half_turn_at_the_start_may_be_no_turn_with_qw_first(tmp_path):
    write_scans(tmp_path, ["5.000", "5.100", "5.200"])
    rows = np.c_[[5.0, 5.1, 5.2], DRIVE.poses[:, :3, 3], np.tile([1.0, 0, 0, 0], (3, 1))]
    np.savetxt(tmp_path / "poses.txt", rows, fmt="%.17g")
    with pytest.warns(ScanFileWarning, match="read as x y z w: a half turn .*qw is first"):
        load_scans(tmp_path)
    header = "timestamp tx ty tz qw qx qy qz"
    np.savetxt(tmp_path / "poses.txt", rows, fmt="%.17g", header=header)
    assert np.allclose(
        load_scans(tmp_path).ends[: len(DRIVE.scans[0])], DRIVE.scans[0] + rows[0, 1:4]
    )


@pytest.mark.parametrize("broken", ["nan", "inf", "quaternion"])
def test_lines_that_hold_no_pose_are_left_out(tmp_path, broken):
    how = write_scans(tmp_path, ["5.000", "5.100", "5.200"], ".pcd")
    turns = Rotation.from_matrix(DRIVE.poses[:, :3, :3]).as_quat()
    rows = np.c_[[5.0, 5.1, 5.2], DRIVE.poses[:, :3, 3], turns]
    lost = (
        np.r_[5.15, np.full(7, float(broken))]
        if broken != "quaternion"
        else np.r_[5.15, np.zeros(7)]
    )
    np.savetxt(tmp_path / "trajectory.txt", np.insert(rows, 2, lost, axis=0), fmt="%.17g")
    report = ScanReport()
    assert_rays(load_scans(tmp_path, report=report, **how), DRIVE)
    assert "1 lines of trajectory.txt hold no pose" in str(report)


@pytest.mark.parametrize("layout", ["kitti", "tum"])
def test_a_line_of_nan_still_counts_where_lines_have_numbers(tmp_path, layout):
    write_scans(tmp_path)
    poses = DRIVE.poses.copy()
    poses[1] = np.nan
    if layout == "kitti":
        write_poses(tmp_path / "poses.txt", poses)
    else:
        turns = np.full((3, 4), np.nan)
        turns[[0, 2]] = Rotation.from_matrix(DRIVE.poses[[0, 2], :3, :3]).as_quat()
        rows = np.c_[[0.0, 0.1, 0.2], poses[:, :3, 3], turns]
        np.savetxt(tmp_path / "poses.txt", rows, fmt="%.17g")
    with pytest.warns(ScanFileWarning, match=r"000001\.bin: 1 scans left out"):
        scans = load_scans(tmp_path)
    assert np.allclose(scans.origins, DRIVE.poses[[0, 2], :3, 3])


@pytest.mark.parametrize("layout", ["kitti", "tum"])
def test_a_mark_of_utf_8_before_the_first_line_is_no_part_of_it(tmp_path, layout):
    write_scans(tmp_path)
    more = np.concatenate([DRIVE.poses, DRIVE.poses + 1e-9])  # as many lines and more
    if layout == "kitti":
        write_poses(tmp_path / "poses.txt", more)
    else:
        write_tum(tmp_path / "poses.txt", np.arange(6.0), more)
    text = (tmp_path / "poses.txt").read_bytes()
    (tmp_path / "poses.txt").write_bytes(b"\xef\xbb\xbf" + text)
    assert_rays(load_scans(tmp_path), DRIVE)


def test_poses_of_16_numbers_are_whole_matrices(tmp_path):
    write_scans(tmp_path)
    np.savetxt(tmp_path / "poses.txt", DRIVE.poses.reshape(-1, 16), fmt="%.17g")
    assert_rays(load_scans(tmp_path), DRIVE)
