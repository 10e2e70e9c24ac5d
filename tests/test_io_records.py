"""PLY, PCD and text: every format gives the same points."""

import numpy as np
import pytest
import trimesh
from scan_files import (
    HAND_MADE,
    RAMP,
    UTM,
    lzf_literals,
    pcd_header,
    real_scans,
    some_points,
    write_by_hand,
)

from lardhm_torch.io.pcd import decompress_lzf
from lardhm_torch.io.scan_files import load_points, load_scans


@pytest.mark.parametrize("name", HAND_MADE)
def test_utm_coordinates_come_through_exactly(tmp_path, name):
    points = some_points() + UTM
    assert np.array_equal(load_points(write_by_hand(tmp_path, name, points)), points)


@pytest.mark.parametrize("name", HAND_MADE)
def test_real_points_come_through_exactly(data, tmp_path, name):
    points = real_scans(data, "balm_realworld")["points"][::1000].astype(np.float64)
    assert np.array_equal(load_points(write_by_hand(tmp_path, name, points)), points)


@pytest.mark.parametrize("name", [name for name in HAND_MADE if "mark" not in name])
def test_points_that_are_nan_are_kept_for_the_sampler_to_count(tmp_path, name):
    points = some_points()
    points[[3, 77]] = np.nan
    points[5, 0] = np.inf
    assert np.array_equal(
        load_points(write_by_hand(tmp_path, name, points)), points, equal_nan=True
    )


def test_signaling_nan_is_a_nan_like_any_other(tmp_path):
    values = np.array([[0x7F800001, 0, 0]], "<u4")
    (tmp_path / "scan.pcd").write_bytes(pcd_header("binary", 1, size=4) + values.tobytes())
    assert load_points(tmp_path / "scan.pcd").isnan().tolist() == [[True, False, False]]


@pytest.mark.parametrize("name", ["ply-ascii", "ply-big", "pcd-binary", "xyz-spaces"])
def test_files_without_z_are_2d(tmp_path, name):
    points = some_points(dim=2)
    assert np.array_equal(load_points(write_by_hand(tmp_path, name, points)), points)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_mesh_that_trimesh_wrote_gives_its_vertices(tmp_path, encoding):
    mesh = trimesh.creation.box((1, 2, 3))
    (tmp_path / "mesh.ply").write_bytes(mesh.export(file_type="ply", encoding=encoding))
    assert np.array_equal(load_points(tmp_path / "mesh.ply"), mesh.vertices)


def test_elements_and_properties_that_are_not_needed_are_passed_over(tmp_path):
    body = np.array([(9, 9, 1.5, 7, 2.5, 3.5)], ">u1,>i4,>f4,>u2,>f8,>f4").tobytes()
    header = "ply\nformat binary_big_endian 1.0\nelement camera 1\nproperty uchar a\n"
    header += "property int b\nelement vertex 1\nproperty float x\nproperty ushort red\n"
    header += "property double y\nproperty float z\nelement face 9\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "scan.ply").write_bytes(header.encode() + body)
    assert load_points(tmp_path / "scan.ply").tolist() == [[1.5, 2.5, 3.5]]


def test_text_elements_before_the_vertices_are_passed_over(tmp_path):
    header = "ply\nformat ascii 1.0\nelement strip 2\nproperty list uchar int indices\n"
    header += "element vertex 1\nproperty float x\nproperty float y\nend_header\n"
    (tmp_path / "scan.ply").write_text(header + "3 0 1 2\n2 7 8\n1.5 2.5\n")
    assert load_points(tmp_path / "scan.ply").tolist() == [[1.5, 2.5]]


def test_pcd_fields_may_come_in_any_order_type_and_count(tmp_path):
    record = np.dtype("V3,<i2,<f8,2<u4,<f4")
    rows = np.zeros(2, record)
    rows["f1"], rows["f2"], rows["f4"] = [3, -4], [1.5, 2.5], [5, 6]
    header = "FIELDS _ y x rgb z\nSIZE 1 2 8 4 4\nTYPE U I F U F\nCOUNT 3 1 1 2 1\n"
    header += "WIDTH 2\nHEIGHT 1\nDATA binary\n"
    (tmp_path / "scan.pcd").write_bytes(header.encode() + rows.tobytes() + b"\0" * 4000)
    assert load_points(tmp_path / "scan.pcd").tolist() == [[1.5, 3, 5], [2.5, -4, 6]]


@pytest.mark.parametrize(
    ("packed", "unpacked"),
    [
        (b"\x02abc", b"abc"),
        (b"\x02abc\x20\x02", b"abcabc"),  # three bytes, three back
        (b"\x00a\xe0\x05\x00", b"a" * 15),  # one back, 7 + 5 + 2 bytes: runs into itself
        (b"\x01ab\x40\x01\x00c", b"abababc"),
        (lzf_literals(RAMP) + b"\x21\x3f", RAMP + RAMP[:3]),  # 256 + 63 + 1 back
        (b"", b""),
    ],
)
def test_lzf_gives_the_bytes_worked_out_by_hand(packed, unpacked):
    assert decompress_lzf(packed, len(unpacked)) == unpacked


@pytest.mark.parametrize(
    "packed", [b"\x05abc", b"\x00a\x20", b"\x00a\x20\x01", b"\xe0", b"\x20\x00"]
)
def test_broken_lzf_is_an_error(packed):
    with pytest.raises(ValueError, match="compressed points"):
        decompress_lzf(packed, 4)


def test_the_viewpoint_of_a_pcd_is_the_origin_and_moves_nothing(tmp_path):
    points = some_points()
    turned = "1 2 3 0 0 0 1"
    content = pcd_header("binary", len(points), viewpoint=turned) + points.tobytes()
    (tmp_path / "scan.pcd").write_bytes(content)
    scans = load_scans(tmp_path / "scan.pcd", frame="world")
    assert scans.origins.tolist() == [[1, 2, 3]]
    assert np.array_equal(scans.ends, points)


def test_the_original_pcd_files_give_the_stored_scans(data):
    """All but is_return: the files do not say which beams met nothing."""
    arrays = real_scans(data, "la3dm_sim_structured")
    scans = load_scans(data / "la3dm_sim_structured/pcd")
    assert np.array_equal(scans.ends, arrays["points"].astype(np.float64))
    assert np.array_equal(scans.origins, arrays["origins"])
    assert np.array_equal(scans.scan_id, arrays["scan_id"])
    assert np.array_equal(scans.ranges < 10, arrays["is_return"])


def test_a_viewpoint_at_zero_gives_way_to_an_origin(tmp_path):
    content = pcd_header("ascii", 1, viewpoint="0 0 0 1 0 0 0") + b"1 2 3\n"
    (tmp_path / "scan.pcd").write_bytes(content)
    assert load_scans(tmp_path / "scan.pcd").origins.tolist() == [[0, 0, 0]]
    assert load_scans(tmp_path / "scan.pcd", origin=(4, 5, 6)).origins.tolist() == [[4, 5, 6]]
