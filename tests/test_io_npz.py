"""The .npz layout of scans, and bare points."""

import numpy as np
import pytest
import torch
from scan_files import UTM, real_scans, some_points, whole_file

from lardhm_torch.io.scan_files import load_points, load_scans, save_scans
from lardhm_torch.scans import Scans


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


def test_scans_are_saved_in_known_formats_only_and_only_into_a_folder_that_exists(tmp_path):
    scans = Scans(torch.zeros(1, 3), torch.ones(5, 3))
    with pytest.raises(ValueError, match=r"path must end in one of \.npz, \.ply, \.pcd"):
        save_scans(scans, tmp_path / "scans.las")
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


@pytest.mark.parametrize("at", [[20, 24], [24]])  # packed and unpacked size, or one of them
def test_an_npz_that_promises_far_more_than_it_holds_is_refused(tmp_path, at):
    path = whole_file(tmp_path, "npz")
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\1\2")  # of points, in the archive's directory
    for field in at:
        content[entry + field : entry + field + 4] = (2**32 - 2).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"points declares 4294967294 bytes; \d+ cannot hold them"):
        load_points(path)
