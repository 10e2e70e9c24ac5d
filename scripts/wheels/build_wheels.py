"""Build the pure wheel, and the wheel for Linux on x86-64 with the kernel inside.

Usage: python scripts/wheels/build_wheels.py [FOLDER]    (default: out/wheels)

The second wheel is the first one plus the kernel, compiled with the torch of this environment for each
level of x86-64 processors. Torch's stable ABI makes one library serve torch 2.10 and later. `CXX` names
the compiler, as usual. Needs the packages of the extra `wheel`.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from lardhm_torch.native import compiling, shipped

ROOT = Path(__file__).parents[2]
PACKAGED = ("lardhm_torch", "pyproject.toml", "README.md", "LICENSE")
PLATFORM = "manylinux_2_28_x86_64"  # that of torch's own wheels
TORCH = {"libtorch_cpu.so", "libc10.so"}
LARGEST = 5_000_000  # bytes
OPTIONS = (
    "-include", str(Path(__file__).with_name("old_glibc.h")),
    "-fvisibility=hidden", "-Wl,--strip-all", "-Wl,--exclude-libs,ALL",
)  # fmt: skip


def main(folder: Path) -> None:
    """Write both wheels to a folder, check them, and print their sizes."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        pure = build_pure_wheel(Path(scratch))
        binary = add_libraries(pure, Path(scratch))
        check_platform(binary)
        for wheel in (pure, binary):
            size = wheel.stat().st_size
            if size > LARGEST:
                raise SystemExit(f"{wheel.name} has {size} bytes, more than {LARGEST}")
            shutil.copy(wheel, folder / wheel.name)
            print(f"{folder / wheel.name}: {size / 1e6:.2f} MB")


def build_pure_wheel(scratch: Path) -> Path:
    """Build the wheel from a copy of the sources, which leaves nothing in the checkout."""
    copy = scratch / "sources"
    copy.mkdir()
    for name in PACKAGED:
        path = ROOT / name
        shutil.copytree(path, copy / name) if path.is_dir() else shutil.copy(path, copy)
    run("pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(scratch), str(copy))
    (wheel,) = scratch.glob("*-py3-none-any.whl")
    return wheel


def add_libraries(wheel: Path, scratch: Path) -> Path:
    """The wheel with a library for each level of processors beside the sources."""
    run("wheel", "unpack", str(wheel), "--dest", str(scratch / "unpacked"))
    (tree,) = (scratch / "unpacked").iterdir()
    libraries = tree / shipped.FOLDER.relative_to(ROOT)
    libraries.mkdir()
    compiler = compiling.find_compiler()
    for level in shipped.LEVELS:
        with tempfile.TemporaryDirectory(dir=scratch) as build:
            made = Path(build) / shipped.library_name(level)
            compiling.compile_kernel(compiler, made, (*OPTIONS, f"-march={level}"))
            shutil.copy(made, libraries)
    (record,) = tree.glob("*.dist-info/WHEEL")
    record.write_text(record.read_text().replace("Purelib: true", "Purelib: false"))
    packed = scratch / "packed"
    packed.mkdir()
    run("wheel", "pack", str(tree), "--dest-dir", str(packed))
    run("wheel", "tags", "--remove", f"--platform-tag={PLATFORM}", str(packed / wheel.name))
    (binary,) = packed.iterdir()
    return binary


def check_platform(wheel: Path) -> None:
    """Check that every system of `PLATFORM` has what the libraries need, apart from torch."""
    report = json.loads(run("auditwheel", "show", "--json", "--disable-isa-ext-check", str(wheel)))
    upgrade = report["policy_upgrades"].get(PLATFORM)  # missing if symbols are too new
    if upgrade is None or not set(upgrade["libs_to_eliminate"]) <= TORCH:
        raise SystemExit(f"{wheel.name} does not fit its platform: {json.dumps(report, indent=1)}")


def run(module: str, *arguments: str) -> str:
    """Run a Python module as a program; its output."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, text=True, stdout=subprocess.PIPE)
    if done.returncode:
        raise SystemExit(f"{module} {' '.join(arguments)} failed")
    return done.stdout


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/wheels"))
