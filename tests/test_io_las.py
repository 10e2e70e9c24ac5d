"""LAS and LAZ."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scan_files import UTM, needs_laspy, some_points, whole_file, write_las

from lardhm_torch.io.scan_files import load_points, load_scans


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
    code = "import sys, lardhm_torch.io.scan_files; sys.exit('laspy' in sys.modules)"
    root = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


@needs_laspy
def test_las_asks_for_the_sensor_position(tmp_path):
    with pytest.raises(ValueError, match=r"trajectory\.txt .* beside it or"):
        load_scans(write_las(tmp_path / "a.las", some_points() + UTM))


@needs_laspy
@pytest.mark.parametrize("count", [199, 201, 2**63])
def test_a_laz_must_hold_the_points_it_promises(tmp_path, count):
    path = whole_file(tmp_path, "laz")
    content = bytearray(path.read_bytes())
    content[247:255] = count.to_bytes(8, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"{count} points are declared.*the chunks hold 200"):
        load_points(path)


@needs_laspy
@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_a_las_without_points_is_an_error(tmp_path, name):
    with pytest.raises(ValueError, match="0 points are declared, one is needed"):
        load_points(write_las(tmp_path / name, np.zeros((0, 3))))
