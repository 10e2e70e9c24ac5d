"""Color, intensity and classes through every format that has them, written by its own library."""

import dataclasses

import numpy as np
import pytest
import torch
from healthy_files import BagMaker, write_depth_images
from scan_files import needs_laspy, some_points, write_kitti

from lardhm_torch.io.channel_columns import scaled_colors, unpacked_colors
from lardhm_torch.io.scan_files import Camera, iter_pieces, load_scans
from lardhm_torch.scans import concatenate_scans

COUNT = 200
BYTES = np.random.default_rng(1).integers(0, 256, (COUNT, 3)).astype(np.uint8)
BYTES[0] = 255
CLASSES = np.random.default_rng(2).integers(1, 30, COUNT)
INTENSITY = np.random.default_rng(3).integers(0, 2**15, COUNT).astype(np.float32)
ORIGIN = (0.0, 0.0, 0.0)


def points_of(count=COUNT):
    return some_points()[:count]


def assert_colors(scans, expected=BYTES / 255):
    torch.testing.assert_close(scans.channels["color"].double(), torch.tensor(expected).double(),
                               rtol=0, atol=1e-6)  # fmt: skip


def assert_values(scans, name, expected):
    assert scans.channels[name].tolist() == np.asarray(expected).tolist()


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize(("kind", "scale"), [("u1", 1), ("u2", 257), ("f4", 1 / 255)])
def test_ply_files_of_plyfile(tmp_path, text, kind, scale):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra dev)")
    names = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("intensity", "f4"), ("label", "u2")]
    rows = np.empty(COUNT, [*names, ("red", kind), ("green", kind), ("blue", kind)])
    rows["x"], rows["y"], rows["z"] = points_of().T
    rows["red"], rows["green"], rows["blue"] = (BYTES.astype(float) * scale).T
    rows["intensity"], rows["label"] = INTENSITY, CLASSES
    path = tmp_path / "a.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=text).write(str(path))
    for scans in (load_scans(path, ORIGIN), concatenate_scans(list(pieces(path)))):
        assert_colors(scans)
        assert_values(scans, "intensity", INTENSITY)
        assert_values(scans, "class", CLASSES)


def pieces(path):
    from lardhm_torch.io.scan_files import Reading

    return iter_pieces(path, Reading(origin=ORIGIN), max_rays=64)


@pytest.mark.parametrize(
    ("encoding", "is_float"),  # pypcd4 writes floats of 1e-38 as 0.0000000000 in text
    [("ASCII", False), *((e, f) for e in ("BINARY", "BINARY_COMPRESSED") for f in (True, False))],
)
def test_pcd_files_of_pypcd4_with_packed_colors(tmp_path, encoding, is_float):
    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed (extra dev)")
    words = (BYTES.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(1).astype(np.uint32)
    colors = words.view(np.float32) if is_float else words
    fields = ("x", "y", "z", "rgb", "intensity", "label")
    types = (np.float64,) * 3 + ((np.float32 if is_float else np.uint32), np.float32, np.uint32)
    columns = [*points_of().T, colors, INTENSITY, CLASSES]
    cloud = pypcd4.PointCloud.from_points(columns, fields, types)
    cloud.save(tmp_path / "a.pcd", encoding=getattr(pypcd4.Encoding, encoding))
    scans = load_scans(tmp_path / "a.pcd", ORIGIN)
    assert_colors(scans)
    assert_values(scans, "intensity", INTENSITY)
    assert_values(scans, "class", CLASSES)


def test_pcd_text_has_packed_colors_as_the_decimals_of_a_float(tmp_path):
    words = np.array([0x00FF8001, 0x00010203], np.uint32)
    lines = [f"{i} 1 2 {value:.9g}" for i, value in enumerate(words.view(np.float32))]
    header = "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    header += "WIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(header + "\n".join(lines) + "\n")
    scans = load_scans(tmp_path / "a.pcd", ORIGIN)
    assert_colors(scans, np.array([[255, 128, 1], [1, 2, 3]]) / 255)


@needs_laspy
@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("scale", [1, 257])
def test_las_files_of_laspy_with_colors_of_8_and_16_bits(tmp_path, suffix, scale):
    import laspy

    las = laspy.create(file_version="1.4", point_format=7)
    las.header.scales = [1e-4] * 3
    las.x, las.y, las.z = points_of().T
    las.return_number = np.ones(COUNT, np.uint8)
    las.red, las.green, las.blue = (BYTES.astype(np.uint16) * scale).T
    las.intensity, las.classification = INTENSITY.astype(np.uint16), CLASSES.astype(np.uint8)
    las.classification[:3] = 0
    path = tmp_path / f"a.{suffix}"
    las.write(path)
    scans = load_scans(path, ORIGIN)
    assert_colors(scans)
    assert_values(scans, "intensity", INTENSITY)
    assert_values(scans, "class", [-1, -1, -1, *CLASSES[3:]])  # 0: never classified
    parts = concatenate_scans(list(pieces(path)))
    torch.testing.assert_close(parts.channels["color"], scans.channels["color"])


@needs_laspy
def test_las_colors_are_of_16_bits_from_the_first_large_value_on(tmp_path):
    from lardhm_torch.io.las_channels import BYTE, WORD, joined_channels

    dark, bright = np.full((2, 3), 255 / 255, np.float32), np.full((1, 3), 0.5, np.float32)
    joined = joined_channels([({"color": dark}, 2, BYTE), ({"color": bright}, 1, WORD)])
    np.testing.assert_allclose(joined["color"][:2], 255 / 65535)
    np.testing.assert_allclose(joined["color"][2], 0.5)


@needs_laspy
def test_las_dimensions_without_values_are_no_channels(tmp_path):
    import laspy

    las = laspy.create(file_version="1.4", point_format=7)
    las.x, las.y, las.z = points_of().T
    las.write(tmp_path / "a.las")
    assert load_scans(tmp_path / "a.las", ORIGIN).channels == {}


def test_e57_files_of_pye57(tmp_path):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")
    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points_of().T, strict=True))
    columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), BYTES.T, strict=True))
    columns["intensity"] = INTENSITY.astype(np.float64)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(columns, translation=np.array([1.0, 2, 3]), rotation=[1.0, 0, 0, 0])
    scans = load_scans(tmp_path / "a.e57")
    assert_colors(scans)
    assert_values(scans, "intensity", INTENSITY)


@pytest.mark.parametrize("name", ["a.bag", "a.db3"])
@pytest.mark.parametrize("is_float", [True, False])
def test_point_clouds_of_rosbags(tmp_path, name, is_float):
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra io)")
    maker = BagMaker(is_ros1=name.endswith(".bag"))
    kinds = [
        ("x", "<f4", 7),
        ("y", "<f4", 7),
        ("z", "<f4", 7),
        ("rgb", "<u4", 7 if is_float else 6),
    ]
    kinds += [("intensity", "<f4", 7), ("label", "<u2", 4), ("ring", "u1", 2)]
    rows = np.zeros(COUNT, [entry[:2] for entry in kinds])
    rows["x"], rows["y"], rows["z"] = points_of().T
    words = (BYTES.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(1)
    rows["rgb"], rows["intensity"], rows["label"] = words, INTENSITY, CLASSES
    rows["ring"] = np.arange(COUNT) % 16
    topic, kind, stamp, cloud = maker.cloud(points_of(), 1.0)
    fields = [
        maker._make("sensor_msgs/msg/PointField", field, rows.dtype.fields[field][1], number, 1)
        for field, _, number in kinds
    ]
    step = rows.dtype.itemsize
    changes = {"fields": fields, "point_step": step, "row_step": step * COUNT}
    data = np.frombuffer(rows.tobytes(), np.uint8)
    cloud = dataclasses.replace(cloud, **changes, data=data)
    messages = [(topic, kind, stamp, cloud)]
    messages += [maker.odometry(np.eye(4), at) for at in (0.9, 1.0, 1.1)]
    scans = load_scans(maker.write(tmp_path / name, messages))
    assert_colors(scans)
    assert_values(scans, "intensity", INTENSITY)
    assert_values(scans, "class", CLASSES)
    assert_values(scans, "ring", np.arange(COUNT) % 16)


@pytest.mark.parametrize("layout", ["beside", "SemanticKITTI"])
def test_labels_of_semantic_kitti(tmp_path, layout):
    folder = tmp_path / "velodyne"
    write_kitti(folder, ["000000"], points_of(), np.eye(4)[None])
    table = np.fromfile(folder / "000000.bin", "<f4").reshape(-1, 4)
    table[:, 3] = INTENSITY / 2**15
    table.tofile(folder / "000000.bin")
    np.savetxt(folder / "poses.txt", np.eye(4)[:3].reshape(1, -1))
    target = folder if layout == "beside" else tmp_path / "labels"
    target.mkdir(exist_ok=True)
    words = CLASSES.astype(np.uint32) | (np.arange(COUNT, dtype=np.uint32) << 16)
    words[5] = 0
    words.astype("<u4").tofile(target / "000000.label")
    scans = load_scans(folder / "000000.bin", poses_frame="lidar")
    expected = CLASSES.copy()
    expected[5] = -1
    assert_values(scans, "class", expected)
    torch.testing.assert_close(scans.channels["intensity"], torch.tensor(INTENSITY / 2**15))


def test_labels_must_be_one_per_point(tmp_path):
    write_kitti(tmp_path, ["000000"], points_of(), np.eye(4)[None])
    np.zeros(3, "<u4").tofile(tmp_path / "000000.label")
    with pytest.raises(ValueError, match="must hold 200 labels of 4 bytes"):
        load_scans(tmp_path / "000000.bin", ORIGIN)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_color_images_beside_depth_images(tmp_path, suffix):
    image = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra io)")
    depth = np.full((2, 24, 32), 1500)
    write_depth_images(tmp_path, depth, np.tile(np.eye(4), (2, 1, 1)))
    ramp = np.zeros((24, 32, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = 8 * np.arange(32), 10 * np.arange(24)[:, None]
    first = sorted(tmp_path.glob("*.depth.png"))[0]
    color = str(first).replace(".depth.png", f".color.{suffix}")
    image.fromarray(ramp).save(color, quality=100, subsampling=0)
    scans = load_scans(tmp_path, camera=Camera(pixel_step=1))
    seen = scans.channels["color"]
    atol = 0 if suffix == "png" else 0.03  # JPEG is not exact
    expected = torch.tensor(ramp / 255).reshape(-1, 3).float()
    torch.testing.assert_close(seen[: 24 * 32], expected, rtol=0, atol=atol)
    assert seen[24 * 32 :].isnan().all()  # the second image has no color: missing, not black


def test_color_images_of_another_size_are_left_out_and_noted(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra io)")
    write_depth_images(tmp_path, np.full((1, 24, 32), 1500), np.eye(4)[None])
    (first,) = tmp_path.glob("*.depth.png")
    color = str(first).replace(".depth.png", ".color.png")
    image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(color)
    from lardhm_torch import ScanReport

    report = ScanReport()
    assert load_scans(tmp_path, report=report).channels == {}
    assert "another size" in str(report)


def test_text_columns_by_name(tmp_path):
    table = np.c_[points_of(), BYTES, INTENSITY, CLASSES]
    header = "x,y,z,r,g,b,intensity,label"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=header, comments="")
    scans = load_scans(tmp_path / "a.csv", ORIGIN)
    assert_colors(scans)
    assert_values(scans, "intensity", INTENSITY)
    assert_values(scans, "class", CLASSES)


def test_packed_colors_are_bits_and_not_values():
    words = np.array([0x00FF8001, 0xFF000000, 0x00FFFFFF], np.uint32)
    expected = np.array([[255, 128, 1], [0, 0, 0], [255, 255, 255]]) / 255
    np.testing.assert_allclose(unpacked_colors(words), expected, rtol=1e-6)
    np.testing.assert_allclose(unpacked_colors(words.view(np.float32)), expected, rtol=1e-6)


def test_float_colors_that_are_no_numbers_are_missing():
    values = np.array([[0.5, np.nan, 1], [0, 0.25, 1]])
    colors = scaled_colors(values)
    assert np.isnan(colors[0]).all()
    np.testing.assert_allclose(colors[1], [0, 0.25, 1])


def test_a_report_counts_the_rays_that_have_a_value(tmp_path):
    from lardhm_torch import ScanReport

    color = np.full((4, 3), 0.5)
    color[1] = np.nan
    arrays = {"points": np.ones((4, 3)), "origins": np.zeros((1, 3))}
    np.savez(tmp_path / "a.npz", **arrays, color=color)
    np.savez(tmp_path / "b.npz", **arrays)  # without a channel
    report = ScanReport()
    scans = load_scans(tmp_path, report=report)
    assert report.channels == {"color": 3}
    assert "color of 3 rays" in str(report)
    assert int(scans.channels["color"].isnan().any(dim=1).sum()) == 5
