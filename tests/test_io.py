"""Readers and writers: every format gives the same rays, broken files give a clear error."""

import importlib.util
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from lardhm_torch import io
from lardhm_torch.io import load_points, load_scans, save_scans
from lardhm_torch.io.pcd import decompress_lzf
from lardhm_torch.scans import Scans

RAMP = np.arange(160, dtype="<u2").tobytes()
UTM = np.array([500_000.0, 4_500_000.0, 100.0])
HAS_LASPY = all(importlib.util.find_spec(name) for name in ("laspy", "lazrs"))
needs_laspy = pytest.mark.skipif(not HAS_LASPY, reason="laspy[lazrs] is not installed")


def some_points(count: int = 200, dim: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, dim)).round(3)


def real_scans(data: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(data / name / "scans.npz") as archive:
        return dict(archive)


def ply_header(encoding: str, count: int, names="x y z", kind: str = "double") -> bytes:
    lines = ["ply", f"format {encoding} 1.0", "comment by hand", "obj_info too"]
    lines += [f"element vertex {count}", *(f"property {kind} {name}" for name in names.split())]
    return "\n".join([*lines, "end_header", ""]).encode()


def pcd_header(
    encoding: str, count: int, names="x y z", size=8, viewpoint: str | None = "1 2 3 1 0 0 0"
) -> bytes:
    columns = len(names.split())
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {names}"]
    lines += [f"SIZE{f' {size}' * columns}", f"TYPE{' F' * columns}", f"COUNT{' 1' * columns}"]
    lines += [f"WIDTH {count}", "HEIGHT 1", f"POINTS {count}", f"DATA {encoding}", ""]
    if viewpoint is not None:
        lines.insert(6, f"VIEWPOINT {viewpoint}")
    return "\n".join(lines).encode()


def lzf_literals(content: bytes) -> bytes:
    """LZF without a single copy."""
    runs = [content[i : i + 32] for i in range(0, len(content), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def as_text(points: np.ndarray, delimiter: str = " ") -> bytes:
    return "".join(delimiter.join(map(repr, row)) + "\n" for row in points.tolist()).encode()


def packed_body(values: np.ndarray) -> bytes:
    content = np.ascontiguousarray(values.T).tobytes()
    packed = lzf_literals(content)
    return len(packed).to_bytes(4, "little") + len(content).to_bytes(4, "little") + packed


def file_content(name: str, points: np.ndarray) -> bytes:
    """The bytes of a whole file by hand; name is extension-variant."""
    count, names = len(points), " ".join("xyz"[: points.shape[1]])
    little, big = points.astype("<f8").tobytes(), points.astype(">f8").tobytes()
    text = as_text(points)
    return {
        "ply-ascii": lambda: ply_header("ascii", count, names) + text,
        "ply-little": lambda: ply_header("binary_little_endian", count, names) + little,
        "ply-big": lambda: ply_header("binary_big_endian", count, names) + big,
        "pcd-ascii": lambda: pcd_header("ascii", count, names) + text,
        "pcd-binary": lambda: pcd_header("binary", count, names) + little,
        "pcd-packed": lambda: pcd_header("binary_compressed", count, names) + packed_body(points),
        "xyz-spaces": lambda: text,
        "txt-tabs": lambda: as_text(points, "\t"),
        "csv-header": lambda: ",".join(names.split()).encode() + b"\n" + as_text(points, ","),
        "csv-semicolons": lambda: as_text(points, ";"),
        "csv-mark": lambda: b"\xef\xbb\xbfX;Y;Z\r\n" + as_text(points, ";").replace(b"\n", b"\r\n"),
        "csv-quotes": lambda: b'"x", "y", "z"\n' + as_text(points, ","),
        "xyz-comments": lambda: b"# made here\n\n//X Y Z\n" + text,
    }[name]()


HAND_MADE = [
    *("ply-ascii", "ply-little", "ply-big", "pcd-ascii", "pcd-binary", "pcd-packed"),
    *("xyz-spaces", "txt-tabs", "csv-header", "csv-semicolons", "csv-mark", "csv-quotes"),
    "xyz-comments",
]


def write_by_hand(folder: Path, name: str, points: np.ndarray) -> Path:
    path = folder / f"scan.{name.partition('-')[0]}"
    path.write_bytes(file_content(name, points))
    return path


def write_las(path: Path, points: np.ndarray, returns=1, point_format: int = 6) -> Path:
    import laspy

    las = laspy.create(file_version="1.4", point_format=point_format)
    las.header.scales, las.header.offsets = [1e-3] * 3, UTM
    las.x, las.y, las.z = points.T
    las.return_number = np.broadcast_to(returns, len(points)).astype(np.uint8)
    las.write(path)
    return path


def write_kitti(folder: Path, stems: list[str], points: np.ndarray, poses: np.ndarray) -> None:
    """One .bin a stem, its points moved from the world into its sensor's frame."""
    folder.mkdir(exist_ok=True)
    for stem, pose in zip(stems, poses, strict=True):
        sensor = (points - pose[:3, 3]) @ pose[:3, :3]
        np.c_[sensor, np.zeros(len(points))].astype("<f4").tofile(folder / f"{stem}.bin")


def write_poses(path: Path, poses: np.ndarray) -> None:
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt="%.17g")


def turning_poses(count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, (pose, angle) in enumerate(zip(poses, np.linspace(0, 2, count), strict=True)):
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = i, 2 * i, 0.5
    return poses


# The npz layout


def test_saved_scans_are_loaded_as_they_were(tmp_path):
    rng = torch.Generator().manual_seed(0)
    scans = Scans(
        torch.randn(4, 3, generator=rng, dtype=torch.float64) + torch.tensor(UTM),
        torch.randn(99, 3, generator=rng, dtype=torch.float64) + torch.tensor(UTM),
        torch.randint(4, (99,), generator=rng),
        torch.rand(99, generator=rng) < 0.5,
        torch.randint(1, 5, (99,), generator=rng),
    )
    save_scans(scans, tmp_path / "scans.npz")
    loaded = load_scans(tmp_path / "scans.npz")
    for name in ("origins", "ends", "scan_id", "is_return", "target_index"):
        assert torch.equal(getattr(loaded, name), getattr(scans, name)), name


def test_2d_and_5d_scans_are_saved_and_loaded_too(tmp_path):
    for dim in (2, 5):
        scans = Scans(torch.zeros(1, dim), torch.as_tensor(some_points(7, dim)))
        save_scans(scans, tmp_path / "scans.npz")
        assert torch.equal(load_scans(tmp_path / "scans.npz").ends, scans.ends)


@pytest.mark.parametrize("name", ["la3dm_sim_structured", "hilbert2015_intel", "riegl_vz400i_rtls"])
def test_real_scans_are_loaded_as_numpy_reads_them(data, name):
    arrays, scans = real_scans(data, name), load_scans(data / name / "scans.npz")
    assert np.array_equal(scans.ends, arrays["points"].astype(np.float64))
    assert np.array_equal(scans.origins, arrays["origins"])
    assert np.array_equal(scans.scan_id, arrays["scan_id"])
    for column in {"is_return", "target_index"} & arrays.keys():
        assert np.array_equal(getattr(scans, column), arrays[column])


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "scans.npz"
    save_scans(Scans(torch.zeros(1, 3), torch.ones(5, 3)), path)
    before = path.read_bytes()

    def half_a_write(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", half_a_write)
    with pytest.raises(OSError, match="disk full"):
        save_scans(Scans(torch.zeros(1, 3), torch.zeros(9, 3)), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_who_has_the_old_file_open_keeps_the_old_scans(tmp_path):
    path = tmp_path / "scans.npz"
    save_scans(Scans(torch.zeros(1, 3), torch.ones(5, 3)), path)
    before = path.read_bytes()
    with open(path, "rb") as old:
        save_scans(Scans(torch.zeros(1, 3), torch.zeros(9, 3)), path)
        assert old.read() == before
    assert len(load_scans(path)) == 9


def test_saving_through_a_link_replaces_what_it_points_to(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.npz"
    link.symlink_to(tmp_path / "there/scans.npz")
    save_scans(Scans(torch.zeros(1, 3), torch.ones(5, 3)), link)
    assert link.is_symlink()
    assert len(load_scans(tmp_path / "there/scans.npz")) == 5


def test_scans_are_saved_as_npz_only_and_only_into_a_folder_that_exists(tmp_path):
    scans = Scans(torch.zeros(1, 3), torch.ones(5, 3))
    with pytest.raises(ValueError, match=r"path must end in \.npz"):
        save_scans(scans, tmp_path / "scans.ply")
    with pytest.raises(FileNotFoundError, match=r"folder that exists.*nowhere"):
        save_scans(scans, tmp_path / "nowhere/scans.npz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"origins": np.zeros((1, 3))}, "array points .* is needed; got origins"),
        ({"points": np.zeros(3), "origins": np.zeros((1, 3))}, r"points must be \(N, D\)"),
        ({"points": np.zeros((4, 3), complex)}, "numbers are needed"),
        ({"points": np.array([[None]])}, "numbers are needed"),
        ({"points": np.zeros((4, 3), bool)}, r"points must be \(N, D\) numbers"),
        ({"points": np.zeros((4, 3)), "origins": np.zeros((2, 3))}, "scan_id is needed .* 2"),
        ({"points": np.zeros((4, 3)), "origins": np.zeros((1, 2))}, "origins .* one D"),
        (
            {"points": np.zeros((2, 3)), "origins": np.zeros((1, 3)), "scan_id": np.array([0, 1])},
            "scan_id must be 0 to 0",
        ),
        (
            {"points": np.zeros((2, 3)), "origins": np.zeros((1, 3)), "scan_id": np.zeros(3)},
            r"scan_id must be \(2,\)",
        ),
        (
            {
                "points": np.zeros((2, 3)),
                "origins": np.zeros((1, 3)),
                "is_return": np.arange(2) * 2,
            },
            "is_return must be a whole number from 0 to 1; got 2 at row 1",
        ),
        (
            {"points": np.zeros((4, 3)), "origins": np.full((1, 3), np.nan)},
            "origins must be finite",
        ),
    ],
)
def test_an_npz_that_is_no_scan_says_what_is_wrong(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(ValueError, match=rf"bad\.npz.*{message}"):
        load_scans(tmp_path / "bad.npz")


# The other formats


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


@needs_laspy
@pytest.mark.parametrize(("name", "point_format"), [("a.las", 6), ("a.laz", 6), ("a.laz", 1)])
def test_las_gives_utm_to_the_last_unit_and_the_return_number(tmp_path, name, point_format):
    points, returns = some_points() + UTM, np.arange(200) % 4
    path = write_las(tmp_path / name, points, returns, point_format)
    scans = load_scans(path, origin=tuple(UTM))
    assert np.array_equal(scans.ends, np.rint((points - UTM) * 1000) * 1e-3 + UTM)
    assert scans.target_index.tolist() == np.maximum(returns, 1).tolist()
    assert scans.origins.tolist() == [UTM.tolist()]


@needs_laspy
def test_laz_of_many_chunks_is_read_whole(tmp_path):
    points = some_points(120_000) + UTM
    assert np.allclose(
        load_points(write_las(tmp_path / "a.laz", points)), points, rtol=0, atol=6e-4
    )


def test_without_laspy_the_error_says_what_to_install(tmp_path, monkeypatch):
    block = bytearray(375)
    block[:4], block[25] = b"LASF", 2
    block[94:96], block[96:100] = (227).to_bytes(2, "little"), (227).to_bytes(4, "little")
    block[105:107] = (20).to_bytes(2, "little")
    (tmp_path / "scan.las").write_bytes(block)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ImportError, match=r"scan\.las needs laspy.*lardhm_torch\[io\]"):
        load_scans(tmp_path / "scan.las", origin=(0, 0, 0))


def test_importing_the_readers_does_not_import_laspy():
    code = "import sys, lardhm_torch.io; sys.exit('laspy' in sys.modules)"
    root = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


# Where the sensor stood


def test_the_viewpoint_of_a_pcd_is_the_origin_and_moves_nothing(tmp_path):
    points = some_points()
    turned = "1 2 3 0 0 0 1"
    content = pcd_header("binary", len(points), viewpoint=turned) + points.tobytes()
    (tmp_path / "scan.pcd").write_bytes(content)
    scans = load_scans(tmp_path / "scan.pcd")
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
    with pytest.raises(ValueError, match=r"where the sensor stood.*origin=\(x, y, z\).*--origin"):
        load_scans(path)
    with pytest.raises(ValueError, match=r"origin must be \(3,\).*got \(1, 2\)"):
        load_scans(path, origin=(1, 2))
    with pytest.raises(ValueError, match="origins must be finite"):
        load_scans(path, origin=(1, 2, float("nan")))


@needs_laspy
def test_las_asks_for_the_sensor_position(tmp_path):
    with pytest.raises(ValueError, match=r"convert to \.npz with origins, or"):
        load_scans(write_las(tmp_path / "a.las", some_points() + UTM))


def test_a_viewpoint_at_zero_gives_way_to_an_origin(tmp_path):
    content = pcd_header("ascii", 1, viewpoint="0 0 0 1 0 0 0") + b"1 2 3\n"
    (tmp_path / "scan.pcd").write_bytes(content)
    assert load_scans(tmp_path / "scan.pcd").origins.tolist() == [[0, 0, 0]]
    assert load_scans(tmp_path / "scan.pcd", origin=(4, 5, 6)).origins.tolist() == [[4, 5, 6]]


def test_an_origin_that_no_file_needs_is_an_error(tmp_path):
    path = write_by_hand(tmp_path, "pcd-binary", some_points())
    with pytest.raises(ValueError, match="origin must be left out"):
        load_scans(path, origin=(0, 0, 0))


# KITTI


@pytest.mark.parametrize("where", ["beside", "above"])
def test_real_kitti_scans_come_back_from_their_sensor_frames(data, tmp_path, where):
    arrays = real_scans(data, "kitti00_mulls")
    points = arrays["points"][::500].astype(np.float64)
    folder = tmp_path / "velodyne"
    write_kitti(folder, ["000000", "000005", "000010", "000015"], points, arrays["poses"])
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[::5] = arrays["poses"]
    write_poses((folder if where == "beside" else tmp_path) / "poses.txt", poses)
    scans = load_scans(folder)
    assert np.array_equal(scans.origins, arrays["poses"][:, :3, 3])
    assert scans.num_scans == 4
    # float32 in the sensor frame, up to 50 m away: 4e-6 m; the stored rotations drift by 1e-6
    assert np.allclose(scans.ends.reshape(4, -1, 3), points, rtol=0, atol=1e-4)


def test_poses_follow_the_order_of_names_that_are_no_line_numbers(tmp_path):
    poses, points = turning_poses(3), some_points()
    write_kitti(tmp_path, ["scan_2", "scan_9", "scan_10"], points, poses)
    write_poses(tmp_path / "poses.txt", poses)
    scans = load_scans(tmp_path)
    assert np.array_equal(scans.origins, poses[:, :3, 3])
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-6)
    assert load_scans(tmp_path / "scan_9.bin").origins.tolist() == [poses[1, :3, 3].tolist()]


def test_numbers_past_the_last_pose_mean_order(tmp_path):
    poses = turning_poses(2)
    write_kitti(tmp_path, ["100", "101"], some_points(), poses)
    write_poses(tmp_path / "poses.txt", poses)
    assert np.array_equal(load_scans(tmp_path).origins, poses[:, :3, 3])


def test_new_poses_are_seen_at_once(tmp_path):
    poses = turning_poses(2)
    write_kitti(tmp_path, ["0", "1"], some_points(), poses)
    for shift in (0, 10, 20):
        poses[:, 0, 3] += shift
        (tmp_path / "poses.txt").unlink(missing_ok=True)
        write_poses(tmp_path / "poses.txt", poses)
        assert np.array_equal(load_scans(tmp_path).origins, poses[:, :3, 3])


def test_camera_poses_become_laser_poses_by_the_calibration(tmp_path):
    points, laser = some_points(), turning_poses(3)
    camera_from_laser = np.eye(4)
    camera_from_laser[:3] = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3]]
    camera = camera_from_laser @ laser @ np.linalg.inv(camera_from_laser)
    write_kitti(tmp_path / "velodyne", ["0", "1", "2"], points, laser)
    write_poses(tmp_path / "poses.txt", camera)
    rows = " ".join(map(repr, camera_from_laser[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 2 3\nTr: {rows}\n")
    scans = load_scans(tmp_path / "velodyne")
    assert np.allclose(scans.origins, laser[:, :3, 3])
    assert np.allclose(scans.ends, np.tile(points, (3, 1)), atol=1e-6)


def test_without_poses_a_kitti_scan_is_taken_as_it_is_from_a_given_origin(tmp_path):
    points = some_points().astype(np.float32)
    write_kitti(tmp_path, ["0"], points, np.eye(4)[None])
    assert np.array_equal(load_scans(tmp_path, origin=(0, 0, 0)).ends, points)
    with pytest.raises(ValueError, match=r"0\.bin must say where.*Put its poses\.txt beside it"):
        load_scans(tmp_path)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "2 lines for 3 scans, a.bin to c.bin"),
        ("1 0 0 0\n" * 3, "poses.txt must have 12 numbers a line"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n" * 3, "rotations and positions; line 0 is none"),
        ("1 0 0 0 0 1 0 0 0 0 1 nan\n" * 3, "rotations and positions; line 0 is none"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n" * 3, "rotations and positions; line 0 is none"),
    ],
)
def test_poses_that_cannot_be_right_are_an_error(tmp_path, poses, message):
    write_kitti(tmp_path, ["a", "b", "c"], some_points(), turning_poses(3))
    (tmp_path / "poses.txt").write_text(poses)
    with pytest.raises(ValueError, match=message):
        load_scans(tmp_path)


# Files and folders


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
    with pytest.raises(ValueError, match=r"at least one scan \(\.bin .*\.xyz\).* has none"):
        load_scans(tmp_path)
    with pytest.raises(ValueError, match="at least one file or folder; got an empty list"):
        load_scans([])
    (tmp_path / "scan.docx").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"end in one of \.bin .*\.xyz; got .*scan\.docx"):
        load_scans(tmp_path / "scan.docx")


def test_files_of_two_dimensions_do_not_mix(tmp_path):
    flat = write_by_hand(tmp_path, "xyz-spaces", some_points(dim=2))
    solid = write_by_hand(tmp_path, "ply-ascii", some_points())
    with pytest.raises(ValueError, match=r"one dimension; got 2 in .*scan\.xyz, 3 in .*scan\.ply"):
        load_scans([flat, solid], origin=(0, 0, 0))


# Bare points


def test_points_come_from_npy_and_from_npz_with_only_points(tmp_path):
    points = some_points(dim=2).astype(np.float32)
    np.save(tmp_path / "a.npy", points)
    np.save(tmp_path / "fortran.npy", np.asfortranarray(points))
    np.savez_compressed(tmp_path / "a.npz", points=points)
    for name in ("a.npy", "fortran.npy", "a.npz"):
        loaded = load_points(tmp_path / name)
        assert loaded.dtype == torch.float64
        assert np.array_equal(loaded, points)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(3), r"must be \(N, D\) numbers; got \(3,\)"),
        (np.array(["a"]), "numbers are needed; got an array of <U1"),
        (np.array([{}]), "numbers are needed; got an array of object"),
    ],
)
def test_an_npy_that_holds_no_points_says_so(tmp_path, array, message):
    np.save(tmp_path / "bad.npy", array)
    with pytest.raises(ValueError, match=rf"bad\.npy.*{message}"):
        load_points(tmp_path / "bad.npy")


def test_points_are_one_file(tmp_path):
    with pytest.raises(ValueError, match=r"one file of points; .* is a folder"):
        load_points(tmp_path)
    (tmp_path / "points.json").write_text("[]")
    with pytest.raises(ValueError, match=r"end in one of .*\.npy"):
        load_points(tmp_path / "points.json")


# Broken files


def whole_file(folder: Path, name: str) -> Path:
    if name == "npz":
        save_scans(Scans(torch.ones(1, 3), torch.as_tensor(some_points())), folder / "scan.npz")
    elif name == "npy":
        np.save(folder / "scan.npy", some_points())
    elif name == "bin":
        write_kitti(folder, ["scan"], some_points(), np.eye(4)[None])
    elif name in ("las", "laz"):
        return write_las(folder / f"scan.{name}", some_points() + UTM)
    else:
        return write_by_hand(folder, name, some_points())
    return folder / f"scan.{name}"


CUT = ["npz", "npy", "bin", *(name for name in HAND_MADE if name[:3] in ("ply", "pcd"))]
LAS = [pytest.param(name, marks=needs_laspy) for name in ("las", "laz")]


@pytest.mark.parametrize("name", [*CUT, *LAS])
def test_a_file_cut_anywhere_is_an_error_that_names_it(tmp_path, name):
    path = whole_file(tmp_path, name)
    content = path.read_bytes()
    # Text cut within its very last number is whole again, to all appearance.
    last = len(content) - (40 if "ascii" in name else 5)
    for cut in [0, *range(1, last, len(content) // 400 * 16), last]:
        path.write_bytes(content[:cut])
        with pytest.raises(ValueError, match=r"scan\.\w+ cannot be read: \w"):
            load_points(path)


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 301, b"\xff" * 301, b"<html>no scan</html>\n" * 9]
)
@pytest.mark.parametrize("extension", sorted({*io._READERS, ".npy"}))
def test_garbage_is_an_error_that_names_the_file(tmp_path, extension, content):
    path = tmp_path / f"scan{extension}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"scan\.\w+ cannot be read: \w"):
        load_points(path)


@pytest.mark.parametrize("name", ["npy", *(name for name in CUT if "-" in name)])
def test_a_huge_count_is_refused_before_anything_is_allocated(tmp_path, name):
    path = whole_file(tmp_path, name)
    huge = path.read_bytes().replace(b"200", b"99999999999", 2)
    huge = huge.replace(b"POINTS 200", b"POINTS 99999999999")
    path.write_bytes(huge if name != "npy" else huge.replace(b" " * 8 + b"\n", b"\n"))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="99999999999"):
            load_points(path)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("at", [[20, 24], [24]])  # packed and unpacked size, or one of them
def test_an_npz_that_promises_far_more_than_it_holds_is_refused(tmp_path, at):
    path = whole_file(tmp_path, "npz")
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\1\2")  # of points, in the archive's directory
    for field in at:
        content[entry + field : entry + field + 4] = (2**32 - 2).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"points promises 4294967294 bytes; \d+ cannot hold them"):
        load_points(path)


@needs_laspy
@pytest.mark.parametrize("count", [199, 201, 2**63])
def test_a_laz_must_hold_the_points_it_promises(tmp_path, count):
    path = whole_file(tmp_path, "laz")
    content = bytearray(path.read_bytes())
    content[247:255] = count.to_bytes(8, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"{count} points are promised.*the chunks hold 200"):
        load_points(path)


@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_a_las_without_points_is_an_error(tmp_path, name):
    with pytest.raises(ValueError, match="0 points are promised, one is needed"):
        load_points(write_las(tmp_path / name, np.zeros((0, 3))))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "a,b\n1,2\n", "columns x and y are needed; got a, b"),
        ("a.csv", "x,y,z\n1,2,3\n1,2\n", "row 2"),
        ("a.csv", "x,y\n1,two\n", "two"),
        ("a.csv", "x,y,ox\n1,2,3\n", "the origin needs the columns ox, oy; got ox"),
        ("a.csv", "x,y,ox,oy\n1,2,nan,3\n", "ox, oy must be finite; got .* at row 0"),
        ("a.csv", "x,y,scan_id\n1,2,0.5\n", "scan_id must be a whole number"),
        ("a.csv", "x,y,target_index\n1,2,0\n", "target_index must be a whole number from 1"),
        ("a.csv", "x,y\n", "at least one point is needed"),
        ("a.csv", "x,y\n1,2\0\n", "the file holds zero bytes"),
        ("a.xyz", "1\n2\n", "columns x and y are needed; got x"),
        ("a.txt", "# nothing\n", "a line of numbers is needed"),
        ("a.ply", "ply\nelement vertex 1\nend_header\n", "needs a line 'format'"),
        ("a.ply", "ply\nformat ebcdic 1.0\n", "line 2 of the header is not understood"),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n", "element vertex is needed; got none"),
        ("a.ply", "ply\nelement vertex -1\n", "element vertex must be a count; got '-1'"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "vertices with list properties",
        ),
        (
            "a.ply",
            "ply\nformat binary_little_endian 1.0\nelement strip 1\nproperty list uchar int i\n"
            "element vertex 1\nproperty float x\nproperty float y\nend_header\n",
            "binary lists before the vertices are not supported; got element strip",
        ),
        ("a.pcd", "FIELDS x y\nSIZE 4\nTYPE F F\nDATA ascii\n", "one entry per field; got 2, 1"),
        ("a.pcd", "FIELDS x\nSIZE 3\nTYPE F\nDATA ascii\n", "field x has TYPE F and SIZE 3"),
        ("a.pcd", "FIELDS x\nSIZE 4\nTYPE F\nPOINTS 1\nDATA zip\n", "DATA must be ascii, binary"),
        ("a.pcd", "FIELDS x\nSIZE 4\nTYPE F\nCOUNT 2\nDATA ascii\n", "COUNT of field x must be 1"),
        (
            "a.pcd",
            "FIELDS x\nSIZE 4\nTYPE F\nWIDTH 2\nHEIGHT 2\nPOINTS 5\nDATA ascii\n",
            r"one number of points; got \[5, 4\]",
        ),
        (
            "a.pcd",
            "FIELDS x\nSIZE 4\nTYPE F\nPOINTS 5\nVIEWPOINT 1 2 3\nDATA ascii\n",
            "VIEWPOINT must be seven numbers",
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_said(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=rf"{name} cannot be read: .*{message}"):
        load_points(tmp_path / name)


def test_a_file_that_may_not_be_opened_keeps_its_own_error(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setitem(io._READERS, ".csv", refuse)
    path = write_by_hand(tmp_path, "csv-header", some_points())
    with pytest.raises(PermissionError, match=r"scan\.csv"):
        load_scans(path)
