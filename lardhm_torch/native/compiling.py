"""Compile the C++ sources of the native library."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

SOURCES = Path(__file__).parent
FLAGS = (
    "-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno",
    "-fno-trapping-math", "-fno-tree-slp-vectorize",  # packs neighbors through memory, and stalls
    "-fPIC", "-w", "-DTORCH_TARGET_VERSION=0x020a000000000000",
)  # fmt: skip
ARM = platform.machine() in ("aarch64", "arm64")
FOR_THIS_PROCESSOR = "-mcpu=native" if ARM else "-march=native"
# Sources that are compiled together, the longest job first. The standard library's headers take a second
# a unit, torch's, which only the last includes, two more.
UNITS = (
    ("query", "kmeans", "gradients", "descent", "mixture", "tuning"),
    (
        "raycast",
        "expected_range",
        "update",
        "pooling",
        "evidence",
        "kept",
        "cells",
        "thinning",
        "passages",
        "axes",
        "marching",
        "ridge",
    ),
    ("search", "index"),
    ("kth_distance", "parameters", "sorting"),
    ("bindings", "threads"),
)
LONGEST = 1800  # [s] for one unit, on a slow and busy machine
COMPILERS = ("c++", "g++", "clang++")


class CompileError(RuntimeError):
    """There is no compiler for this platform, or it failed."""


def find_compiler() -> list[str]:
    """The compiler's command, with its arguments where ``CXX`` has some ("ccache g++").

    Raises:
        CompileError: there is none, or the platform is not supported.
    """
    if sys.platform == "win32":
        raise CompileError("it cannot be compiled on Windows")
    named = shlex.split(os.environ.get("CXX", ""))
    for program, *arguments in [named] if named else [[name] for name in COMPILERS]:
        if found := shutil.which(program):
            return [found, *arguments]
    looked_for = " ".join(named) or ", ".join(COMPILERS)
    raise CompileError(f"no C++ compiler was found (looked for {looked_for}): install one")


def hash_sources() -> str:
    """Name of the version of the sources."""
    sources = (path for path in sorted(SOURCES.iterdir()) if path.suffix in (".cpp", ".h"))
    return _hash(*(path.read_bytes() for path in sources))


def hash_build(compiler: list[str]) -> str:
    """Name of what `compile_kernel` makes for this processor: all that it depends on."""
    return _hash(
        hash_sources().encode(),
        torch.__version__.encode(),
        " ".join((*compiler, *FLAGS, FOR_THIS_PROCESSOR)).encode(),
        _compiler_version(compiler[0]),
        f"{sys.platform} {platform.machine()}".encode(),
        _processor(),
    )


def _hash(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:20]


def _compiler_version(program: str) -> bytes:
    """Changes when the compiler is replaced; asking the compiler itself would take longer."""
    path = Path(program).resolve()
    status = path.stat()
    return f"{path} {status.st_size} {status.st_mtime_ns}".encode()


def _processor() -> bytes:
    """What `FOR_THIS_PROCESSOR` depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().split(b"\n")
    except OSError:
        return platform.processor().encode()
    wanted = (b"flags", b"Features", b"model name")
    return b"\n".join(sorted({line for line in lines if line.startswith(wanted)}))


def compile_kernel(
    compiler: list[str], target: Path, options: Sequence[str] = (FOR_THIS_PROCESSOR,)
) -> None:
    """Unit by unit, as many at once as there are processors, then one library of all.

    Args:
        compiler: its command.
        target: the library; its folder also takes the files in between.
        options: further options for compiler and linker.

    Raises:
        CompileError: the compiler failed.
    """
    root = Path(torch.__file__).parent
    command = [*compiler, *FLAGS, *options]
    units = _write_units(target.parent)
    objects = [unit.with_suffix(".o") for unit in units]
    jobs = [
        [*command, f"-isystem{root / 'include'}", "-c", str(unit), "-o", str(made)]
        for unit, made in zip(units, objects, strict=True)
    ]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_run, jobs, objects))
    libraries = [f"-L{root / 'lib'}", "-ltorch_cpu", "-lc10"]
    _run([*command, "-shared", *map(str, objects), "-o", str(target), *libraries], target)


def _write_units(folder: Path) -> list[Path]:
    """Files that include the sources of a unit each; a source that no unit names is one by itself."""
    others = {source.stem for source in SOURCES.glob("*.cpp")}.difference(*UNITS)
    units = [*UNITS, *((name,) for name in sorted(others))]
    paths = [folder / f"{unit[0]}.cpp" for unit in units]
    for path, unit in zip(paths, units, strict=True):
        path.write_text("".join(f'#include "{SOURCES / name}.cpp"\n' for name in unit))
    return paths


def _run(command: list[str], made: Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST)
    if done.returncode or not made.is_file():
        lines = [line for line in done.stderr.splitlines() if "error" in line] or ["no output"]
        raise CompileError(f"{command[0]} failed with exit code {done.returncode}: {lines[0]}")
