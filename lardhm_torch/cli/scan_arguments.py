"""Arguments of the command line that select scans and how they are read."""

from __future__ import annotations

import argparse
import math


def add_scans(sub: argparse.ArgumentParser, nargs: str = "+", in_pieces: bool = False) -> None:
    """Add SCANS, how the files are read, and which scans and rays are kept.

    Commands that read files in pieces do not count scans, so they have no ``--every``.
    """
    sub.add_argument(
        "scans", nargs=nargs, metavar="SCANS", help="scan file, several files, or a folder"
    )
    add_reading(sub)
    if in_pieces:
        sub.set_defaults(every=1)
    else:
        sub.add_argument(
            "--every", type=_count, default=1, metavar="N", help="read every Nth scan (default: 1)"
        )
    sub.add_argument(
        "--voxel",
        type=_positive,
        metavar="METERS",
        help="keep one ray per scan and voxel of this size (default: keep all)",
    )


def add_reading(sub: argparse.ArgumentParser) -> None:
    """Add the options that determine how scan files are read."""
    sub.add_argument(
        "--origin",
        type=_numbers,
        metavar="X,Y,Z",
        help="sensor position for files that do not contain one [m]",
    )
    sub.add_argument(
        "--frame",
        choices=("sensor", "world"),
        help="frame of the points if there is a pose file. sensor: points are transformed by the "
        "poses; world: the poses only give the sensor positions (default: points are in the world "
        "frame, and pose files are ignored)",
    )
    sub.add_argument(
        "--poses-frame",
        metavar="FRAME",
        help="whose poses a pose file contains: camera or lidar (default: camera if there is a "
        "calib.txt); for a bag: the tf frame of the pose topic",
    )
    sub.add_argument(
        "--sensor-frame",
        metavar="FRAME",
        help="tf frame of the sensor, if the clouds of a bag are in another frame",
    )
    sub.add_argument(
        "--topic",
        action="append",
        default=[],
        help="topic of a bag's point clouds or poses; needed if there are several",
    )
    _add_depth_images(sub)
    sub.add_argument(
        "--strict",
        action="store_true",
        help="report an error instead of guessing what a file means",
    )


def _add_depth_images(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--camera",
        type=_numbers,
        metavar="FX,FY,CX,CY",
        help="intrinsics of depth images, for folders that do not contain them [pixels]",
    )
    sub.add_argument(
        "--pixel-step",
        type=int,
        default=4,
        metavar="N",
        help="read every Nth row and column of depth images (default: 4)",
    )
    sub.add_argument(
        "--depth-scale",
        type=_positive,
        metavar="N",
        help="depth image units per meter (default: 1000 for 7-Scenes, 5000 for TUM)",
    )


def add_ranges(sub: argparse.ArgumentParser) -> None:
    """Add the range limits of sampling."""
    sub.add_argument(
        "--min-range",
        type=float,
        metavar="METERS",
        help="drop rays shorter than this, which end on the robot itself (default: 0.3)",
    )
    sub.add_argument(
        "--max-range",
        type=float,
        metavar="METERS",
        help="truncate longer rays, which then count as no-return (default: 100)",
    )


def finite(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number; got {text!r}")
    return value


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more; got {text}")
    return number


def _positive(text: str) -> float:
    number = finite(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"must be > 0; got {text}")
    return number


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"must be numbers separated by commas; got {text!r}"
        ) from error
