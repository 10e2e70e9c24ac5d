"""Machine, versions and commit, which every benchmark records."""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

LIBRARIES = ("torch", "numpy", "scipy", "scikit-learn", "octomap-python", "pyoctomap")
BUSY_LOAD = 0.5  # processes running or waiting, mean of the last minute
ROOT = Path(__file__).parents[1]


def conditions() -> dict[str, Any]:
    """Machine, threads, versions and commit of this run."""
    return {
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="minutes"),
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("lardhm_torch", *LIBRARIES)},
        "commit": commit(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def processor() -> str:
    """Name of the processor, as reported by the system."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def version(name: str) -> str | None:
    """Installed version of a distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def commit() -> str:
    """Commit of the code, with "+ changes" if the files differ from it."""
    try:
        name = _git("rev-parse", "--short", "HEAD")
        return name + (" + changes" if _git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def describe(record: dict[str, Any]) -> str:
    """One line for the head of a printed table."""
    versions = ", ".join(f"{name} {number}" for name, number in record["versions"].items())
    return (
        f"{record['date']}, {record['processor']}, {record['threads']} threads, "
        f"python {record['python']}, commit {record['commit']}\n{versions}"
        + busy(record["load_before"])
    )


def busy(load: float | None) -> str:
    """A warning if the machine was busy when the run began; otherwise nothing."""
    if load is None or load < BUSY_LOAD:
        return ""
    return f"\nWARNING: load average {load:.1f} before the start; times are not to be trusted"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write the figures of a run; the folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
    print(f"wrote {path}")
