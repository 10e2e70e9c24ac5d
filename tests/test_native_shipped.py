"""Which of the libraries in a wheel is loaded, and what happens if none fits."""

import warnings

import pytest

from lardhm_torch.native import build, shipped
from lardhm_torch.native.shipped import LEVELS, library_name, processor_level

V3, V4 = LEVELS["x86-64-v3"], LEVELS["x86-64-v4"]


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    """An installed wheel on a processor of level 3; its libraries are empty."""
    for level in LEVELS:
        (tmp_path / library_name(level)).touch()
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    monkeypatch.setattr(shipped.sys, "platform", "linux")
    monkeypatch.setattr(shipped.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(shipped, "processor_flags", lambda: V3 | {"sse2", "sha_ni"})
    return tmp_path


@pytest.mark.parametrize(
    ("flags", "level"),
    [
        (V4 | {"amx_tile"}, "x86-64-v4"),
        (V4 - {"avx512vl"}, "x86-64-v3"),
        (V3, "x86-64-v3"),
        (V4 - {"fma"}, "x86-64"),
        ({"sse2", "avx", "avx2"}, "x86-64"),
        (set(), "x86-64"),
    ],
)
def test_the_highest_level_that_the_processor_has_all_flags_of_is_taken(flags, level):
    assert processor_level(flags) == level


def test_the_flags_are_those_of_the_file_of_the_system(tmp_path, monkeypatch):
    listing = tmp_path / "cpuinfo"
    listing.write_text("model name\t: A\nflags\t\t: fpu sse2 avx\nbugs\t\t: x\n\nflags\t: other\n")
    monkeypatch.setattr(shipped, "CPUINFO", listing)
    assert shipped.processor_flags() == {"fpu", "sse2", "avx"}
    monkeypatch.setattr(shipped, "CPUINFO", tmp_path / "missing")
    assert shipped.processor_flags() == set()


def test_the_library_of_the_level_is_taken(wheel):
    assert shipped.shipped_library() == wheel / library_name("x86-64-v3")


@pytest.mark.parametrize(("system", "machine"), [("darwin", "x86_64"), ("linux", "aarch64")])
def test_other_platforms_take_none(wheel, monkeypatch, system, machine):
    monkeypatch.setattr(shipped.sys, "platform", system)
    monkeypatch.setattr(shipped.platform, "machine", lambda: machine)
    assert shipped.shipped_library() is None


def test_a_library_of_other_sources_is_not_taken(wheel, monkeypatch):
    monkeypatch.setattr(shipped, "hash_sources", lambda: "edited")
    assert shipped.shipped_library() is None


def test_a_library_that_does_not_load_is_replaced_by_a_compiled_one(wheel, monkeypatch):
    compiled = []
    monkeypatch.setattr(build, "_load_compiled", lambda: compiled.append(True))
    monkeypatch.setenv("LARDHM_NATIVE", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert build._try_to_load()
    assert compiled == [True]


def test_without_a_compiler_the_warning_says_why_the_shipped_one_does_not_load(wheel, monkeypatch):
    monkeypatch.setenv("LARDHM_NATIVE", "1")
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(UserWarning, match=r"installed library does not load \(.*no-such-compiler"):
        assert not build._try_to_load()


def test_on_windows_the_warning_says_that_there_is_no_kernel(monkeypatch):
    monkeypatch.setattr(shipped.sys, "platform", "win32")
    monkeypatch.setenv("LARDHM_NATIVE", "1")
    with pytest.warns(UserWarning, match="cannot be compiled on Windows"):
        assert not build._try_to_load()
