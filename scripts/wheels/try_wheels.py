"""Try the wheel with the kernel inside where there is no compiler and no source tree.

Usage: python scripts/wheels/try_wheels.py [FOLDER]    (default: out/wheels)

Installs the wheel into a new environment, runs the smoke test there with a path that holds no compiler,
then compares the speed of the kernel with that of one compiled on the spot, taking turns. An error if a
task takes more than 1.1 times as long.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SCRIPTS = Path(__file__).parents[1]
CONSTRAINTS = SCRIPTS.parent / "constraints.txt"
SLOWEST = 1.1
TURNS = 3
FIND = "import lardhm_torch; print(lardhm_torch.__path__[0])"


def main(folder: Path) -> None:
    """Print the versions of the smoke test, and the ratio of the times of each task."""
    (wheel,) = folder.glob("*manylinux*.whl")
    with tempfile.TemporaryDirectory() as scratch:
        environment = Environment(Path(scratch))
        environment.install(wheel)
        environment.compiler = False
        print(environment.run(str(SCRIPTS / "versions" / "smoke.py")).strip())
        ratios = compare_speed(environment)
    for task, ratio in ratios.items():
        print(f"{task}: {ratio:.3f} of the time of a kernel compiled here")
    if max(ratios.values()) > SLOWEST:
        raise SystemExit(f"the kernel of the wheel is more than {SLOWEST} times slower")


class Environment:
    """A new virtual environment; ``compiler`` tells whether programs find a compiler."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.compiler = True
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)

    def install(self, wheel: Path) -> None:
        """Install a wheel, with the versions that the project is tested with."""
        torch = next(s for s in CONSTRAINTS.read_text().split() if s.startswith("torch=="))
        self.run("-m", "pip", "install", "--quiet", "-c", str(CONSTRAINTS), torch, str(wheel))

    def run(self, *arguments: str) -> str:
        """What the environment's Python prints, run outside the source tree."""
        binaries = self.folder / "venv" / "bin"
        kept = {n: v for n, v in os.environ.items() if n not in ("PYTHONPATH", "CXX")}
        path = f"{binaries}:{kept['PATH']}" if self.compiler else str(binaries)
        cache = str(self.folder / "cache")
        done = subprocess.run(
            [str(binaries / "python"), *arguments], cwd=self.folder, text=True, stdout=subprocess.PIPE,
            env={**kept, "PATH": path, "LARDHM_CACHE": cache},
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"failed in the new environment: {' '.join(arguments)}")
        return done.stdout


def compare_speed(environment: Environment) -> dict[str, float]:
    """Ratio of the shortest CPU times of the installed kernel and one compiled on the spot."""
    package = Path(environment.run("-c", FIND).strip())
    installed, aside = package / "native" / "shipped", package / "native" / "aside"
    ahead, here = [], []
    for _ in range(TURNS):
        environment.compiler = False
        ahead.append(time_tasks(environment))
        environment.compiler = True
        installed.rename(aside)
        here.append(time_tasks(environment))
        aside.rename(installed)
    return {task: min(t[task] for t in ahead) / min(t[task] for t in here) for task in here[0]}


def time_tasks(environment: Environment) -> dict[str, float]:
    """CPU time of each task [s]."""
    return json.loads(environment.run(str(SCRIPTS / "wheels" / "kernel_speed.py")))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/wheels"))
