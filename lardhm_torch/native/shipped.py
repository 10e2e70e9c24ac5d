"""Libraries that a wheel ships: compiled ahead, one for each level of x86-64 processors.

The wheel for Linux on x86-64 holds them; the pure wheel and the sources hold none.
"""

from __future__ import annotations

import platform
import sys
from pathlib import Path

from lardhm_torch.native.compiling import SOURCES, hash_sources

FOLDER = SOURCES / "shipped"
CPUINFO = Path("/proc/cpuinfo")
_V3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
# Levels of the x86-64 psABI, the highest first, and the flags of the processor that each needs.
LEVELS = {
    "x86-64-v4": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3": _V3,
    "x86-64": set(),
}


def shipped_library() -> Path | None:
    """The shipped library for this processor, or None; one of other sources does not count."""
    if not FOLDER.is_dir() or sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    library = FOLDER / library_name(processor_level(processor_flags()))
    return library if library.is_file() else None


def library_name(level: str) -> str:
    """File name of the library for a level, compiled from the sources as they are now."""
    return f"kernel-{level}-{hash_sources()}.so"


def processor_level(flags: set[str]) -> str:
    """The highest of `LEVELS` for a processor with these flags."""
    return next(level for level, needed in LEVELS.items() if needed <= flags)


def processor_flags() -> set[str]:
    """What the processor can do and the kernel allows, as Linux names it; empty where unknown."""
    try:
        lines = CPUINFO.read_text().splitlines()
    except OSError:
        return set()
    flags = next((line for line in lines if line.startswith("flags")), "")
    return set(flags.partition(":")[2].split())
