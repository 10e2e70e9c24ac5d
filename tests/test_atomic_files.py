import os
import shutil
import signal
import stat
import subprocess
import sys

import pytest

from lardhm_torch.io.atomic_files import remove_partials, replaced_file


@pytest.fixture
def path(tmp_path):
    (tmp_path / "map.pt").write_bytes(b"old")
    return tmp_path / "map.pt"


def test_a_file_takes_its_name_at_the_end_of_the_block_and_whole(path):
    with replaced_file(path) as partial:
        partial.write_bytes(b"new")
        assert path.read_bytes() == b"old"
        assert partial.suffix == ".pt"
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_nothing_else(path, error):
    def write_half(partial):
        partial.write_bytes(b"half")
        raise error

    with pytest.raises(type(error)), replaced_file(path) as partial:
        write_half(partial)
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_two_writers_of_one_file_do_not_meet(path):
    with replaced_file(path) as one, replaced_file(path) as other:
        one.write_bytes(b"one")
        other.write_bytes(b"other")
    assert path.read_bytes() == b"one"  # the outer block ends last


def test_who_may_read_the_file_follows_the_umask(path):
    before = os.umask(0o027)
    try:
        with replaced_file(path):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_link_stays_a_link(path, tmp_path):
    link = tmp_path / "link.pt"
    link.symlink_to(path)
    with replaced_file(link) as partial:
        partial.write_bytes(b"new")
    assert link.is_symlink()
    assert path.read_bytes() == b"new"


def test_a_place_that_cannot_be_written_to_is_named(tmp_path):
    with (
        pytest.raises(FileNotFoundError, match=r"folder that exists.*nowhere"),
        replaced_file(tmp_path / "nowhere/map.pt"),
    ):
        pass
    with pytest.raises(IsADirectoryError, match="is a folder"), replaced_file(tmp_path):
        pass


WRITER = """
import sys, time
from lardhm_torch.io.atomic_files import replaced_file

with replaced_file(sys.argv[1]) as partial:
    partial.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def kill_writer(path):
    process = subprocess.Popen([sys.executable, "-c", WRITER, path], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_what_a_killed_writer_leaves_is_found_and_removed(path):
    (path.parent / "link.pt").symlink_to(path)
    others = {"link.pt", "map.pt", ".map.pt.backup", ".notes", ".0123abcd.map.pt.txt"}
    for name in others - {"link.pt", "map.pt"}:
        (path.parent / name).write_text("of someone else")
    for named in (path, path.parent / "link.pt"):
        kill_writer(named)
        assert path.read_bytes() == b"old"
        assert len(list(path.parent.iterdir())) == len(others) + 1
        remove_partials(named)
        assert {file.name for file in path.parent.iterdir()} == others


def test_the_partial_files_of_a_whole_folder_are_removed(path):
    kill_writer(path)
    kill_writer(path.with_name("other.json"))
    (path.parent / "folder").mkdir()
    assert len(list(path.parent.iterdir())) == 4
    remove_partials(path.parent)
    assert {file.name for file in path.parent.iterdir()} == {"map.pt", "folder"}


def test_the_next_writer_removes_what_killed_ones_left(path):
    for _ in range(3):
        kill_writer(path)
        assert len(list(path.parent.iterdir())) == 2  # nothing piles up
    with replaced_file(path) as partial:
        partial.write_bytes(b"new")
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_the_file_of_a_living_writer_is_left_alone(path):
    with replaced_file(path) as first:
        first.write_bytes(b"first")
        remove_partials(path)
        remove_partials(path.parent)
        with replaced_file(path) as second:
            second.write_bytes(b"second")
        assert path.read_bytes() == b"second"
    assert path.read_bytes() == b"first"
    assert list(path.parent.iterdir()) == [path]


def test_a_link_in_the_place_of_the_temporary_file_is_not_followed(path, tmp_path):
    other = tmp_path / "other.txt"
    other.write_bytes(b"precious")
    with replaced_file(path) as partial:
        pass
    partial.symlink_to(other)
    with replaced_file(path) as again:
        assert again != partial
        again.write_bytes(b"new")
    assert (other.read_bytes(), path.read_bytes()) == (b"precious", b"new")


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left on device"), PermissionError(13, "Permission denied")]
)
def test_an_error_of_the_system_names_the_file(path, error):
    with pytest.raises(type(error), match=r"map\.pt'$") as raised, replaced_file(path):
        raise error
    assert raised.value.errno == error.errno
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_a_folder_that_disappears_is_an_error_that_names_the_file(path):
    with pytest.raises(FileNotFoundError, match=r"map\.pt'$"), replaced_file(path):
        shutil.rmtree(path.parent)


def test_an_error_of_another_file_keeps_its_name(path):
    with pytest.raises(FileNotFoundError, match="scans"), replaced_file(path):
        os.stat("scans")
