"""Beams without return in PTX, organized PCD and E57 files."""

import numpy as np
import pytest
from room_scan import (
    POSITION,
    TURN,
    append_without_pose,
    pose,
    ptx,
    sensor_points,
    with_zeros,
)
from scan_files import pcd_header

from lardhm_torch import simulate_room
from lardhm_torch.io.no_returns import grid_directions
from lardhm_torch.io.notes import ScanFileWarning, ScanReport
from lardhm_torch.io.scan_files import load_scans


def grid_of_room(columns=40, rows=15):
    """(C R, 3) points on a grid of angles, column by column, by ranges of the room; and directions."""
    azimuth = np.linspace(-1, 1, columns)[:, None]
    elevation = np.linspace(-0.5, 0.6, rows)
    flat = np.cos(elevation)
    directions = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) * np.ones((columns, 1))],
        axis=-1,
    ).reshape(-1, 3)
    ranges = simulate_room(num_rays=columns * rows, seed=5).ranges.numpy()
    return ranges[:, None] * directions, directions


@pytest.mark.parametrize("seed", range(3))
def test_beams_without_return_of_a_ptx_have_the_direction_of_their_place_in_the_grid(
    tmp_path, seed
):
    points, directions = grid_of_room()
    is_lost = np.random.default_rng(seed).random(len(points)) < 0.2
    measured = np.where(is_lost[:, None], 0, points.round(6))
    (tmp_path / "a.ptx").write_text(ptx(measured, (40, 15), POSITION, pose()))
    report = ScanReport()
    scans = load_scans(tmp_path / "a.ptx", report=report)
    assert len(scans) == len(points)
    np.testing.assert_allclose(scans.hits, points[~is_lost] @ TURN.T + POSITION, rtol=0, atol=1e-5)
    beams = (scans.ends[~scans.is_return].numpy() - POSITION) @ TURN
    lengths = np.linalg.norm(beams, axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(points[~is_lost], axis=1).max(), rtol=1e-5)
    np.testing.assert_allclose(beams / lengths[:, None], directions[is_lost], rtol=0, atol=1e-5)
    assert f"{is_lost.sum()} beams without return" in str(report)


def organized_pcd(path, points, shape, viewpoint):
    """A PCD file of rows and columns; the points come row by row."""
    header = pcd_header("binary", len(points), viewpoint=viewpoint).decode()
    header = header.replace(f"WIDTH {len(points)}\nHEIGHT 1\n", "WIDTH {1}\nHEIGHT {0}\n")
    path.write_bytes(header.format(*shape).encode() + points.astype("<f8").tobytes())


HALF, SHIFT = 0.5**0.5, np.eye(4)
SHIFT[:3, 3] = POSITION
VIEWPOINTS = {  # where the points are, VIEWPOINT, and how the file is read
    "identity": (np.eye(4), "0 0 0 1 0 0 0", {}),
    "identity and origin": (np.eye(4), "0 0 0 1 0 0 0", {"origin": (0, 0, 0)}),
    "shift": (SHIFT, "1.5 -0.75 1.25 1 0 0 0", {}),
    "sensor frame": (pose(), f"1.5 -0.75 1.25 {HALF} 0 0 {HALF}", {"frame": "sensor"}),
}


@pytest.mark.parametrize("by_column", [True, False])
@pytest.mark.parametrize("name", VIEWPOINTS)
def test_points_of_nan_in_an_organized_pcd_are_beams_without_return(tmp_path, name, by_column):
    world_from_sensor, viewpoint, how = VIEWPOINTS[name]
    points, directions = grid_of_room()
    is_lost = np.random.default_rng(1).random(600) < 0.2
    order = np.arange(600) if by_column else np.arange(600).reshape(40, 15).T.ravel()
    measured = np.where(is_lost[:, None], np.nan, points)
    if "frame" not in how:
        measured = measured + world_from_sensor[:3, 3]
    shape = (40, 15) if by_column else (15, 40)
    organized_pcd(tmp_path / "a.pcd", measured[order], shape, viewpoint)
    report = ScanReport()
    scans = load_scans(tmp_path / "a.pcd", report=report, **how)
    turn, shift = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
    hits = points[order][~is_lost[order]] @ turn.T + shift
    np.testing.assert_allclose(scans.hits, hits, rtol=0, atol=1e-9)
    np.testing.assert_allclose(scans.origins[0], shift, rtol=0, atol=1e-12)
    beams = (scans.ends[~scans.is_return].numpy() - shift) @ turn
    longest = np.linalg.norm(points[~is_lost], axis=1).max()
    expected = longest * directions[order][is_lost[order]]
    np.testing.assert_allclose(beams, expected, rtol=0, atol=1e-9)
    assert f"{is_lost.sum()} beams without return" in str(report)
    with pytest.raises(ValueError, match="strict reading refuses a guess"):
        load_scans(tmp_path / "a.pcd", strict=True, **how)


def test_points_of_nan_stay_where_a_pcd_is_no_grid_of_angles_around_the_sensor(tmp_path):
    points, _ = grid_of_room()
    points[::7] = np.nan
    for viewpoint, origin in (("0 0 0 1 0 0 0", (5, 5, 5)), ("5 5 5 1 0 0 0", None)):
        organized_pcd(tmp_path / "a.pcd", points, (40, 15), viewpoint)
        scans = load_scans(tmp_path / "a.pcd", origin=origin)
        assert bool(scans.is_return.all())
        np.testing.assert_array_equal(scans.ends, points)


def test_zeros_of_a_ptx_that_is_no_grid_of_angles_are_left_out(tmp_path):
    (tmp_path / "a.ptx").write_text(ptx(with_zeros(sensor_points()), (12, 20), POSITION, pose()))
    with pytest.warns(ScanFileWarning, match="80 points at exactly zero are left out"):
        scans = load_scans(tmp_path / "a.ptx")
    assert len(scans) == 160
    assert bool(scans.is_return.all())


def test_a_column_of_a_grid_without_any_point_has_no_direction():
    points, directions = grid_of_room()
    grid = points.reshape(40, 15, 3)
    grid[7] = 0
    found = grid_directions(grid.reshape(-1, 3), (40, 15))
    is_known = np.isfinite(found).all(axis=1)
    assert is_known.reshape(40, 15).all(axis=1).tolist() == [column != 7 for column in range(40)]
    np.testing.assert_allclose(found[is_known], directions[is_known], rtol=0, atol=1e-9)


@pytest.mark.parametrize("layout", ["cartesian", "spherical"])
def test_beams_of_an_e57_whose_range_alone_is_invalid_have_no_return(tmp_path, layout):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")
    points = sensor_points()
    state = np.arange(240) % 3
    ranges = np.linalg.norm(points, axis=1)
    unit = points / ranges[:, None]
    written = np.where((state == 1)[:, None], unit, points)
    if layout == "spherical":
        angles = (
            np.arctan2(written[:, 1], written[:, 0]),
            np.arcsin(written[:, 2] / np.linalg.norm(written, axis=1)),
        )
        columns = {"sphericalRange": np.linalg.norm(written, axis=1)}
        columns |= {"sphericalAzimuth": angles[0], "sphericalElevation": angles[1]}
    else:
        columns = {f"cartesian{axis}": written[:, i] for i, axis in enumerate("XYZ")}
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        append_without_pose(file, {**columns, f"{layout}InvalidState": state})
    scans = load_scans(tmp_path / "a.e57", origin=(0, 0, 0))
    assert scans.is_return.tolist() == (state[state != 2] == 0).tolist()
    np.testing.assert_allclose(scans.hits, points[state == 0], rtol=0, atol=1e-9)
    beams = scans.ends[~scans.is_return]
    np.testing.assert_allclose(beams, unit[state == 1] * ranges[state == 0].max(), atol=1e-9)
