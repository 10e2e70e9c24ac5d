"""Run the native tests with AddressSanitizer and UndefinedBehaviorSanitizer in the kernel.

Usage: python scripts/sanitize.py [ARGUMENTS OF PYTEST]    (default: all native tests)

Needs GCC; `CXX` names another version of it. The instrumented kernel lies in a folder of its own and is
compiled again after each change of the sources (minutes). Python and torch are not instrumented.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from lardhm_torch.native import cache, compiling

ROOT = Path(__file__).parents[1]
OPTIONS = (
    compiling.FOR_THIS_PROCESSOR, "-O1", "-g1", "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined",
)  # fmt: skip
RUNTIMES = ("libasan.so", "libubsan.so")  # Python does not link them: they are loaded first
TESTS = sorted(str(path) for path in (ROOT / "tests").glob("test_native_*.py"))
BUILD = str(ROOT / "tests" / "test_native_build.py")  # compiles, and starts processes


def main(arguments: list[str]) -> int:
    """Compile, run the tests, and return pytest's exit code."""
    compiler = compiling.find_compiler()
    os.environ["LARDHM_CACHE"] = str(Path(tempfile.gettempdir()) / f"lardhm-sanitize-{os.getuid()}")

    def make(target: Path) -> None:
        print("compiling the kernel with sanitizers", flush=True)
        compiling.compile_kernel(compiler, target, OPTIONS)

    cache.cached_file(f"kernel-{compiling.hash_build(compiler)}.so", make)
    runtimes = [find_runtime(compiler, name) for name in RUNTIMES]
    environment = {
        **os.environ,
        "LD_PRELOAD": ":".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python frees little when it ends
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "OMP_NUM_THREADS": "2",
    }
    tests = arguments or [test for test in TESTS if test != BUILD]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *tests]
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
