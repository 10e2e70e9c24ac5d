"""Run the native tests with sanitizers in the kernel.

Usage: python scripts/sanitize.py [memory | threads]    (default: both)

memory: AddressSanitizer and UndefinedBehaviorSanitizer, all native tests.
threads: ThreadSanitizer, readers beside a writer. Torch's own threads are off, since GCC's OpenMP is not
instrumented.

Needs GCC; `CXX` names another version of it. An instrumented kernel lies in a folder of its own and is
compiled again after each change of the sources (minutes). Python and torch are not instrumented.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from lardhm_torch.native import cache, compiling

ROOT = Path(__file__).parents[1]
BUILDING = ("test_native_build.py", "test_native_shipped.py")  # not about the kernel itself
NATIVE = [
    str(p) for p in sorted((ROOT / "tests").glob("test_native_*.py")) if p.name not in BUILDING
]


class Check(NamedTuple):
    """Options of the compiler, its runtimes (Python does not link them), settings, and tests."""

    options: tuple[str, ...]
    runtimes: tuple[str, ...]
    settings: dict[str, str]
    tests: list[str]
    prefix: tuple[str, ...] = ()


CHECKS = {
    "memory": Check(
        ("-fsanitize=address,undefined",),
        ("libasan.so", "libubsan.so"),
        # Python frees little when it ends
        {"ASAN_OPTIONS": "detect_leaks=0", "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1"},
        NATIVE,
    ),
    "threads": Check(
        ("-fsanitize=thread",),
        ("libtsan.so",),
        {"TSAN_OPTIONS": "halt_on_error=1:exitcode=66", "OMP_NUM_THREADS": "1"},
        [str(ROOT / "tests" / "test_native_threads.py")],
        ("setarch", "--addr-no-randomize"),  # TSan needs its addresses free
    ),
}


def main(names: list[str]) -> int:
    """Compile, run the tests of each check, and return the first exit code of pytest that is not 0."""
    return next((code for name in names or CHECKS if (code := run(CHECKS[name], name))), 0)


def run(check: Check, name: str) -> int:
    """Run the tests of one check."""
    compiler = compiling.find_compiler()
    folder = Path(tempfile.gettempdir()) / f"lardhm-sanitize-{name}-{os.getuid()}"
    os.environ["LARDHM_CACHE"] = str(folder)
    options = (
        compiling.FOR_THIS_PROCESSOR,
        "-O1",
        "-g1",
        "-fno-omit-frame-pointer",
        *check.options,
    )

    def make(target: Path) -> None:
        print(f"compiling the kernel with {check.options[0]}", flush=True)
        compiling.compile_kernel(compiler, target, options)

    cache.cached_file(f"kernel-{compiling.hash_build(compiler)}.so", make)
    runtimes = ":".join(find_runtime(compiler, runtime) for runtime in check.runtimes)
    command = [
        *check.prefix,
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        *check.tests,
    ]
    environment = {**os.environ, **check.settings, "LD_PRELOAD": runtimes}
    return subprocess.run(command, cwd=ROOT, env=environment).returncode


def find_runtime(compiler: list[str], name: str) -> str:
    """Path of a runtime library of the compiler."""
    command = [*compiler, f"-print-file-name={name}"]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    if not Path(found).is_file():
        raise SystemExit(f"{compiler[0]} has no {name}; set CXX to a GCC with sanitizers")
    return found


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
