"""Binary and text layouts that look like others: .bin of other columns, named columns, PTS, PTX."""

import numpy as np
import pytest
from room_scan import (
    POSITION,
    pose,
    ptx,
    sensor_points,
    world_points,
)
from scan_files import write_poses

from lardhm_torch import simulate_room
from lardhm_torch.io.notes import ScanReport
from lardhm_torch.io.scan_files import load_points, load_scans


def with_columns(points, columns, seed):
    """The points with intensities, rings and times as scanners have them, or without."""
    rng = np.random.default_rng(seed)
    more = np.stack(
        [
            rng.integers(0, 256, len(points)),
            rng.integers(0, 32, len(points)),
            rng.random(len(points)) / 10,
            rng.integers(0, 60_000, len(points)),
            rng.integers(0, 4, len(points)),
        ],
        axis=1,
    )
    return np.hstack([points, more])[:, :columns]


@pytest.mark.parametrize(
    ("kind", "columns"),
    [
        ("<f4", 3),
        ("<f4", 5),
        ("<f4", 6),
        ("<f8", 3),
        ("<f8", 4),
        ("<f4", 7),
        ("<f4", 8),
        ("<f8", 5),
    ],
)
@pytest.mark.parametrize("count", [120, 240])
def test_a_bin_file_of_another_layout_is_recognized_by_its_values(tmp_path, kind, columns, count):
    points = sensor_points(count)
    with_columns(points, columns, 0).astype(kind).tofile(tmp_path / "000000.bin")
    write_poses(tmp_path / "poses.txt", pose()[None])
    report = ScanReport()
    scans = load_scans(tmp_path, report=report)
    np.testing.assert_allclose(scans.ends, world_points(count), rtol=0, atol=1e-6)
    assert f"{columns} columns of float" in str(report)
    with pytest.raises(ValueError, match=r"000000\.bin: strict reading refuses a guess"):
        load_scans(tmp_path, strict=True)


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite_do_not_hide_the_layout(tmp_path, columns, bad):
    points = sensor_points()
    rows = with_columns(points, columns, 3).astype("<f4")
    rows[::3, :3] = bad
    rows.tofile(tmp_path / "a.bin")
    read = load_points(tmp_path / "a.bin")
    np.testing.assert_array_equal(read, rows[:, :3].astype(np.float64))


@pytest.mark.parametrize("scale", [1.0, 0.01, 100.0])
@pytest.mark.parametrize("fourth", ["intensity", "zeros", "index"])
def test_kitti_files_are_read_as_ever(tmp_path, scale, fourth):
    points = scale * sensor_points()
    column = {"intensity": np.random.default_rng(0).random(240), "zeros": np.zeros(240)}
    column["index"] = np.arange(240)
    np.hstack([points, column[fourth][:, None]]).astype("<f4").tofile(tmp_path / "a.bin")
    report = ScanReport()
    scans = load_scans(tmp_path / "a.bin", origin=(0, 0, 0), report=report, strict=True)
    np.testing.assert_allclose(scans.ends, points, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fourth", [0.0, 1.0, 255.0])
@pytest.mark.parametrize("place", range(0, 8000, 1000))
def test_small_patches_of_one_intensity_are_read_as_kitti_files(tmp_path, place, fourth):
    hits = simulate_room(num_rays=12_000, seed=3).hits.numpy()
    patch = hits[np.linalg.norm(hits - hits[place], axis=1) < 0.6] - (0, 0, 1)
    assert len(patch) > 30
    rows = np.hstack([patch, np.full((len(patch), 1), fourth)]).astype("<f4")
    rows.tofile(tmp_path / "a.bin")
    scans = load_scans(tmp_path / "a.bin", origin=(0, 0, 0), strict=True)
    np.testing.assert_array_equal(scans.ends, rows[:, :3])


def test_coordinates_alone_that_vary_alike_may_have_three_or_four_columns(tmp_path):
    ball = np.random.default_rng(0).normal(size=(2000, 3)).astype("<f4")
    ball.tofile(tmp_path / "a.bin")
    with pytest.raises(ValueError, match=r"a\.bin cannot be read: it may have three columns"):
        load_scans(tmp_path / "a.bin", origin=(0, 0, 0))
    ball[:1999].tofile(tmp_path / "a.bin")  # no whole number of points of four columns
    np.testing.assert_array_equal(load_points(tmp_path / "a.bin"), ball[:1999])


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("step", [0.0, 2**-8])
def test_doubles_that_were_floats_or_whole_steps_are_doubles(tmp_path, columns, step):
    points = sensor_points().astype("f4").astype(np.float64)
    points = np.round(points / step) * step if step else points
    with_columns(points, columns, 2).astype("<f8").tofile(tmp_path / "a.bin")
    np.testing.assert_array_equal(load_points(tmp_path / "a.bin"), points)


def test_nuscenes_names_mean_five_columns(tmp_path):
    with_columns(sensor_points(), 5, 1).astype("<f4").tofile(tmp_path / "sweep.pcd.bin")
    scans = load_scans(tmp_path / "sweep.pcd.bin", origin=(0, 0, 0), strict=True)
    np.testing.assert_allclose(scans.ends, sensor_points(), rtol=0, atol=1e-6)


def test_a_bin_file_of_cloudcompare_is_named(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"CCB2" + bytes(60))
    with pytest.raises(
        ValueError, match=r"a\.bin cannot be read: it is a \.bin file of CloudCompare"
    ):
        load_scans(tmp_path / "a.bin", origin=(0, 0, 0))


def test_floats_of_the_other_byte_order_are_refused(tmp_path):
    with_columns(sensor_points(), 4, 0).astype(">f4").tofile(tmp_path / "a.bin")
    with pytest.raises(ValueError, match=r"a\.bin cannot be read: points of 16 bytes.*Convert"):
        load_scans(tmp_path / "a.bin", origin=(0, 0, 0))


def test_bytes_of_no_known_layout_are_an_error_that_says_so(tmp_path):
    np.zeros((101, 11), "<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(ValueError, match=r"a\.bin cannot be read: points of 16 bytes.*Convert"):
        load_scans(tmp_path / "a.bin", origin=(0, 0, 0))


TABLE = np.hstack([np.arange(240)[:, None] + 7, world_points(), np.ones((240, 1))])
HEADS = {
    "an earlier comment": "# id X Y Z n\n# made by a tool\n#\n",
    "units in brackets": "# id x[m] y[m] z[m] n[-]\n",
    "units in parentheses": "id x (m) y (m) z (m) n\n",
    "commas": "# id, X, Y, Z, n\n# 240 points\n",
    "a label before": "# columns: id x y z n\n",
    "quotes": '"id" "x" "y" "z" "n"\n',
    "percent": "% id x y z n\n",
    "semicolon": "; id X Y Z n\n",
    "two slashes": "//id X Y Z n\n",
    "units after the names": "# id,x_m,y_m,z_m,n\n",
    "positions": "# id pos_x pos_y pos_z n\n",
    "compass": "# id Easting Northing Height n\n",
    "the first line": "id x y z n\n",
}


@pytest.mark.parametrize("head", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize("suffix", ["txt", "xyz", "csv"])
def test_columns_go_by_the_names_that_a_header_gives(tmp_path, head, suffix):
    delimiter = "," if suffix == "csv" else " "
    with open(tmp_path / f"a.{suffix}", "w") as file:
        file.write(
            head.replace(" (", "(").replace(" ", delimiter)
            if suffix == "csv" and head[0] in '"i'
            else head
        )
        np.savetxt(file, TABLE, fmt="%.10g", delimiter=delimiter)
    points = load_points(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(points, world_points(), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "head",
    [
        "x [mm],y [mm],z [mm]\n",
        "X (ft),Y (ft),Z (ft)\n",
        "# x(cm) y(cm) z(cm)\n",
        '"x" (mm),"y" (mm),"z" (mm)\n',
    ],
)
def test_coordinates_in_other_units_are_refused(tmp_path, head):
    rows = "".join(",".join(map(repr, row)) + "\n" for row in world_points().tolist())
    (tmp_path / "a.csv").write_text(head + rows)
    with pytest.raises(ValueError, match=r"a\.csv.*column x is in (mm|ft|cm).*must be in meters"):
        load_scans(tmp_path / "a.csv", origin=POSITION)


@pytest.mark.parametrize(
    "comment",
    ["# the sensor was at x = 1, y = 2\n", "# points in x and y and z\n", "# x y z in meters\n"],
)
def test_prose_that_mentions_coordinates_names_no_columns(tmp_path, comment):
    (tmp_path / "a.xyz").write_text(comment + "1 2 3\n4 5 6\n")
    assert load_points(tmp_path / "a.xyz").tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("start", [0, 1, 1000])
def test_a_first_column_that_counts_the_rows_is_no_coordinate(tmp_path, start):
    rows = np.hstack([np.arange(240)[:, None] + start, world_points()])
    np.savetxt(tmp_path / "a.txt", rows)
    with pytest.raises(ValueError, match=r"a\.txt.*counts the rows.*Name them in the first line"):
        load_points(tmp_path / "a.txt")


def test_unnamed_columns_past_the_third_are_a_guess(tmp_path):
    np.savetxt(tmp_path / "a.txt", np.hstack([world_points(), np.ones((240, 1))]))
    report = ScanReport()
    load_scans(tmp_path / "a.txt", origin=POSITION, report=report)
    assert "first three columns assumed to be x y z (guess: name the columns" in str(report)
    with pytest.raises(ValueError, match="strict"):
        load_scans(tmp_path / "a.txt", origin=POSITION, strict=True)


@pytest.mark.parametrize("name", ["a.pts", "a.txt", "a.xyz"])
@pytest.mark.parametrize("columns", ["", " -1200", " -1200 255 128 0"])
@pytest.mark.parametrize("head", ["", "//X Y Z I R G B\n"])
def test_a_count_line_before_the_points_is_no_point(tmp_path, name, columns, head):
    rows = "".join(" ".join(map(repr, row)) + columns + "\n" for row in world_points().tolist())
    (tmp_path / name).write_text(f"{head}240\n{rows}")
    np.testing.assert_array_equal(load_scans(tmp_path / name, origin=POSITION).ends, world_points())
    (tmp_path / name).write_text(f"{head}241\n{rows}")
    with pytest.raises(ValueError, match=rf"{name}.*241 points are declared; got 240"):
        load_points(tmp_path / name)
    (tmp_path / name).write_text(f"{head}239\n{rows}")
    with pytest.raises(ValueError, match=rf"{name}.*239 points are declared; more lines follow"):
        load_points(tmp_path / name)


def test_a_pts_file_of_several_scans_keeps_them_apart(tmp_path):
    text = "2\n1 2 3 0\n4 5 6 0\n1\n7 8 9 0\n"
    (tmp_path / "a.pts").write_text(text)
    scans = load_scans(tmp_path / "a.pts", origin=(0, 0, 1))
    assert scans.ends.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert scans.scan_id.tolist() == [0, 0, 1]


@pytest.mark.parametrize("head", ["", "240\n", "x y z\n", "# x y z\n"])
@pytest.mark.parametrize("suffix", ["xyz", "txt", "pts"])
def test_a_mark_of_utf_8_is_no_part_of_the_text(tmp_path, head, suffix):
    content = head + "".join(" ".join(map(repr, row)) + "\n" for row in world_points().tolist())
    (tmp_path / f"a.{suffix}").write_text(content, encoding="utf-8-sig")
    np.testing.assert_array_equal(load_points(tmp_path / f"a.{suffix}"), world_points())


@pytest.mark.parametrize("columns", [" 0.5", " 0.5 255 0 128"])
@pytest.mark.parametrize("position", [POSITION, np.zeros(3)])
def test_ptx_points_go_through_the_matrix_and_start_at_the_scanner(tmp_path, columns, position):
    content = ptx(sensor_points(), (12, 20), position, pose(), columns)
    (tmp_path / "a.ptx").write_text(content)
    scans = load_scans(tmp_path / "a.ptx", strict=True)
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-12)
    assert scans.origins.tolist() == [POSITION.tolist()]
    assert bool(scans.is_return.all())


def test_a_ptx_of_registered_points_starts_at_the_scanner_position(tmp_path):
    (tmp_path / "a.ptx").write_text(ptx(world_points(), (12, 20), POSITION, np.eye(4)))
    scans = load_scans(tmp_path / "a.ptx")
    np.testing.assert_allclose(scans.ends, world_points(), rtol=0, atol=1e-12)
    assert scans.origins.tolist() == [POSITION.tolist()]


def test_scans_of_a_ptx_without_any_position_are_placeholders(tmp_path):
    one = ptx(sensor_points(), (12, 20), np.zeros(3), np.eye(4))
    (tmp_path / "a.ptx").write_text(one)
    assert load_scans(tmp_path / "a.ptx").origins.tolist() == [[0, 0, 0]]
    (tmp_path / "a.ptx").write_text(one + one)
    with pytest.raises(
        ValueError, match=r"a\.ptx must contain the sensor position.*2 scans have it"
    ):
        load_scans(tmp_path / "a.ptx")


def test_a_ptx_whose_position_and_matrix_disagree_is_refused(tmp_path):
    (tmp_path / "a.ptx").write_text(ptx(sensor_points(), (12, 20), POSITION + 1, pose()))
    with pytest.raises(ValueError, match=r"a\.ptx.*position .* and translation .* must agree"):
        load_scans(tmp_path / "a.ptx")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-200], r"points are declared; got|number of columns|invalid column"),
        (lambda text: text.replace("12\n", "-12\n", 1), "must be a count"),
        (
            lambda text: text.replace("12\n", "99999999999\n", 1),
            "points are declared; .* are too few",
        ),
        (lambda text: "12\n20\n1 2\n" + text, "a 4 x 4 matrix"),
        (lambda text: text.replace("1.5", "east", 1), "a header must hold numbers"),
        (lambda text: text.replace("-1.0", "-3.0"), "must hold rotations and positions"),
    ],
)
def test_what_is_wrong_in_a_ptx_is_said(tmp_path, change, message):
    text = ptx(sensor_points(), (12, 20), POSITION, pose())
    assert change(text) != text
    (tmp_path / "a.ptx").write_text(change(text))
    with pytest.raises(ValueError, match=rf"a\.ptx cannot be read: .*({message})"):
        load_scans(tmp_path / "a.ptx")
