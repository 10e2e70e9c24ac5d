"""Compiled code is loaded only from folders that nobody else can write to."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lardhm_torch.native import cache

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no owners and modes")


def write_kernel(path: Path) -> None:
    path.write_text("kernel")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The user's cache; the folder for temporary files lies beside it."""
    (tmp_path / "temporary").mkdir(mode=0o700)
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path / "temporary"))
    cache._process_folder.cache_clear()
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "home" / "cache"))
    return tmp_path / "home" / "cache"


def kept_elsewhere(home: Path, reason: str) -> Path:
    """The kernel made in a temporary folder, with a warning that names the reason and the cure."""
    with pytest.warns(UserWarning, match=f"{reason}.*set LARDHM_CACHE"):
        kept = cache.cached_file("kernel.so", write_kernel)
    assert home not in kept.parents
    assert kept.parent.stat().st_mode & 0o777 == 0o700
    assert kept.read_text() == "kernel"
    return kept


def test_a_new_cache_is_private_and_used_again(home):
    home.parent.mkdir()
    old = os.umask(0)
    try:
        kept = cache.cached_file("kernel.so", write_kernel)
    finally:
        os.umask(old)
    assert kept == home / "kernel.so"
    assert (home.stat().st_mode & 0o777, kept.stat().st_mode & 0o777) == (0o700, 0o700)
    assert cache.cached_file("kernel.so", lambda path: pytest.fail("made again")) == kept
    assert list(home.iterdir()) == [kept]


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_nothing_is_loaded_from_a_cache_that_others_can_write_to(home, mode):
    kept = cache.cached_file("kernel.so", write_kernel)
    kept.write_text("planted")
    home.chmod(mode)
    kept_elsewhere(home, f"other users can write to {re.escape(str(home))}")


def test_nothing_is_loaded_below_a_folder_that_others_can_write_to(home):
    cache.cached_file("kernel.so", write_kernel).write_text("planted")
    home.parent.chmod(0o777)
    kept_elsewhere(home, "other users can write")
    home.parent.chmod(0o1777)  # sticky: others cannot replace the folder
    assert cache.cached_file("kernel.so", write_kernel).read_text() == "planted"


def test_a_library_that_others_can_write_to_is_not_loaded(home):
    kept = cache.cached_file("kernel.so", write_kernel)
    kept.write_text("planted")
    kept.chmod(0o722)
    kept_elsewhere(home, "other users can write")


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give away"
)
@pytest.mark.parametrize("place", ["kernel.so", ".", ".."])
def test_a_library_or_folder_of_another_user_is_not_used(home, place):
    cache.cached_file("kernel.so", write_kernel).write_text("planted")
    os.chown((home / place).resolve(), 12345, -1)
    kept_elsewhere(home, r"belongs to another user \(uid 12345\)")


def test_a_link_to_a_folder_that_others_can_write_to_is_followed_before_the_check(home, tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    home.parent.mkdir()
    home.symlink_to(tmp_path / "open")
    kept_elsewhere(home, "other users can write")


def test_a_file_in_place_of_the_folder_means_a_temporary_one_that_is_used_again(home):
    home.parent.write_text("not a folder")
    kept = kept_elsewhere(home, "Not a directory")
    assert kept_elsewhere(home, "Not a directory") == kept


def test_a_read_only_file_system_means_a_temporary_folder(home, monkeypatch):
    make = os.mkdir

    def refuse(path, mode=0o777, **options):
        if "home" in Path(path).parts:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        make(path, mode, **options)

    monkeypatch.setattr(os, "mkdir", refuse)
    kept_elsewhere(home, "Read-only file system")


def test_a_cache_that_is_read_only_still_gives_what_it_holds(home, monkeypatch):
    kept = cache.cached_file("kernel.so", write_kernel)
    monkeypatch.setattr(cache, "_make_in_one_step", lambda *_: pytest.fail("written"))
    assert cache.cached_file("kernel.so", write_kernel) == kept


def test_a_temporary_folder_that_another_user_laid_out_is_not_used(home, tmp_path):
    home.parent.write_text("not a folder")
    trap = tmp_path / "temporary" / f"lardhm_torch-{os.getuid()}"
    trap.mkdir()
    trap.chmod(0o777)
    (trap / "kernel.so").write_text("planted")
    assert trap not in kept_elsewhere(home, "other users can write").parents


def test_without_any_private_folder_there_is_no_kernel(home, tmp_path):
    home.parent.write_text("not a folder")
    (tmp_path / "temporary").chmod(0o777)
    with pytest.raises(OSError, match=r"no folder for the compiled library.*LARDHM_CACHE"):
        cache.cached_file("kernel.so", write_kernel)


def test_the_folder_of_one_process_is_gone_after_it(home, tmp_path):
    home.parent.write_text("not a folder")
    (tmp_path / "temporary" / f"lardhm_torch-{os.getuid()}").write_text("not a folder either")
    code = f"""
import runpy
cached_file = runpy.run_path({cache.__file__!r})["cached_file"]
print(cached_file("kernel.so", lambda path: path.write_text("kernel")).read_text())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "TMPDIR": str(tmp_path / "temporary")},
    )  # fmt: skip
    assert done.stdout == "kernel\n"
    assert "Not a directory" in done.stderr
    assert len(list((tmp_path / "temporary").iterdir())) == 1
