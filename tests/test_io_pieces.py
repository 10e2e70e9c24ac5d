"""Scan files read a piece at a time."""

import numpy as np
import pytest
import torch
from scan_files import UTM, needs_laspy, some_points, write_las

from lardhm_torch import Scans, save_scans
from lardhm_torch.io.scan_files import Reading, iter_pieces, load_scans
from lardhm_torch.scans import concatenate_scans


def some_scans(rays: int = 100) -> Scans:
    rng = torch.Generator().manual_seed(0)
    ends = 9 * torch.randn(rays, 3, generator=rng, dtype=torch.float64)
    scan_id = torch.arange(rays) // 30
    is_return, target = torch.arange(rays) % 7 != 0, 1 + (torch.arange(rays) % 5 == 4).long()
    return Scans(torch.eye(4, 3, dtype=torch.float64), ends, scan_id, is_return, target)


def assert_same_rays(pieces: list[Scans], whole: Scans, max_rays: int) -> None:
    assert all(0 < len(piece) <= max_rays for piece in pieces)
    joined = concatenate_scans(pieces)
    for name in ("ends", "ray_origins", "is_return", "target_index"):
        assert torch.equal(getattr(joined, name), getattr(whole, name)), name


@pytest.mark.parametrize("max_rays", [1, 33, 100, 1000])
def test_pieces_of_npz_are_the_rays_of_the_file(tmp_path, max_rays):
    save_scans(some_scans(), tmp_path / "a.npz")
    pieces = list(iter_pieces(tmp_path / "a.npz", max_rays=max_rays))
    assert len(pieces) == -(-100 // max_rays)
    assert_same_rays(pieces, load_scans(tmp_path / "a.npz"), max_rays)


@pytest.mark.parametrize("kind", ["compressed", "columns", "float32", "one scan"])
def test_any_npz_that_can_be_loaded_can_be_read_in_pieces(tmp_path, kind):
    points = some_points(100).astype(np.float32 if kind == "float32" else np.float64)
    points = np.asfortranarray(points) if kind == "columns" else points
    arrays = {"points": points, "origins": np.zeros((1 if kind == "one scan" else 3, 3))}
    if kind != "one scan":
        arrays["scan_id"] = (np.arange(100) % 3).astype(np.int8)
    (np.savez_compressed if kind == "compressed" else np.savez)(tmp_path / "a.npz", **arrays)
    pieces, whole = (
        list(iter_pieces(tmp_path / "a.npz", max_rays=40)),
        load_scans(tmp_path / "a.npz"),
    )
    limit = 100 if kind == "columns" else 40  # columns lie apart in the file: read as one
    assert_same_rays(pieces, whole, limit)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_pieces_of_ply_are_the_rays_of_the_file(tmp_path, encoding):
    rows = np.concatenate([some_points(50), np.repeat(np.eye(2, 3), 25, axis=0)], axis=1)
    names = "".join(f"property double {name}\n" for name in ("x", "y", "z", "ox", "oy", "oz"))
    header = f"ply\nformat {encoding} 1.0\nelement vertex 50\n{names}end_header\n"
    path = tmp_path / "a.ply"
    if encoding == "ascii":
        text = "\n".join(" ".join(map(repr, map(float, row))) for row in rows)
        path.write_text(header + text + "\n")
    else:
        order = "<f8" if "little" in encoding else ">f8"
        path.write_bytes(header.encode() + rows.astype(order).tobytes())
    limit = 50 if encoding == "ascii" else 20
    assert_same_rays(list(iter_pieces(path, max_rays=20)), load_scans(path), limit)


@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_pieces_of_las_are_the_rays_of_the_file(tmp_path, name):
    path = write_las(tmp_path / name, some_points() + UTM, np.arange(200) % 4)
    pieces = list(iter_pieces(path, Reading(tuple(UTM)), max_rays=64))
    assert_same_rays(pieces, load_scans(path, tuple(UTM)), 64)


def test_a_folder_is_read_file_by_file(tmp_path):
    poses = np.tile(np.eye(3, 4).reshape(1, 12), (2, 1))
    np.savetxt(tmp_path / "poses.txt", poses)
    (tmp_path / "velodyne").mkdir()
    for number in range(2):
        points = np.full((10, 4), 1.0 + number, dtype="<f4")
        points.tofile(tmp_path / "velodyne" / f"{number:06d}.bin")
    pieces = list(iter_pieces(tmp_path / "velodyne", max_rays=8))
    assert [len(piece) for piece in pieces] == [8, 2, 8, 2]
    assert_same_rays(pieces, load_scans(tmp_path / "velodyne"), 8)


def test_what_is_wrong_with_a_file_is_said_as_when_it_is_loaded(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=some_points())
    for read in (load_scans, lambda p: list(iter_pieces(p))):
        with pytest.raises(ValueError, match=r"a\.npz must contain the sensor position"):
            read(path)
    np.savez(path, points=some_points(), origins=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"a\.npz cannot be read: scan_id is needed to choose"):
        list(iter_pieces(path))
    np.savez(path, points=some_points(), origins=np.zeros((2, 3)), scan_id=np.zeros(7, int))
    with pytest.raises(ValueError, match=r"a\.npz cannot be read: arrays must have one entry"):
        list(iter_pieces(path))
    save_scans(some_scans(), path)
    with pytest.raises(ValueError, match="origin must be left out when the files carry their own"):
        list(iter_pieces(path, Reading(origin=(0, 0, 0))))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"a\.npz cannot be read"):
        list(iter_pieces(path))
