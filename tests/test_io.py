"""Which files a path stands for, and where the sensor stood."""

import numpy as np
import pytest
import torch
from scan_files import as_text, pcd_header, ply_header, some_points, write_by_hand

from lardhm_torch.io.scan_files import load_scans, save_scans
from lardhm_torch.scans import Scans


@pytest.mark.parametrize("name", ["csv", "ply", "pcd"])
def test_rows_with_one_origin_are_one_scan(tmp_path, name):
    rows = np.c_[some_points(6), [[5, 0, 0], [5, 0, 0], [1, 0, 0], [1, 0, 0], [5, 0, 0], [2, 0, 0]]]
    names = "x y z ox oy oz"
    content = {
        "csv": names.replace(" ", ",").encode() + b"\n" + as_text(rows, ","),
        "ply": ply_header("binary_little_endian", 6, names) + rows.tobytes(),
        "pcd": pcd_header("ascii", 6, names) + as_text(rows),
    }[name]
    (tmp_path / f"scan.{name}").write_bytes(content)
    scans = load_scans(tmp_path / f"scan.{name}")
    assert scans.origins[:, 0].tolist() == [5, 1, 2]
    assert scans.scan_id.tolist() == [0, 0, 1, 1, 0, 2]
    assert np.array_equal(scans.ray_origins, rows[:, 3:])


def test_named_columns_give_scan_return_and_target(tmp_path):
    text = "# x y scan_id is_return return_number\n1 2 7 1 1\n3 4 7 0 2\n5 6 3 1 1\n"
    (tmp_path / "scan.txt").write_text(text)
    scans = load_scans(tmp_path / "scan.txt", origin=(0.5, 0.25))
    assert scans.scan_id.tolist() == [1, 1, 0]
    assert scans.is_return.tolist() == [True, False, True]
    assert scans.target_index.tolist() == [1, 2, 1]
    assert scans.origins.tolist() == [[0.5, 0.25]] * 2


@pytest.mark.parametrize("name", ["ply-little", "xyz-spaces", "csv-header"])
def test_a_file_without_sensor_position_takes_the_one_that_is_given(tmp_path, name):
    path = write_by_hand(tmp_path, name, some_points())
    assert load_scans(path, origin=(1, 2, 3)).origins.tolist() == [[1, 2, 3]]
    with pytest.raises(ValueError, match=r"the sensor position.*origin=\(x, y, z\).*--origin"):
        load_scans(path)
    with pytest.raises(ValueError, match=r"origin must be \(3,\).*got \(1, 2\)"):
        load_scans(path, origin=(1, 2))
    with pytest.raises(ValueError, match="origins must be finite"):
        load_scans(path, origin=(1, 2, float("nan")))


def test_an_origin_that_no_file_needs_is_an_error(tmp_path):
    path = write_by_hand(tmp_path, "pcd-binary", some_points())
    with pytest.raises(ValueError, match="origin must be left out"):
        load_scans(path, origin=(0, 0, 0))


def test_a_folder_is_read_in_natural_order_and_only_its_scans(tmp_path):
    for number in (10, 9, 1, 100):
        content = pcd_header("ascii", 1) + f"{number} 0 0\n".encode()
        (tmp_path / f"scan_{number}.PCD").write_bytes(content)
    for other in ("poses.txt", "notes.txt", "README.txt", ".hidden.pcd", "frame-1.pose.txt"):
        (tmp_path / other).write_text("none")
    (tmp_path / "deeper.pcd").mkdir()
    scans = load_scans(tmp_path)
    assert scans.ends[:, 0].tolist() == [1, 9, 10, 100]
    assert scans.scan_id.tolist() == [0, 1, 2, 3]


def test_text_files_are_scans_where_a_folder_has_no_others(tmp_path):
    for number in (10, 9):
        (tmp_path / f"{number}.txt").write_text(f"{number} 0 0\n")
    (tmp_path / "poses.txt").write_text("1 2\n")
    assert load_scans(tmp_path, origin=(0, 0, 0)).ends[:, 0].tolist() == [9, 10]


def test_several_paths_are_read_in_the_order_given(tmp_path):
    first = write_by_hand(tmp_path, "csv-header", some_points())
    second = tmp_path / "many.npz"
    save_scans(Scans(torch.ones(2, 3), torch.ones(4, 3), torch.tensor([0, 1, 1, 0])), second)
    scans = load_scans([second, str(first)], origin=(0, 0, 0))
    assert scans.scan_id.tolist() == [0, 1, 1, 0] + [2] * 200
    assert scans.origins.tolist() == [[1, 1, 1], [1, 1, 1], [0, 0, 0]]


def test_paths_that_lead_to_no_scan_are_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no .*missing\.ply"):
        load_scans(tmp_path / "missing.ply")
    with pytest.raises(ValueError, match=r"at least one scan \(\.bag .*\.xyz\).* has none"):
        load_scans(tmp_path)
    with pytest.raises(ValueError, match="at least one file or folder; got an empty list"):
        load_scans([])
    (tmp_path / "scan.docx").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"end in one of \.bag .*\.xyz; got .*scan\.docx"):
        load_scans(tmp_path / "scan.docx")


def test_files_of_two_dimensions_do_not_mix(tmp_path):
    flat = write_by_hand(tmp_path, "xyz-spaces", some_points(dim=2))
    solid = write_by_hand(tmp_path, "ply-ascii", some_points())
    with pytest.raises(ValueError, match=r"one dimension; got 2 in .*scan\.xyz, 3 in .*scan\.ply"):
        load_scans([flat, solid], origin=(0, 0, 0))
