"""Broken files of every format: a clear error that names the file."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from fuzz_readers import available_formats
from scan_files import CUT, LAS, some_points, whole_file, write_by_hand

from lardhm_torch.io import scan_files
from lardhm_torch.io.scan_files import load_points, load_scans


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


NATIVE = [name for name in available_formats() if name[:3] in ("las", "laz", "e57")]
PYTHON = [name for name in available_formats() if name not in NATIVE]


@pytest.mark.parametrize("names", [PYTHON, NATIVE], ids=["python", "native"])
def test_fifty_broken_files_of_each_format_neither_crash_nor_hang(names):
    """In a process with a limit on memory, so that a crash of a library is seen (`make soak`)."""
    script = Path(__file__).parents[1] / "scripts/fuzz_readers.py"
    command = [sys.executable, script, *names, "--here", "--mutations", "50"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-3000:]
    assert len(run.stdout.splitlines()) == len(names)


@pytest.mark.parametrize(
    "content", [b"", b"\0" * 301, b"\xff" * 301, b"<html>no scan</html>\n" * 9]
)
@pytest.mark.parametrize("extension", sorted({*scan_files._READERS, ".npy"}))
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
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement strip 2147483647\nproperty int i\nelement vertex 1\n"
            "property float x\nproperty list uchar int seen\nend_header\n1\n2 0\n",
            "element strip needs 2147483647 lines; 6 bytes are too few",
        ),
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
            "1 records are declared; got 0 bytes",
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

    monkeypatch.setitem(scan_files._READERS, ".csv", refuse)
    path = write_by_hand(tmp_path, "csv-header", some_points())
    with pytest.raises(PermissionError, match=r"scan\.csv"):
        load_scans(path)
