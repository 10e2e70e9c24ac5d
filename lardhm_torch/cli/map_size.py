"""Arguments of the command line that say how many clusters a fitted map gets."""

from __future__ import annotations

import argparse
import re
from typing import Any

UNITS = {"": 1, "B": 1, "kB": 1000, "MB": 1000**2, "KiB": 1024, "MiB": 1024**2}


def add_map_size(sub: argparse.ArgumentParser) -> None:
    """Add ``--clusters``, ``--size`` and ``--fast``."""
    sub.add_argument(
        "--clusters",
        type=int,
        metavar="N",
        help="total number of clusters; centers and length scales are not trained (default: as many "
        "as the scene needs)",
    )
    sub.add_argument(
        "--size",
        type=size_in_bytes,
        metavar="SIZE",
        help="as many clusters as fit into a file of this size when the map is packed, such as 20kB",
    )
    sub.add_argument(
        "--fast",
        action="store_true",
        help="choose the number of clusters from the points alone, and train only the weights",
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

    Fine-tuning trains the shapes itself, and gains from more clusters than a scene needs.
    """
    from lardhm_torch.learning.fitting import FitConfig

    is_tuned = bool(arguments.tune or arguments.tune_state)
    if is_tuned and arguments.size is not None:
        raise ValueError("--size cannot be used with --tune, which would change the size")
    settings: dict[str, Any] = {"num_clusters": arguments.clusters, "max_bytes": arguments.size}
    if arguments.fast or is_tuned:
        settings["config"] = FitConfig(shape_passes=0)
    return settings


def check_not_incremental(arguments: argparse.Namespace) -> None:
    """Raise a ValueError if an argument is given that a fit of single scans does not have."""
    if arguments.size is not None or arguments.fast:
        raise ValueError("--size and --fast cannot be used with --incremental")
