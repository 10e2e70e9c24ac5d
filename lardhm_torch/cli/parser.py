"""What may stand on the command line."""

from __future__ import annotations

import argparse
from typing import Any

from lardhm_torch.cli import asking, learning, tiling


def make_parser() -> argparse.ArgumentParser:
    """Every verb with its arguments; `arguments.run(arguments)` does it."""
    parser = argparse.ArgumentParser(
        prog="lardhm",
        description="Continuous, probabilistic maps of occupancy from range scans.",
        epilog="SCANS is one file or several, or a folder: npz, ply, pcd, xyz, csv, pts, ptx, "
        "KITTI bin, las, e57, ROS bags (bag, db3, mcap), depth images (7-Scenes, TUM).",
    )
    parser.set_defaults(report=None, num_far=0)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(run: Any, **defaults: Any) -> argparse.ArgumentParser:
        sub = verbs.add_parser(
            run.__name__.replace("_", "-"), help=run.__doc__, description=run.__doc__
        )
        sub.set_defaults(run=run, **defaults)
        return sub

    _scan_verbs(verb)
    _map_verbs(verb)
    _tile_verbs(verb)
    return parser


def _scan_verbs(verb: Any) -> None:
    sub = verb(learning.simulate)
    _output(sub)
    sub.add_argument("--rays", type=int, default=50_000, help="number of rays (50000)")
    _seed(sub)

    sub = verb(learning.split)
    _scans(sub)
    sub.add_argument("--ratio", type=float, default=0.5, help="share that trains (0.5)")
    _seed(sub)
    sub.add_argument("-o", "--output", nargs=2, required=True, metavar=("TRAIN", "TEST"))

    sub = verb(learning.fit)
    _scans(sub)
    _output(sub)
    sub.add_argument("--clusters", type=int, help="total number (chosen from the data)")
    sub.add_argument("--neighbors", type=int, help="clusters that answer for a point")
    sub.add_argument("--tune", action="store_true", help="also learn centers and length-scales")
    sub.add_argument(
        "--tune-state",
        metavar="FILE",
        help="--tune, saved after every epoch; continued if it exists",
    )
    sub.add_argument("--incremental", action="store_true", help="one scan after the other")
    sub.add_argument("--resume", action="store_true", help="go on from the checkpoint in FILE")
    sub.add_argument(
        "--view", action="store_true", help="--incremental with a page of the live map"
    )
    sub.add_argument(
        "--checkpoint-every", type=int, default=1, metavar="N", help="scans between two (1)"
    )
    _radius(sub)
    _ranges(sub)
    sub.add_argument("--dim", type=int, help="2 drops a constant last column")
    _seed(sub)


def _map_verbs(verb: Any) -> None:
    sub = verb(learning.update)
    sub.add_argument("map")
    _scans(sub)
    sub.add_argument("-o", "--output", metavar="FILE", help="needed unless MAP is a tiled folder")
    sub.add_argument("--clusters", type=int, help="of a scan in an unknown place (from the data)")
    _radius(sub)
    _ranges(sub)
    _seed(sub)

    sub = verb(asking.query)
    sub.add_argument("map")
    sub.add_argument("points", help=".npy or .npz of (N, D), or any scan file")
    _output(sub)

    sub = verb(asking.mesh)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--resolution", type=float, default=0.05, help="lattice cell [m] (0.05)")
    _add_surface(sub)
    sub.add_argument("--color", choices=("height", "cluster", "probability"), default="height")

    sub = verb(asking.grid)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--resolution", type=float, default=0.1, help="edge of a cell [m] (0.1)")

    sub = verb(asking.view)
    sub.add_argument("map")
    _scans(sub, nargs="*")
    sub.add_argument("--host", default="127.0.0.1", help="0.0.0.0: for other machines, too")
    sub.add_argument("--port", type=int, default=8080, help="of the page (8080 or the next free)")
    sub.add_argument("--resolution", type=float, help="of the surface [m] (from the map)")
    sub.add_argument("--export", metavar="FILE", help="write the scene to .html or .viser and end")

    sub = verb(asking.render)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--slice", type=float, metavar="Z", help="the probability at this height [m]")
    sub.add_argument("--resolution", type=float, default=0.05, help="lattice cell [m] (0.05)")
    _add_surface(sub)
    sub.add_argument("--color", choices=("height", "cluster", "probability"), default="height")
    sub.add_argument("--azimuth", type=float, default=-60.0, help="of the camera [degrees] (-60)")
    sub.add_argument("--elevation", type=float, default=40.0, help="of the camera [degrees] (40)")
    sub.add_argument("--cut-above", type=float, metavar="Z", help="leave out what is higher [m]")

    sub = verb(asking.evaluate)
    sub.add_argument("map")
    _scans(sub)
    sub.add_argument("--json", action="store_true", help="print JSON instead of a table")
    sub.add_argument("--reliability", metavar="FILE", help="reliability diagrams, .png")
    _seed(sub)

    sub = verb(asking.info)
    sub.add_argument("paths", nargs="+", metavar="PATH", help="a map, or SCANS")
    _reading(sub)
    sub.add_argument("--json", action="store_true", help="print JSON instead of lines")


def _tile_verbs(verb: Any) -> None:
    sub = verb(tiling.tile)
    _scans(sub)
    sub.add_argument("-o", "--output", required=True, metavar="FOLDER")
    _ranges(sub)
    sub.add_argument("--edge", type=float, default=20.0, help="of a tile [m] (20)")
    sub.add_argument("--halo", type=float, help="around a tile, trained with it [m] (0.5)")
    sub.add_argument("--neighbors", type=int, help="clusters that answer for a point")
    sub.add_argument("--dim", type=int, help="2 drops a constant last column")
    _seed(sub)

    sub = verb(tiling.fit_tiles)
    sub.add_argument("folder")

    sub = verb(tiling.join)
    sub.add_argument("maps", nargs=2, metavar="MAP")
    sub.add_argument("-o", "--output", required=True, metavar="FILE")
    _seed(sub)


def _scans(sub: argparse.ArgumentParser, nargs: str = "+") -> None:
    sub.add_argument("scans", nargs=nargs, metavar="SCANS")
    _reading(sub)
    sub.add_argument(
        "--every", type=_count, default=1, metavar="N", help="read every Nth scan (default: 1)"
    )
    sub.add_argument(
        "--voxel",
        type=_length,
        metavar="METERS",
        help="keep one ray of a scan per voxel of this size (default: all rays)",
    )


def _reading(sub: argparse.ArgumentParser) -> None:
    """How scan files are read."""
    add = sub.add_argument
    add("--origin", type=_numbers, metavar="X,Y,Z", help="sensor position of files without one")
    add(
        "--frame",
        choices=("sensor", "world"),
        help="frame of the points: sensor (poses move them) or world (poses only give origins)",
    )
    add(
        "--poses-frame",
        metavar="FRAME",
        help="whose poses a pose file holds: camera or lidar (default: camera beside calib.txt); "
        "of a bag: the tf frame of the pose topic",
    )
    add("--sensor-frame", metavar="FRAME", help="tf frame of the sensor, if clouds are in another")
    add("--topic", action="append", default=[], help="topic of a bag's clouds or poses")
    add("--camera", type=_numbers, metavar="FX,FY,CX,CY", help="intrinsics of depth images")
    add(
        "--pixel-step",
        type=int,
        default=4,
        help="read every Nth row and column of depth images (default: 4)",
    )
    add(
        "--depth-scale",
        type=_length,
        metavar="N",
        help="depth image units per meter (default: 1000 for 7-Scenes, 5000 for TUM)",
    )
    add("--strict", action="store_true", help="fail where something would have to be guessed")


def _ranges(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--min-range",
        type=float,
        metavar="METERS",
        help="drop shorter rays: they end in the sensor's own body (default: 0.3)",
    )
    sub.add_argument(
        "--max-range",
        type=float,
        metavar="METERS",
        help="longer rays are truncated and count as no-return (default: 100)",
    )


def _count(text: str) -> int:
    """A whole number from 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more; got {text}")
    return number


def _length(text: str) -> float:
    """A number above 0."""
    number = float(text)
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be > 0 and finite; got {text}")
    return number


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def _output(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("-o", "--output", required=True, metavar="FILE")


def _radius(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--radius", type=float, metavar="METERS", help="forget what is farther from the sensor"
    )


def _seed(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--seed", type=int, default=0, help="of everything random (0)")


def _add_surface(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--threshold",
        type=float,
        default=0.5,
        help="of the probability: what exceeds it is occupied (0.5)",
    )
    sub.add_argument(
        "--surface",
        choices=("peak", "crossing"),
        default="peak",
        help="where the hits lie, or where the probability is the threshold (peak)",
    )
