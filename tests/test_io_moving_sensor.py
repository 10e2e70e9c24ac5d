"""LAS files of a moving scanner with a trajectory by GPS time, written by laspy."""

from pathlib import Path

import numpy as np
import pytest
import torch
from healthy_files import write_tum
from scan_files import UTM, needs_laspy

from lardhm_torch.io import scan_files
from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import iter_pieces, iter_scans, load_scans
from lardhm_torch.simulation import true_ranges

pytestmark = needs_laspy

START = 417_123_456.0  # adjusted standard GPS time [s]
GPS_WEEK = (START + 1e9) % 604_800
CLOCKS = {
    "adjusted": START,
    "week": GPS_WEEK,
    "gps": START + 1e9,
    "unix": START + 1e9 + 315_964_800 - 18,
}


def at(times: np.ndarray) -> np.ndarray:
    """(n, 3) where the scanner is, seconds after the start: on a line, then around a corner."""
    x = 1.5 + 1.2 * np.minimum(times, 2.0)
    y = 1.8 + 0.9 * np.maximum(times - 2.0, 0.0)
    return np.stack([x, y, np.full_like(times, 1.2)], axis=1)


def room_points(num_points: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(n,) times in disorder and (n, 3) points of the room, as seen from there."""
    rng = np.random.default_rng(seed)
    times = rng.uniform(0.0, 3.0, num_points).round(6)
    beams = rng.normal(size=(num_points, 3))
    beams[:, 2] = -abs(beams[:, 2])  # down, so that none leaves through the window
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    starts = at(times)
    ranges = true_ranges(torch.as_tensor(starts), torch.as_tensor(beams)).numpy()
    ranges = np.where(np.isfinite(ranges), ranges, 2.0)
    return times, starts + beams * ranges[:, None] + UTM


def write_mobile_las(path: Path, clock: str = "adjusted", point_format: int = 6):
    import laspy

    times, points = room_points()
    las = laspy.create(file_version="1.4", point_format=point_format)
    las.header.scales, las.header.offsets = [1e-3] * 3, UTM
    las.header.global_encoding.gps_time_type = (
        laspy.header.GpsTimeType.WEEK_TIME if clock == "week" else laspy.header.GpsTimeType.STANDARD
    )
    las.x, las.y, las.z = points.T
    las.gps_time = times + CLOCKS[clock]
    las.return_number = np.ones(len(points), dtype=np.uint8)
    las.write(path)
    return times, np.stack([las.x, las.y, las.z], axis=1)


def write_track(path: Path, clock: str = "adjusted", columns: int = 4, step=0.005, header=""):
    times = np.arange(-0.1, 3.1, step)
    rows = np.c_[times + CLOCKS[clock], at(times) + UTM, np.zeros((len(times), columns - 4))]
    np.savetxt(path, rows, fmt="%.9f", header=header, comments="")


def assert_seen(scans, times: np.ndarray, points: np.ndarray, atol: float = 2e-3) -> None:
    np.testing.assert_array_equal(scans.ends, points)
    np.testing.assert_allclose(scans.ray_origins, at(times) + UTM, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize("point_format", [1, 3, 6, 7])
@pytest.mark.parametrize("columns", [4, 7])
def test_each_point_is_seen_from_its_position(tmp_path, name, point_format, columns):
    seen = write_mobile_las(tmp_path / name, point_format=point_format)
    write_track(tmp_path / "trajectory.txt", columns=columns)
    report = ScanReport()
    for frame in (None, "world"):
        assert_seen(load_scans(tmp_path / name, frame=frame, strict=True, report=report), *seen)
    assert "each point seen from its position in trajectory.txt" in str(report)


@pytest.mark.parametrize("of_points", list(CLOCKS)[:2])
@pytest.mark.parametrize("of_track", list(CLOCKS))
def test_points_and_trajectory_may_use_different_clocks(tmp_path, of_points, of_track):
    seen = write_mobile_las(tmp_path / "a.las", of_points)
    write_track(tmp_path / "sbet.txt", of_track)
    assert_seen(load_scans(tmp_path / "a.las"), *seen)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("GPS_TIME EASTING NORTHING HEIGHT ROLL PITCH", [0, 1, 2, 3, 4, 5]),
        ("# time[s] x y z roll pitch", [0, 1, 2, 3, 4, 5]),
        ("# roll pitch x y z gps_time", [4, 5, 1, 2, 3, 0]),
    ],
)
def test_columns_of_a_trajectory_are_found_by_name(tmp_path, header, order):
    seen = write_mobile_las(tmp_path / "a.las")
    write_track(tmp_path / "trajectory.txt", columns=6)
    rows = np.loadtxt(tmp_path / "trajectory.txt")[:, order]
    np.savetxt(tmp_path / "trajectory.txt", rows, fmt="%.9f", header=header, comments="")
    assert_seen(load_scans(tmp_path / "a.las"), *seen)


def test_lines_of_tum_serve_as_a_trajectory(tmp_path):
    seen = write_mobile_las(tmp_path / "a.las")
    times = np.arange(-0.1, 3.1, 0.01)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = at(times) + UTM
    write_tum(tmp_path / "trajectory.txt", times + START, poses)
    assert_seen(load_scans(tmp_path / "a.las"), *seen, atol=5e-3)


def test_a_trajectory_of_one_position_a_second_is_no_gap(tmp_path):
    times, _ = write_mobile_las(tmp_path / "a.las")
    write_track(tmp_path / "trajectory.txt", step=1.0)
    is_covered = times <= 2.9
    with pytest.warns(ScanFileWarning, match=r"points left out: trajectory\.txt does not cover"):
        scans = load_scans(tmp_path / "a.las")
    stamps = np.arange(-0.1, 3.1, 1.0)
    straight = [np.interp(times[is_covered], stamps, axis) for axis in (at(stamps) + UTM).T]
    np.testing.assert_allclose(scans.ray_origins, np.stack(straight, axis=1), atol=2e-3)


def test_points_beyond_a_trajectory_or_in_a_gap_are_left_out(tmp_path):
    times, points = write_mobile_las(tmp_path / "a.las")
    write_track(tmp_path / "trajectory.txt")
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    since = rows[:, 0] - START
    rows = rows[((since > 0.5) & (since < 1.0)) | ((since > 1.8) & (since < 2.5))]
    np.savetxt(tmp_path / "trajectory.txt", rows, fmt="%.9f")
    is_known = ((times > 0.51) & (times < 0.99)) | ((times > 1.81) & (times < 2.49))
    is_unknown = (times < 0.49) | ((times > 1.01) & (times < 1.79)) | (times > 2.51)
    with pytest.warns(ScanFileWarning, match="points left out"):
        scans = load_scans(tmp_path / "a.las")
    assert is_known.sum() <= len(scans) <= len(times) - is_unknown.sum()
    kept = (scans.ends.numpy()[:, None] == points[None]).all(axis=2).any(axis=0)
    assert kept[is_known].all()
    assert not kept[is_unknown].any()


def test_a_trajectory_of_another_day_or_of_other_coordinates_is_an_error(tmp_path):
    write_mobile_las(tmp_path / "a.las")
    write_track(tmp_path / "trajectory.txt")
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    np.savetxt(tmp_path / "trajectory.txt", rows + np.array([86_400, 0, 0, 0]), fmt="%.9f")
    with pytest.raises(
        ValueError, match=r"a\.las cannot.*trajectory\.txt must cover the GPS times"
    ):
        load_scans(tmp_path / "a.las")
    np.savetxt(tmp_path / "trajectory.txt", rows * [1, 1e-4, 1e-5, 1], fmt="%.9f")  # degrees
    with pytest.raises(
        ValueError, match=r"trajectory\.txt must be in the coordinates of the points"
    ):
        load_scans(tmp_path / "a.las")
    (tmp_path / "trajectory.txt").write_text("nan nan nan nan\n")
    with pytest.raises(ValueError, match=r"must hold lines of time x y z; none is finite"):
        load_scans(tmp_path / "a.las")


def test_the_caller_and_pose_files_of_other_times_go_before_a_trajectory(tmp_path):
    write_mobile_las(tmp_path / "a.las")
    write_track(tmp_path / "trajectory.txt")
    scans = load_scans(tmp_path / "a.las", origin=tuple(UTM))
    assert scans.origins.tolist() == [UTM.tolist()]
    pose = np.eye(4)[None]
    pose[0, :3, 3] = UTM
    write_tum(tmp_path / "trajectory.txt", [0.0], pose)
    scans = load_scans(tmp_path / "a.las", frame="world")
    assert scans.origins.tolist() == [UTM.tolist()]
    with pytest.raises(ValueError, match=r'For trajectory\.txt: frame="sensor" or frame="world"'):
        load_scans(tmp_path / "a.las")


def test_pieces_and_packets_hold_the_same_rays(tmp_path, monkeypatch):
    times, _ = write_mobile_las(tmp_path / "a.laz")
    write_track(tmp_path / "trajectory.txt")
    whole = load_scans(tmp_path / "a.laz")
    pieces = list(iter_pieces(tmp_path / "a.laz", max_rays=150))
    assert [len(piece) for piece in pieces] == [150, 150, 100]
    assert torch.equal(torch.cat([piece.ends for piece in pieces]), whole.ends)
    starts = torch.cat([piece.ray_origins for piece in pieces])
    torch.testing.assert_close(starts, whole.ray_origins, rtol=0, atol=2e-3)
    monkeypatch.setattr(scan_files, "PACKET_RAYS", 150)
    packets = list(iter_scans(tmp_path / "a.laz"))
    assert [len(packet) for packet in packets] == [150, 150, 100]
    order = whole.scan_id.argsort(stable=True)
    assert (np.diff(times[order]) > -1e-3).all()  # a millimeter takes less than that
    assert torch.equal(torch.cat([packet.ends for packet in packets]), whole.ends[order])
    starts = torch.cat([packet.ray_origins for packet in packets])
    assert torch.equal(starts, whole.ray_origins[order])
