"""E57, written by pye57."""

import sys

import numpy as np
import pytest
from healthy_files import checksums_mended, write_e57
from scan_files import real_scans, some_points, turning_poses

from lardhm_torch.io.scan_files import load_points, load_scans

pye57 = pytest.importorskip("pye57", reason="pye57 is not installed (extra io)")


def to_sensor(points, pose):
    return (points - pose[:3, 3]) @ pose[:3, :3]


def write_spherical(path, rows: np.ndarray) -> None:
    """Range, azimuth and elevation, float64, and a pose of none: pye57 has only the parts."""
    from pye57 import libe57

    with pye57.E57(str(path), mode="w") as file:
        image, scan = file.image_file, libe57.StructureNode(file.image_file)
        scan.set("guid", libe57.StringNode(image, "{1}"))
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        for name, values in zip(("Range", "Azimuth", "Elevation"), rows.T.copy(), strict=True):
            prototype.set(f"spherical{name}", libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE))
            buffers.append(
                libe57.SourceDestBuffer(image, f"spherical{name}", values, len(rows), True, True)
            )
        codecs = libe57.VectorNode(image, True)
        points = libe57.CompressedVectorNode(image, prototype, codecs)
        scan.set("points", points)
        file.data3d.append(scan)
        writer = points.writer(buffers)
        writer.write(len(rows))
        writer.close()


def set_xml(path, old: bytes, new: bytes) -> None:
    """Replace a piece of the XML part by one of the same length, checksums mended."""
    content = path.read_bytes()
    assert len(old) == len(new)
    assert old in content  # and again in what pads the last page
    path.write_bytes(checksums_mended(content.replace(old, new, 1)))


def test_real_scans_come_back_from_e57(data, tmp_path):
    arrays = real_scans(data, "tdtk_dat")
    points, scan_id = arrays["points"][::20].astype(np.float64), arrays["scan_id"][::20]
    poses = arrays["poses"]
    sensor = [to_sensor(points[scan_id == i], pose) for i, pose in enumerate(poses)]
    path = write_e57(tmp_path / "a.e57", sensor, poses)
    scans = load_scans(path)
    assert np.allclose(scans.ends, points, rtol=0, atol=2e-5)  # float32 and rotations rounded
    assert np.allclose(scans.origins, poses[:, :3, 3], rtol=0, atol=1e-12)
    assert np.array_equal(scans.scan_id, scan_id)
    assert np.array_equal(load_points(path), scans.ends)


def test_we_read_what_pye57_reads(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points(200_000)], turning_poses(2)[1:])
    with pye57.E57(str(path)) as file:
        columns = file.read_scan(0, ignore_missing_fields=True)
    theirs = np.stack([columns[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    assert np.allclose(load_points(path), theirs, rtol=0, atol=1e-12)


def test_points_marked_invalid_are_left_out(tmp_path):
    points, state = some_points(), np.arange(200) % 3
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        columns = {f"cartesian{axis}": values for axis, values in zip("XYZ", points.T, strict=True)}
        file.write_scan_raw({**columns, "cartesianInvalidState": state.astype(np.int8)})
    assert np.allclose(load_points(tmp_path / "a.e57"), points[state == 0], atol=1e-6)


def test_spherical_points_are_turned_into_cartesian_ones(tmp_path):
    points = np.abs(some_points()) + 0.1
    ranges = np.linalg.norm(points, axis=1)
    angles = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / ranges)
    write_spherical(tmp_path / "a.e57", np.stack([ranges, *angles], axis=1))
    assert np.allclose(load_points(tmp_path / "a.e57"), points, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="must contain the sensor position"):
        load_scans(tmp_path / "a.e57")


def test_a_pose_that_moves_nothing_gives_way_to_an_origin(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    assert load_scans(path).origins.tolist() == [[0, 0, 0]]
    assert load_scans(path, origin=(1, 2, 3)).origins.tolist() == [[1, 2, 3]]
    write_e57(tmp_path / "b.e57", [some_points()], turning_poses(2)[1:])
    with pytest.raises(ValueError, match="origin must be left out"):
        load_scans(tmp_path / "b.e57", origin=(1, 2, 3))


def test_a_scan_without_a_pose_asks_for_an_origin(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points()], turning_poses(2)[1:])
    content = path.read_bytes()
    for tag in (b'<pose type="Structure">', b"</pose>"):
        content = content.replace(tag, tag.replace(b"pose", b"nope"))
    path.write_bytes(checksums_mended(content))
    with pytest.raises(ValueError, match=r"Export the scans with their poses or give it"):
        load_scans(path)
    assert load_scans(path, origin=(1, 2, 3)).origins.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("count", [b"201", b"999", b"199"])
def test_a_scan_must_hold_the_points_it_promises(tmp_path, count):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    set_xml(path, b'recordCount="200"', b'recordCount="' + count + b'"')
    if count == b"199":  # what is there beyond is not read
        assert len(load_points(path)) == 199
        return
    with pytest.raises(ValueError, match=r"a\.e57 cannot be read: \w"):
        load_points(path)


def test_a_huge_count_is_refused_before_anything_is_allocated(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    old, new = b'recordCount="200">\n        <', b'recordCount="9999999999">\n <'
    set_xml(path, old, new)
    with pytest.raises(ValueError, match=r"9999999999 points are declared; .* bytes are too few"):
        load_points(path)


def test_entities_that_could_unfold_to_any_size_are_refused(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    old = b'<?xml version="1.0" encoding="UTF-8"?>\n'
    new = b'<?xml version="1.0"?><!DOCTYPE e57Root>\n'
    set_xml(path, old, new[: len(old)].ljust(len(old)))
    with pytest.raises(ValueError, match=r"must begin with <\?xml and define no entities"):
        load_points(path)


@pytest.mark.parametrize("at", [16, 24, 32, 40])  # length, XML position, XML length, page size
@pytest.mark.parametrize("value", [0, 2**63, 2**64 - 1])
def test_a_header_that_does_not_fit_the_file_is_refused(tmp_path, at, value):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    content = bytearray(path.read_bytes())
    content[at : at + 8] = value.to_bytes(8, "little")
    path.write_bytes(checksums_mended(bytes(content)))
    with pytest.raises(ValueError, match=r"a\.e57 cannot be read: \w"):
        load_points(path)


def test_a_flipped_bit_is_seen_by_the_checksum(tmp_path):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    content = bytearray(path.read_bytes())
    content[500] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.e57 cannot be read: .*(?i:checksum|crc)"):
        load_points(path)


def test_without_pye57_the_error_names_the_extra(tmp_path, monkeypatch):
    path = write_e57(tmp_path / "a.e57", [some_points()], np.eye(4)[None])
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(ImportError, match=r"a\.e57 needs pye57.*lardhm_torch\[io\]"):
        load_points(path)
