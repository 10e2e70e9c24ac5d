"""Compile the kernel once for this machine and load it; without a compiler, say so once.

The library is built in a temporary folder and takes its final name in one step, so neither a killed
build nor two builds at once leave anything that a later one waits for or trips over. Its name holds
a hash of source, torch version, compiler flags and processor: a home folder shared by different
machines holds one library for each.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

FOLDER = Path(__file__).parent
FLAGS = (
    "-std=c++17", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno",
    "-fno-trapping-math", "-fno-tree-slp-vectorize",  # packs neighbors through memory, and stalls
    "-fPIC", "-w", "-DTORCH_TARGET_VERSION=0x020a000000000000",
)  # fmt: skip
# Sources that are compiled together, the longest job first. Torch's headers take a second a unit: the
# last two do without.
UNITS = (
    ("query", "kmeans", "gradients", "descent", "tuning"),
    ("raycast", "update", "pooling", "evidence", "cells", "marching", "ridge", "threads"),
    ("search", "index"),
    ("kth_distance", "parameters", "sorting"),
)
COMPILERS = ("c++", "g++", "clang++")
OFF = ("0", "false", "off", "no")

_lock = threading.Lock()
_loaded: bool | None = None


def available() -> bool:
    """Whether the kernel can be used; the first call builds and loads it.

    ``LARDHM_NATIVE=0`` in the environment means no, silently; a missing or failing compiler means
    no with one warning.
    """
    global _loaded
    if _loaded is None:
        with _lock:
            if _loaded is None:
                _loaded = _try_to_load()
    return _loaded


def _try_to_load() -> bool:
    if os.environ.get("LARDHM_NATIVE", "1").lower() in OFF:
        return False
    try:
        library = _cached_library()
        try:
            torch.ops.load_library(str(library))
        except OSError:  # damaged in the cache: build it anew, once
            library.unlink(missing_ok=True)
            torch.ops.load_library(str(_cached_library()))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        reason = " ".join(str(error).split())[:300]
        warnings.warn(
            f"the native kernel is not available, maps answer several times slower: {reason}. "
            "Install a C++ compiler, or set LARDHM_NATIVE=0 to silence this",
            stacklevel=4,
        )
        return False
    return True


def _cached_library() -> Path:
    """The compiled library for this machine, built if it is not there yet."""
    compiler = _compiler()
    name = f"kernel-{_cache_key(compiler)}.so"
    for folder in _cache_folders():
        if (folder / name).is_file():
            return folder / name
    for folder in _cache_folders():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix="build-", dir=folder) as scratch:
                built = Path(scratch) / name
                _compile(compiler, built)
                os.replace(built, folder / name)
            return folder / name
        except (PermissionError, FileExistsError, NotADirectoryError):
            continue
    raise OSError("no folder for the compiled kernel is writable; set LARDHM_CACHE to one")


def _compiler() -> list[str]:
    """The compiler's command, with its arguments where ``CXX`` has some ("ccache g++")."""
    named = shlex.split(os.environ.get("CXX", ""))
    for program, *arguments in [named] if named else [[name] for name in COMPILERS]:
        if found := shutil.which(program):
            return [found, *arguments]
    raise OSError(f"no C++ compiler found (looked for {' '.join(named) or ', '.join(COMPILERS)})")


def _cache_folders() -> list[Path]:
    named = os.environ.get("LARDHM_CACHE")
    home = Path(named) if named else Path.home() / ".cache" / "lardhm_torch"
    return [home, Path(tempfile.gettempdir()) / f"lardhm_torch-{os.getuid()}"]


def _cache_key(compiler: list[str]) -> str:
    parts = [
        *(path.read_bytes() for path in sorted(FOLDER.iterdir()) if path.suffix in (".cpp", ".h")),
        torch.__version__.encode(),
        " ".join((*compiler, *FLAGS)).encode(),
        f"{sys.platform} {platform.machine()}".encode(),
        _processor_flags(),
    ]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:20]


def _processor_flags() -> bytes:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().split(b"\n")
    except OSError:
        return platform.processor().encode()
    wanted = (b"flags", b"Features", b"model name")
    return b"\n".join(sorted({line for line in lines if line.startswith(wanted)}))


def _compile(compiler: list[str], target: Path) -> None:
    """Unit by unit, as many at once as there are processors, then one library of all."""
    root = Path(torch.__file__).parent
    sources = _write_units(target.parent)
    objects = [source.with_suffix(".o") for source in sources]
    commands = [
        [*compiler, *FLAGS, f"-isystem{root / 'include'}", "-c", str(source), "-o", str(made)]
        for source, made in zip(sources, objects, strict=True)
    ]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_run, commands, objects))
    link = [
        *compiler, "-shared", *map(str, objects), "-o", str(target),
        f"-L{root / 'lib'}", "-ltorch", "-ltorch_cpu", "-lc10",
    ]  # fmt: skip
    _run(link, target)


def _write_units(folder: Path) -> list[Path]:
    """Files that include the sources of a unit each; a source that no unit names is one by itself."""
    others = {source.stem for source in FOLDER.glob("*.cpp")}.difference(*UNITS)
    units = [*UNITS, *((name,) for name in sorted(others))]
    paths = [folder / f"{unit[0]}.cpp" for unit in units]
    for path, unit in zip(paths, units, strict=True):
        path.write_text("".join(f'#include "{FOLDER / name}.cpp"\n' for name in unit))
    return paths


def _run(command: list[str], made: Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode or not made.is_file():
        lines = [line for line in done.stderr.splitlines() if "error" in line] or ["no output"]
        raise OSError(f"{command[0]} failed with exit code {done.returncode}: {lines[0]}")
