"""Load the native library: from the wheel, else compiled for this machine, else none.

- Linux on x86-64: the wheel for this platform contains it; with the pure wheel it is compiled.
- Linux on other processors, macOS: it is compiled on first use.
- Windows, and systems without a compiler: plain torch is used, with one warning.

Two libraries register the same operators, so a process loads one of them at most.
"""

from __future__ import annotations

import os
import platform
import subprocess
import threading
import warnings
from functools import partial
from pathlib import Path

import torch

from lardhm_torch.native.cache import cached_file
from lardhm_torch.native.compiling import compile_kernel, find_compiler, hash_build
from lardhm_torch.native.shipped import shipped_library

OFF = ("0", "false", "off", "no")

_lock = threading.Lock()
_loaded: bool | None = None


def available() -> bool:
    """Whether the native library can be used; the first call loads it, and compiles it if necessary.

    False without a warning if ``LARDHM_NATIVE=0`` is set in the environment; False with one warning if
    there is neither a suitable library nor a working compiler.
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
    problem = _load_shipped()
    if problem is None:
        return True
    try:
        _load_compiled()
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        reason = " ".join(f"{problem}, and {error}".split())[:400]
        warnings.warn(
            f"the native library is not available, so queries are several times slower: {reason}. "
            "LARDHM_NATIVE=0 silences this warning",
            stacklevel=4,
        )
        return False
    return True


def _load_shipped() -> str | None:
    """Load what the installation ships; why that is not possible, or None."""
    library = shipped_library()
    if library is None:
        return f"no compiled library is installed for {platform.system()} on {platform.machine()}"
    try:
        torch.ops.load_library(str(library))
    except OSError as error:
        return f"the installed library does not load ({error})"
    return None


def _load_compiled() -> None:
    library = _compiled_library()
    try:
        torch.ops.load_library(str(library))
    except OSError:  # damaged in the cache: compile it anew, once
        library.unlink(missing_ok=True)
        torch.ops.load_library(str(_compiled_library()))


def _compiled_library() -> Path:
    """The library compiled for this machine, compiled now if it is not in the cache."""
    compiler = find_compiler()
    return cached_file(f"kernel-{hash_build(compiler)}.so", partial(compile_kernel, compiler))
