"""Arguments of the command line for the number of clusters of a map."""

from __future__ import annotations

import argparse
import re
from typing import Any

UNITS = {"": 1, "B": 1, "kB": 1000, "MB": 1000**2, "KiB": 1024, "MiB": 1024**2}


def add_map_size(sub: argparse.ArgumentParser) -> None:
    """Add ``--clusters``, ``--size`` and ``--small``."""
    sub.add_argument(
        "--clusters",
        type=int,
        metavar="N",
        help="total number of clusters (default: chosen from the points)",
    )
    sub.add_argument(
        "--size",
        type=size_in_bytes,
        metavar="SIZE",
        help="choose as many clusters as fit into a packed map of this size, such as 20kB",
    )
    sub.add_argument(
        "--small",
        action="store_true",
        help="choose only as many clusters as the scene needs, about a third of the default, and train "
        "their shapes: probabilities are as accurate, ranges and meshes are less exact",
    )


def size_in_bytes(text: str) -> int:
    """Bytes of a size such as ``20kB``, ``1.5MB`` or ``20000``."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?([A-Za-z]*)", text)
    if found is None or found[2] not in UNITS:
        raise argparse.ArgumentTypeError(
            f"a size must be a number with a unit of {', '.join(filter(None, UNITS))}; got {text!r}"
        )
    return int(float(found[1]) * UNITS[found[2]])


def fit_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of `LardHilbertMap.fit`.

    Raises:
        ValueError: arguments exclude each other.
    """
    from lardhm_torch.learning.sized_maps import SMALL

    is_tuned = bool(arguments.tune or arguments.tune_state)
    if is_tuned and (arguments.size is not None or arguments.small):
        raise ValueError("--size and --small cannot be used with --tune, which also trains shapes")
    if arguments.small and arguments.clusters is not None:
        raise ValueError("--small cannot be used with --clusters; it chooses the number")
    settings: dict[str, Any] = {"num_clusters": arguments.clusters, "max_bytes": arguments.size}
    if arguments.small:
        settings["config"] = SMALL
    return settings


def check_not_incremental(arguments: argparse.Namespace) -> None:
    """Raise a ValueError for arguments that an incremental fit does not support."""
    if arguments.size is not None or arguments.small:
        raise ValueError("--size and --small cannot be used with --incremental")
