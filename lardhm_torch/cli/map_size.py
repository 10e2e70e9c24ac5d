"""Arguments of the command line that become settings of `LardHilbertMap.fit`."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import replace
from typing import Any

UNITS = {"": 1, "B": 1, "kB": 1000, "MB": 1000**2, "KiB": 1024, "MiB": 1024**2}


def add_map_size(sub: argparse.ArgumentParser) -> None:
    """Add ``--clusters``, ``--size``, ``--small`` and ``--clear-rays``."""
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
    sub.add_argument(
        "--clear-rays",
        action="store_true",
        help="reshape clusters that end rays of SCANS early, as at doors and in foliage; takes 1.5 to 2 "
        "times as long",
    )


def add_hit_noise(sub: argparse.ArgumentParser) -> None:
    """Add ``--hit-noise``."""
    sub.add_argument(
        "--hit-noise",
        type=length_or_auto,
        default=0.0,
        metavar="METERS",
        help="make surfaces thicker by this standard deviation, for queries at the poses of other scans "
        "than SCANS; auto: what SCANS disagree by, estimated where they overlap (default: 0)",
    )


def length_or_auto(text: str) -> float | None:
    """Meters, or None for ``auto``."""
    if text == "auto":
        return None
    try:
        length = float(text)
    except ValueError:
        length = math.nan
    if not 0 <= length < math.inf:
        raise argparse.ArgumentTypeError(
            f"a length must be 0 or more meters, or auto; got {text!r}"
        )
    return length


def size_in_bytes(text: str) -> int:
    """Bytes of a size such as ``20kB``, ``1.5MB`` or ``20000``."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?([A-Za-z]*)", text)
    if found is None or found[2] not in UNITS:
        raise argparse.ArgumentTypeError(
            f"a size must be a number with a unit of {', '.join(filter(None, UNITS))}; got {text!r}"
        )
    return int(float(found[1]) * UNITS[found[2]])


def fit_settings(arguments: argparse.Namespace, hit_noise: float) -> dict[str, Any]:
    """Keyword arguments of `LardHilbertMap.fit`.

    Args:
        arguments: of the command line.
        hit_noise: standard deviation of the hits [m].

    Raises:
        ValueError: arguments exclude each other.
    """
    from lardhm_torch.learning.fitting import FitConfig
    from lardhm_torch.learning.sized_maps import SMALL

    is_tuned = bool(arguments.tune or arguments.tune_state)
    if is_tuned and (arguments.size is not None or arguments.small):
        raise ValueError("--size and --small cannot be used with --tune, which also trains shapes")
    if arguments.clear_rays and (is_tuned or arguments.size is not None or arguments.small):
        raise ValueError(
            "--clear-rays cannot be used with --size, --small and --tune: they train shapes"
        )
    if arguments.small and arguments.clusters is not None:
        raise ValueError("--small cannot be used with --clusters; it chooses the number")
    config = SMALL if arguments.small or arguments.size is not None else FitConfig()
    return {
        "num_clusters": arguments.clusters,
        "max_bytes": arguments.size,
        "config": replace(config, hit_noise=hit_noise),
    }


def check_not_incremental(arguments: argparse.Namespace) -> None:
    """Raise a ValueError for arguments that an incremental fit does not support."""
    if arguments.size is not None or arguments.small:
        raise ValueError("--size and --small cannot be used with --incremental")
    if arguments.clear_rays:
        raise ValueError("--clear-rays needs all scans at once; omit --incremental")
    if arguments.hit_noise != 0:
        raise ValueError("--hit-noise needs all scans at once; omit --incremental")
