"""What other libraries write is read with the same coordinates, and what we write they read.

Right values are what was written, or what the other library reads.
"""

import numpy as np
import pytest
from room_scan import POSITION, QUATERNION, sensor_points, with_zeros, world_points
from scan_files import needs_laspy

from lardhm_torch.io.notes import ScanReport
from lardhm_torch.io.scan_files import load_points, load_scans

UTM = np.array([500_000.0, 4_500_000.0, 100.0])


def library(name):
    """An optional library, or a skip that says so."""
    reason = f"{name} is not installed, or lacks a library of the system"
    return pytest.importorskip(name, reason=reason, exc_type=ImportError)


@pytest.mark.parametrize("write_ascii", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_pcd_files_of_open3d_are_read(tmp_path, write_ascii, compressed):
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(sensor_points()))
    cloud.normals = o3d.utility.Vector3dVector(world_points())
    path = str(tmp_path / "a.pcd")
    assert o3d.io.write_point_cloud(path, cloud, write_ascii=write_ascii, compressed=compressed)
    expected = np.asarray(o3d.io.read_point_cloud(path).points)
    np.testing.assert_array_equal(load_points(path), expected)
    np.testing.assert_allclose(expected, sensor_points(), rtol=0, atol=1e-6)
    assert load_scans(path).origins.tolist() == [[0, 0, 0]]  # VIEWPOINT 0 0 0 1 0 0 0


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY", "BINARY_COMPRESSED"])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_pcd_files_of_pypcd4_are_read(tmp_path, encoding, kind):
    pypcd4 = library("pypcd4")
    fields, types = ("x", "y", "z", "intensity"), (kind, kind, kind, np.float32)
    points = np.hstack([world_points(), np.ones((240, 1))])
    cloud = pypcd4.PointCloud.from_points(points, fields, types)
    half = 0.5**0.5
    cloud.metadata.viewpoint = (*POSITION.tolist(), half, 0.0, 0.0, half)
    cloud.save(tmp_path / "a.pcd", encoding=getattr(pypcd4.Encoding, encoding))
    expected = pypcd4.PointCloud.from_path(tmp_path / "a.pcd").numpy(("x", "y", "z"))
    scans = load_scans(tmp_path / "a.pcd", frame="world")
    np.testing.assert_array_equal(scans.ends.numpy().astype(kind), expected.astype(kind))
    np.testing.assert_allclose(scans.origins[0], POSITION, rtol=0, atol=1e-6)
    moved = load_scans(tmp_path / "a.pcd", frame="sensor")
    turned = np.stack([-expected[:, 1], expected[:, 0], expected[:, 2]], axis=1) + POSITION
    np.testing.assert_allclose(moved.ends, turned, rtol=0, atol=1e-5)


def test_organized_clouds_of_pypcd4_keep_their_points_without_measurement_out(tmp_path):
    pypcd4 = library("pypcd4")
    points = sensor_points().astype(np.float32)
    points[::4] = np.nan
    cloud = pypcd4.PointCloud.from_xyz_points(points)
    cloud.metadata.width, cloud.metadata.height = 20, 12
    cloud.save(tmp_path / "a.pcd")
    report = ScanReport()
    scans = load_scans(tmp_path / "a.pcd", report=report)
    np.testing.assert_array_equal(scans.ends.numpy().astype(np.float32), points)
    assert "60 points are not finite" in str(report)


def test_pcd_padding_of_any_type_is_passed_over(tmp_path):
    points = sensor_points().astype("<f4")
    header = (
        "VERSION 0.7\nFIELDS x y z _ intensity _\nSIZE 4 4 4 1 4 1\nTYPE F F F F F U\n"
        "COUNT 1 1 1 4 1 12\nWIDTH 240\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 240\n"
        "DATA binary\n"
    )
    rows = np.zeros((240, 32), np.uint8)
    rows[:, :12] = points.view(np.uint8).reshape(240, 12)
    (tmp_path / "a.pcd").write_bytes(header.encode() + rows.tobytes())
    np.testing.assert_array_equal(load_points(tmp_path / "a.pcd"), points.astype(np.float64))


@pytest.mark.parametrize("byte_order", ["<", ">", "="])
@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_ply_files_of_plyfile_are_read(tmp_path, byte_order, text, kind):
    plyfile = library("plyfile")
    points = world_points() + (UTM if kind == "f8" else 0)
    vertices = np.zeros(240, [("red", "u1"), ("x", kind), ("y", kind), ("z", kind), ("t", "f4")])
    for i, name in enumerate("xyz"):
        vertices[name] = points[:, i]
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element], text=text, byte_order=byte_order).write(str(tmp_path / "a.ply"))
    read = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    expected = np.stack([read["x"], read["y"], read["z"]], axis=1).astype(np.float64)
    np.testing.assert_array_equal(load_points(tmp_path / "a.ply"), expected)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("lengths", ["equal", "different", "empty"])
@pytest.mark.parametrize("first", [True, False])
def test_list_properties_of_ply_vertices_and_of_elements_before_them_are_passed_over(
    tmp_path, text, lengths, first
):
    plyfile = library("plyfile")
    points, rng = world_points(), np.random.default_rng(0)
    names = [("seen_by", "O"), ("x", "f8"), ("y", "f8"), ("z", "f8")]
    vertices = np.empty(240, names if first else names[1:] + names[:1])
    for i, name in enumerate("xyz"):
        vertices[name] = points[:, i]
    counts = {"equal": [3] * 240, "different": rng.integers(0, 6, 240), "empty": [0] * 240}[lengths]
    for number, count in enumerate(counts):
        vertices["seen_by"][number] = rng.integers(0, 1000, count).astype("i4")
    strips = np.empty(2, [("indices", "O")])
    strips["indices"][:] = [np.arange(5, dtype="i4"), np.arange(2, dtype="i4")]
    elements = [
        plyfile.PlyElement.describe(strips, "strip"),
        plyfile.PlyElement.describe(vertices, "vertex", val_types={"seen_by": "i4"}),
    ]
    plyfile.PlyData(elements, text=text).write(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(load_points(tmp_path / "a.ply"), points)


@pytest.mark.parametrize("binary", [True, False])
def test_ply_files_of_meshio_are_read(tmp_path, binary):
    meshio = library("meshio")
    mesh = meshio.Mesh(world_points() + UTM, [("triangle", [[0, 1, 2]])])
    meshio.write(str(tmp_path / "a.ply"), mesh, binary=binary)
    expected = meshio.read(str(tmp_path / "a.ply")).points
    np.testing.assert_array_equal(load_points(tmp_path / "a.ply"), expected)
    np.testing.assert_allclose(expected, world_points() + UTM, rtol=0, atol=1e-6)


@pytest.mark.parametrize("write_ascii", [True, False])
def test_ply_files_of_open3d_are_read(tmp_path, write_ascii):
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(world_points()))
    path = str(tmp_path / "a.ply")
    assert o3d.io.write_point_cloud(path, cloud, write_ascii=write_ascii)
    expected = np.asarray(o3d.io.read_point_cloud(path).points)
    np.testing.assert_array_equal(load_points(path), expected)


@needs_laspy
@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 7, 8])
def test_las_files_of_laspy_are_read(tmp_path, suffix, point_format):
    laspy = library("laspy")
    cloud = laspy.create(point_format=point_format)
    cloud.header.offsets, cloud.header.scales = UTM.round(-3), [1e-3] * 3
    cloud.x, cloud.y, cloud.z = (world_points() + UTM).T
    cloud.return_number = np.arange(240) % 3 + 1
    path = tmp_path / f"a.{suffix}"
    cloud.write(str(path))
    read = laspy.read(str(path))
    scans = load_scans(path, origin=UTM)
    np.testing.assert_array_equal(scans.ends, np.stack([read.x, read.y, read.z], axis=1))
    np.testing.assert_array_equal(scans.target_index, read.return_number)


@pytest.mark.parametrize("intensity", [True, False])
def test_e57_files_of_pye57_are_read(tmp_path, intensity):
    pye57 = library("pye57")
    columns = {f"cartesian{axis}": sensor_points()[:, i] for i, axis in enumerate("XYZ")}
    if intensity:
        columns["intensity"] = np.linspace(0, 1, 240)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        for shift in (0, 10):
            file.write_scan_raw(
                columns, rotation=np.array(QUATERNION), translation=POSITION + shift
            )
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        read = [file.read_scan(number, ignore_missing_fields=True) for number in range(2)]
    expected = np.stack(
        [np.concatenate([part[f"cartesian{a}"] for part in read]) for a in "XYZ"], 1
    )
    scans = load_scans(tmp_path / "a.e57")
    np.testing.assert_allclose(scans.ends, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(scans.ends[:240], world_points(), rtol=0, atol=1e-5)
    assert scans.origins.tolist() == [POSITION.tolist(), (POSITION + 10).tolist()]


def test_text_files_of_open3d_are_read(tmp_path):
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(with_zeros(world_points())[1:]))
    cloud.colors = o3d.utility.Vector3dVector(np.ones((239, 3)))
    for suffix in ("xyz", "pts"):
        assert o3d.io.write_point_cloud(str(tmp_path / f"a.{suffix}"), cloud)
        expected = np.asarray(o3d.io.read_point_cloud(str(tmp_path / f"a.{suffix}")).points)
        np.testing.assert_array_equal(load_points(tmp_path / f"a.{suffix}"), expected)
