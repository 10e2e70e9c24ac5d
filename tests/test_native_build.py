"""The native library is built once, safely, and never needed."""

import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import pytest
import torch

from lardhm_torch import native
from lardhm_torch.native import build, compiling

ROOT = Path(__file__).parents[1]

ASK = """
import warnings
warnings.simplefilter("always")
import torch
from lardhm_torch import native
with warnings.catch_warnings(record=True) as heard:
    warnings.simplefilter("always")
    points = torch.rand(10, 3)
    centers = torch.rand(4, 3)
    raw, weights, kernel = torch.zeros(4, 3, 3), torch.ones(4), native.Kernel(2)
    for _ in range(3):
        native.occupancy(points, centers, raw, weights, kernel, probability=True)
print(native.available(), len(heard), *[str(w.message) for w in heard])
"""


def ask_in_process(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", ASK], capture_output=True, text=True, timeout=240, cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_without_a_compiler_one_warning_names_the_cause_and_the_cure(tmp_path):
    answer = ask_in_process(CXX="no-such-compiler", LARDHM_CACHE=str(tmp_path), LARDHM_NATIVE="1")
    assert answer.startswith("False 1 ")
    assert f"no compiled library is installed for {platform.system()} on" in answer
    assert "no-such-compiler" in answer
    assert "LARDHM_NATIVE=0" in answer


def test_a_failing_compiler_means_the_plain_path(tmp_path):
    answer = ask_in_process(CXX="false", LARDHM_CACHE=str(tmp_path), LARDHM_NATIVE="1")
    assert answer.startswith("False 1 ")


@pytest.mark.parametrize("word", ["0", "false", "OFF"])
def test_switched_off_it_is_silent(word, tmp_path):
    answer = ask_in_process(LARDHM_NATIVE=word, LARDHM_CACHE=str(tmp_path))
    assert answer == "False 0"
    assert list(tmp_path.iterdir()) == []


def stub_compiler(tmp_path: Path, body: str) -> Path:
    """A compiler that does as the shell lines say; $target is the file it is to make."""
    script = tmp_path / "compiler.sh"
    find_target = 'while [ "$1" != "-o" ]; do shift; done; target=$2'
    script.write_text(f"#!/bin/sh\n{find_target}\n{body}\n")
    script.chmod(0o755)
    return script


def test_a_killed_build_leaves_nothing_that_blocks_the_next(tmp_path, monkeypatch):
    slow = stub_compiler(tmp_path, 'echo half > "$target"; exec sleep 100')
    environment = {**os.environ, "CXX": str(slow), "LARDHM_NATIVE": "1"}
    environment["LARDHM_CACHE"] = str(tmp_path / "cache")
    started = subprocess.Popen([sys.executable, "-c", ASK], cwd=ROOT, env=environment,
                               start_new_session=True, stdout=subprocess.DEVNULL)  # fmt: skip
    deadline = time.monotonic() + 60
    while not list((tmp_path / "cache").glob("build-*/*.o")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    assert list((tmp_path / "cache").glob("build-*/*.o"))
    quick = stub_compiler(tmp_path, 'echo whole > "$target"')
    monkeypatch.setenv("CXX", str(quick))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    library = build._compiled_library()
    assert library.read_text() == "whole\n"
    assert library.parent == tmp_path / "cache"


def test_two_builds_at_once_both_succeed(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", str(stub_compiler(tmp_path, 'sleep 0.3; echo whole > "$target"')))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    built: list[Path] = []
    threads = [
        threading.Thread(target=lambda: built.append(build._compiled_library())) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(built) == 2
    assert built[0] == built[1]
    assert built[0].read_text() == "whole\n"
    assert list((tmp_path / "cache").iterdir()) == [built[0]]


def test_a_damaged_library_in_the_cache_is_built_anew(ops, tmp_path, monkeypatch):
    sound = build._compiled_library()
    compiler = stub_compiler(tmp_path, f'cp "{sound}" "$target"')
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("LARDHM_CACHE", str(tmp_path / "cache"))
    damaged = build._compiled_library()
    damaged.write_bytes(b"no library")
    environment = {"CXX": str(compiler), "LARDHM_CACHE": str(tmp_path / "cache")}
    assert ask_in_process(LARDHM_NATIVE="1", **environment) == "True 0"
    assert damaged.read_bytes() == sound.read_bytes()


def test_a_change_of_source_torch_compiler_or_processor_is_another_library(tmp_path, monkeypatch):
    compiler = tmp_path / "c++"
    compiler.write_text("version 1")
    command = [str(compiler)]
    names = [compiling.hash_build(command)]
    assert compiling.hash_build(command) == names[0]
    names.append(compiling.hash_build([*command, "-O1"]))
    compiler.write_text("version 1.1")  # an update in place
    names.append(compiling.hash_build(command))
    monkeypatch.setattr(torch, "__version__", "2.99")
    names.append(compiling.hash_build(command))
    monkeypatch.setattr(compiling, "_processor", lambda: b"flags: sse2")
    names.append(compiling.hash_build(command))
    changed = shutil.copytree(compiling.SOURCES, tmp_path / "native")
    with (changed / "index.h").open("a") as source:
        source.write("\n")
    monkeypatch.setattr(compiling, "SOURCES", changed)
    names.append(compiling.hash_build(command))
    assert len(set(names)) == len(names)


def test_importing_the_package_builds_and_loads_nothing(tmp_path):
    code = "import lardhm_torch.native as n; print(n.build._loaded)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True,
        env={**os.environ, "LARDHM_CACHE": str(tmp_path / "none")},
    )  # fmt: skip
    assert done.stdout.strip() == "None"
    assert not (tmp_path / "none").exists()


def test_other_dimensions_and_types_take_the_plain_path():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where there is no compiler
        assert not native.supports(torch.zeros(2, 4))
        assert not native.supports(torch.zeros(2, 3, dtype=torch.float16))
