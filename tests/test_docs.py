"""Every snippet and command of the README and of docs/ is run here, on small scans."""

import doctest
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lardhm_torch
from lardhm_torch import Scans, cli, save_scans, simulate_room

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUNNABLE = ("python", "sh")


def blocks(page):
    return [(kind, text) for kind, text in BLOCK.findall(page.read_text()) if kind in RUNNABLE]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with the scans that the pages speak of."""
    monkeypatch.chdir(tmp_path)
    scans = simulate_room(3000, seed=0)
    (tmp_path / "scans").mkdir()
    save_scans(scans, tmp_path / "scans" / "one.npz")
    save_scans(scans, tmp_path / "room.npz")
    for name in ("drive", "more"):  # scan by scan, one file each
        (tmp_path / name).mkdir()
        for number in range(scans.num_scans):
            seen = scans.scan_id == number
            place, ends = scans.origins[number][None], scans.ends[seen]
            one = Scans(place, ends, None, scans.is_return[seen])
            save_scans(one, tmp_path / name / f"{number}.npz")
    return tmp_path


def run_command(line, monkeypatch):
    """One line of a `sh` block; what sets the machine up is checked, not done."""
    line = line.split("#")[0].strip()
    words = line.split()
    if not words or line == ". .venv/bin/activate":
        return
    if words[0] == "make":
        subprocess.run(["make", "-n", words[1]], cwd=ROOT, check=True, capture_output=True)
    elif words[0] == "pip":
        extras = re.findall(r"\[([\w,]+)\]", line)
        for extra in ",".join(extras).split(","):
            assert f"\n{extra} = [" in (ROOT / "pyproject.toml").read_text(), line
    elif words[:2] == ["lardhm", "view"] and "--export" not in words:
        run_command(f"{line} --export page.html --resolution 0.3", monkeypatch)
    elif words[0] == "lardhm":
        assert cli.main(words[1:]) == 0, line
    elif words[0] == "torchrun":  # with two ranks it is run in test_tiles_fitting.py
        assert cli.main(words[words.index("lardhm_torch.cli") + 1 :]) == 0, line
    else:
        raise AssertionError(f"no rule to check {line!r}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_says_works(page, folder, monkeypatch):
    names: dict = {}
    for number, (kind, text) in enumerate(blocks(page)):
        if "viewer" in text or "lardhm view" in text:
            pytest.importorskip("viser", reason="viser is not installed")
        if "--mcap" in text or "foxglove" in text:
            pytest.importorskip("mcap", reason="mcap is not installed")
        if kind == "sh":
            for line in text.splitlines():
                run_command(line, monkeypatch)
        else:
            exec(compile(text, f"{page.name}, block {number}", "exec"), names)


def test_there_are_snippets_to_run():
    kinds = [kind for page in PAGES for kind, _ in blocks(page)]
    assert kinds.count("python") >= 15
    assert kinds.count("sh") >= 3


@pytest.mark.parametrize(
    "name", [m.name for m in pkgutil.walk_packages(lardhm_torch.__path__, "lardhm_torch.")]
)
def test_examples_in_docstrings_are_true(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_every_picture_of_the_pages_is_there():
    for page in PAGES:
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page.read_text()):
            assert (page.parent / target).is_file(), f"{page.name}: {target}"


def test_the_documentation_builds_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="sphinx is not installed")
    pytest.importorskip("furo", reason="furo is not installed")
    command = ["-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    result = subprocess.run(
        [sys.executable, *command, str(ROOT / "docs"), str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
