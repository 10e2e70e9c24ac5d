"""Try the versions that pyproject.toml allows: the smoke test in one new environment after another.

Usage: python scripts/versions/try_versions.py WHEEL [NAME...]    (default: all of `ENVIRONMENTS`)

Each environment is made in a temporary folder with the interpreter `pythonX.Y` of the path or of pyenv,
and removed afterwards. Downloads are several gigabytes for each version of torch. Prints the rows of the
table in docs/versions.md.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SMOKE = Path(__file__).with_name("smoke.py")
OLDEST = (
    "scipy==1.11.*", "scikit-learn==1.3.*", "scikit-image==0.22.*", "trimesh==4.0.*",
    "matplotlib==3.8.*", "tqdm==4.60.*", "safetensors==0.4.3",
)  # fmt: skip
# name: interpreter, and what is installed with the wheel; the rest is the newest that fits
ENVIRONMENTS = {
    "oldest": ("3.10", ["torch==2.10.*", "numpy==1.26.*", *OLDEST]),
    "3.10, newest": ("3.10", ["torch"]),
    "3.11, numpy 1.26": ("3.11", ["torch==2.13.0", "numpy==1.26.*"]),
    "3.11, newest": ("3.11", ["torch"]),
    "3.12, oldest": ("3.12", ["torch==2.13.0", "numpy==1.26.*", *OLDEST]),
    "3.12, newest": ("3.12", ["torch"]),
    "3.13, torch 2.10": ("3.13", ["torch==2.10.*"]),
    "3.13, newest": ("3.13", ["torch"]),
}


def main(wheel: Path, names: list[str]) -> None:
    """Print one row of the table for each environment."""
    for name in names or ENVIRONMENTS:
        version, packages = ENVIRONMENTS[name]
        with tempfile.TemporaryDirectory(prefix="versions-") as folder:
            row = try_environment(Path(folder), find_python(version), [str(wheel), *packages])
        print(f"| {name} | {' | '.join(row)} |", flush=True)


def try_environment(folder: Path, python: str, packages: list[str]) -> list[str]:
    """Install into a new environment and run the smoke test there; the cells of the row."""
    run([python, "-m", "venv", str(folder / "venv")], folder)
    python = str(folder / "venv" / "bin" / "python")
    installed = run([python, "-m", "pip", "install", "--quiet", *packages], folder)
    if installed.returncode:
        return [f"does not install: {last_line(installed.stderr)}"]
    smoked = run([python, str(SMOKE)], folder)
    if smoked.returncode:
        return [f"fails: {last_line(smoked.stderr)}"]
    return [*json.loads(last_line(smoked.stdout)).values(), "passes"]


def find_python(version: str) -> str:
    """The interpreter of a version, from the path or from pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [str(path) for path in sorted(pyenv.glob(f"{version}.*/bin/python"))]
    if path := shutil.which(f"python{version}"):
        found.append(path)
    if not found:
        raise SystemExit(f"no Python {version} found")
    return found[0]


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder that is not the checkout, without the variables of this process."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment = {**kept, "LARDHM_CACHE": str(folder / "cache"), "CXX": "no-compiler"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def last_line(text: str) -> str:
    """The last line that is not blank."""
    return [line for line in text.splitlines() if line.strip()][-1].strip()


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
