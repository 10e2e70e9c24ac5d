"""Reproduce every table and figure of the paper; writes docs/paper/.

Usage: python scripts/reproduce_paper.py --data DATA [-o docs/paper] [--only figure_3 table_two ...]
DATA is a folder with one folder per set, which contains `scans.npz`. With --only, the other results
are kept from the previous run.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parent / "paper"))

EXPERIMENTS = {  # name: module, in the order of execution; times first
    "table_one": "timings",
    "table_two": "timings",
    "figure_one": "rings",
    "figure_two": "meshes",
    "references": "exact_gps",
    "variance_and_distance": "doubt",
    "log_losses": "doubt",
    "figure_six": "shares",
    "figure_four": "meshes",
    "figure_five": "meshes",
    "table_three": "shares",
    "figure_three": "shares",
}
LIBRARIES = ("lardhm_torch", "torch", "scikit-learn", "octomap-python")


def main() -> None:
    """Run the experiments, storing each result as soon as it is there."""
    import page

    arguments = parse_arguments()
    folder: Path = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    results = page.load_results(folder)
    seconds = results.get("conditions", {}).get("seconds", {})
    results["conditions"] = {**conditions(), "seconds": seconds, "note": arguments.note}
    for number, name in enumerate(arguments.only, start=1):
        print(f"[{number}/{len(arguments.only)}] {name}", flush=True)
        start = time.perf_counter()
        experiment = getattr(importlib.import_module(EXPERIMENTS[name]), name)
        results[name] = experiment(arguments.data, folder)
        seconds[name] = time.perf_counter() - start
        page.save_results(folder, results)
        page.write_page(folder, results)
        print(f"    {seconds[name]:.0f} s", flush=True)
    page.write_page(folder, results)
    print(f"wrote {folder / 'README.md'}")


def conditions() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "versions": {name: metadata.version(name) for name in LIBRARIES},
    }


def processor() -> str:
    """Name of the processor as the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/paper"))
    parser.add_argument("--note", default="", help="sentence for the page on how it was run")
    parser.add_argument(
        "--only", nargs="+", choices=list(EXPERIMENTS), default=list(EXPERIMENTS), metavar="NAME",
        help=f"some of {', '.join(EXPERIMENTS)} (default: all)",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    main()
