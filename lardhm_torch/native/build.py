"""Load the kernel: the library that a wheel ships, else one compiled for this machine, else none.

Two libraries register the same operators, so a process loads one of them at most.
"""

from __future__ import annotations

import os
import subprocess
import threading
import warnings
from functools import partial
from pathlib import Path

import torch

from lardhm_torch.native.cache import cached_file
from lardhm_torch.native.compiling import (
    CompileError,
    compile_kernel,
    find_compiler,
    hash_build,
)
from lardhm_torch.native.shipped import shipped_library

OFF = ("0", "false", "off", "no")

_lock = threading.Lock()
_loaded: bool | None = None


def available() -> bool:
    """Whether the kernel can be used; the first call loads it, and compiles it if it must.

    ``LARDHM_NATIVE=0`` in the environment means no, silently; without a library that fits and a
    compiler that works the answer is no, with one warning.
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
        if not _load(shipped_library()):
            library = _compiled_library()
            if not _load(library):  # damaged in the cache: compile it anew, once
                library.unlink(missing_ok=True)
                torch.ops.load_library(str(_compiled_library()))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        reason = " ".join(str(error).split())[:300]
        warnings.warn(
            f"the native kernel is not available, maps answer several times slower: {reason}. "
            "Install a C++ compiler, or set LARDHM_NATIVE=0 to silence this",
            stacklevel=4,
        )
        return False
    return True


def _load(library: Path | None) -> bool:
    """Whether a library could be loaded; if not, nothing of it is left in the process."""
    if library is None:
        return False
    try:
        torch.ops.load_library(str(library))
    except OSError:
        return False
    return True


def _compiled_library() -> Path:
    """The library compiled for this machine, compiled now if it is not in the cache."""
    compiler = find_compiler()
    return cached_file(f"kernel-{hash_build(compiler)}.so", partial(compile_kernel, compiler))
