"""Options that remove old or distant clusters from a map that is updated scan by scan."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lardhm_torch import LardHilbertMap


def add_forgetting(sub: argparse.ArgumentParser) -> None:
    """Add ``--radius`` and ``--max-age``."""
    sub.add_argument(
        "--radius",
        type=float,
        metavar="METERS",
        help="after each scan, remove clusters farther than this from the sensor (default: keep "
        "all)",
    )
    sub.add_argument(
        "--max-age",
        type=float,
        metavar="SECONDS",
        help="after each scan, remove clusters that were not seen for longer; the scans need time "
        "stamps; saved with the map (default: that of the map, which is none for a new one)",
    )


def check_not_at_once(arguments: argparse.Namespace) -> None:
    """Raise a ValueError if an option is given that needs one scan at a time."""
    for option, value in (("radius", arguments.radius), ("max-age", arguments.max_age)):
        if value is not None:
            raise ValueError(f"--{option} needs --incremental")


def set_max_age(model: LardHilbertMap, arguments: argparse.Namespace) -> None:
    """Give the map the age of ``--max-age``, if there is one."""
    from lardhm_torch.learning.aging import check_max_age

    if arguments.max_age is not None:
        check_max_age(arguments.max_age)
        model.max_age = arguments.max_age
