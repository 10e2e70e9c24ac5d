"""The command line parser."""

from __future__ import annotations

import argparse
from typing import Any

from lardhm_torch.cli import learning, queries, tiling
from lardhm_torch.cli.forgetting import add_forgetting
from lardhm_torch.cli.map_size import add_hit_noise, add_map_size
from lardhm_torch.cli.scan_arguments import add_ranges, add_reading, add_scans, finite

MAP = "map file, or folder of a tiled map"
FOLDER = "folder of the tiled map"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all subcommands; `arguments.run(arguments)` runs the chosen one."""
    parser = argparse.ArgumentParser(
        prog="lardhm",
        description="Continuous, probabilistic occupancy maps from range scans.",
        epilog="SCANS is one file, several files, or a folder. Formats: npz, ply, pcd, xyz, csv, "
        "pts, ptx, las, laz, KITTI bin, e57, ROS bags (bag, db3, mcap), depth images (7-Scenes, TUM).",
    )
    parser.set_defaults(report=None, num_far=0)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="COMMAND")

    def verb(run: Any, **defaults: Any) -> argparse.ArgumentParser:
        sub = verbs.add_parser(
            run.__name__.replace("_", "-"), help=run.__doc__, description=run.__doc__
        )
        sub.set_defaults(run=run, **defaults)
        return sub

    _scan_verbs(verb)
    _fit(verb(learning.fit))
    _update(verb(learning.update))
    _file_verbs(verb)
    _picture_verbs(verb)
    _evaluation_verbs(verb)
    _tile_verbs(verb)
    return parser


def _scan_verbs(verb: Any) -> None:
    sub = verb(learning.simulate)
    _output(sub, "scans to write: .npz, .ply or .pcd")
    sub.add_argument(
        "--rays", type=int, default=50_000, metavar="N", help="number of rays (default: 50000)"
    )
    sub.add_argument(
        "--exposure-noise",
        type=float,
        default=0.0,
        metavar="S",
        help="standard deviation of the logarithm of each scanner's exposure (default: 0)",
    )
    sub.add_argument(
        "--wrong-labels",
        type=float,
        default=0.0,
        metavar="F",
        help="fraction of rays that get the label of another class (default: 0)",
    )
    _seed(sub)

    sub = verb(learning.split)
    add_scans(sub)
    sub.add_argument(
        "--ratio", type=float, default=0.5, help="fraction of training rays (default: 0.5)"
    )
    _seed(sub)
    sub.add_argument(
        "-o",
        "--output",
        nargs=2,
        required=True,
        metavar=("TRAIN", "TEST"),
        help="scans to write: two .npz, .ply or .pcd files",
    )


def _fit(sub: argparse.ArgumentParser) -> None:
    add_scans(sub)
    _output(sub, "map to write: .pt, .pth or .safetensors")
    add_map_size(sub)
    add_hit_noise(sub)
    _neighbors(sub)
    sub.add_argument(
        "--tune",
        action="store_true",
        help="fine-tune centers, length scales and weights by backpropagation",
    )
    sub.add_argument(
        "--uncertainty",
        action="store_true",
        help="also store the variance of the weights, which is required to color by variance",
    )
    sub.add_argument(
        "--tune-state",
        metavar="FILE",
        help="fine-tune, writing a checkpoint to FILE after every epoch; resume from FILE if it exists",
    )
    sub.add_argument(
        "--incremental", action="store_true", help="update the map with one scan at a time"
    )
    sub.add_argument(
        "--resume",
        action="store_true",
        help="with --incremental: resume from the checkpoint in the output file",
    )
    sub.add_argument(
        "--view", action="store_true", help="with --incremental: show the map in the browser"
    )
    sub.add_argument(
        "--checkpoint-every",
        type=int,
        default=1,
        metavar="N",
        help="with --incremental: write a checkpoint every N scans (default: 1)",
    )
    sub.add_argument(
        "--send",
        metavar="PATH",
        help="with --incremental: after each scan, write a packet with the changes of the map, to a "
        "folder or to the end of a .lhm file",
    )
    _precision(sub)
    for option, program in (("mcap", "Foxglove: .mcap"), ("rerun", "Rerun: .rrd")):
        sub.add_argument(
            f"--{option}",
            metavar="FILE",
            help=f"with --incremental: log clouds, surface and grid to a file for {program}",
        )
    sub.add_argument(
        "--log-every",
        type=int,
        default=10,
        metavar="N",
        help="with --mcap or --rerun: log surface and grid every N scans and at the end (default: 10)",
    )
    sub.add_argument(
        "--log-resolution",
        type=float,
        default=0.1,
        metavar="METERS",
        help="with --mcap or --rerun: cell size of surface and grid (default: 0.1)",
    )
    sub.add_argument(
        "--heights",
        nargs=2,
        type=finite,
        metavar=("LOW", "HIGH"),
        help="with --mcap or --rerun: lowest and highest z of obstacles in the grid of a 3-D map [m]; "
        "without it, no grid of a 3-D map is logged",
    )
    add_forgetting(sub)
    add_ranges(sub)
    _dim(sub)
    _seed(sub)


def _update(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("map", metavar="MAP", help=MAP)
    add_scans(sub)
    sub.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help="map to write, which may be MAP itself; omit it for a tiled map, which is updated in place",
    )
    text = "maximum number of clusters near a scan (default: chosen from the data)"
    sub.add_argument("--clusters", type=int, metavar="N", help=text)
    add_forgetting(sub)
    add_ranges(sub)
    _seed(sub)


def _file_verbs(verb: Any) -> None:
    sub = verb(queries.query)
    sub.add_argument("map", metavar="MAP", help=MAP)
    sub.add_argument(
        "points", metavar="POINTS", help="(N, D) points as .npy or .npz, or any scan file"
    )
    _output(sub, "file to write: .npy, float32 probabilities in the order of the points")
    sub.add_argument(
        "--channel",
        metavar="NAME",
        help="write the values of a channel of the map instead, such as color; class gives the "
        "probability of each class",
    )

    sub = verb(queries.mesh)
    sub.add_argument("map", metavar="MAP", help=MAP)
    _output(sub, "mesh to write: .ply, .obj, .glb, .off or .stl")
    _resolution(sub, 0.05)
    _surface(sub)
    sub.add_argument(
        "--faces",
        type=int,
        metavar="N",
        help="simplify the mesh to about N faces",
    )
    sub.add_argument(
        "--watertight",
        action="store_true",
        help="close the surface where nothing was measured (gray; attribute closing in .ply)",
    )

    sub = verb(queries.grid)
    sub.add_argument("map", metavar="MAP", help=MAP)
    sub.add_argument(
        "-o", "--output", metavar="FILE", help="grid to write: .npz, or .bt or .ot for OctoMap"
    )
    _resolution(sub, 0.1)
    sub.add_argument(
        "--distance",
        action="store_true",
        help="with .npz: write signed distances to the nearest surface [m] instead of probabilities",
    )
    sub.add_argument(
        "--sparse", action="store_true", help="with .npz: write only blocks of cells near clusters"
    )
    sub.add_argument("--channel", metavar="NAME", help="with .npz: also write this channel")
    sub.add_argument(
        "--nav2", metavar="FILE", help="write a map for Nav2's map_server: .yaml and an image"
    )
    sub.add_argument(
        "--heights",
        nargs=2,
        type=finite,
        metavar=("LOW", "HIGH"),
        help="with --nav2: lowest and highest z of obstacles in a 3-D map [m], above the floor",
    )
    sub.add_argument(
        "--mode",
        choices=("trinary", "scale"),
        default="trinary",
        help="with --nav2: occupied, free and unknown cells, or probabilities (default: trinary)",
    )

    sub = verb(queries.pack)
    sub.add_argument("map", metavar="MAP", help=f"{MAP}; or packets written by fit --send")
    _output(sub, "packed map to write: .lhm")
    _precision(sub)


def _picture_verbs(verb: Any) -> None:
    sub = verb(queries.view)
    sub.add_argument("map", metavar="MAP", help=MAP)
    add_scans(sub, nargs="*")
    sub.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve on; 0.0.0.0 accepts connections from other machines (default: 127.0.0.1)",
    )
    sub.add_argument(
        "--port",
        type=int,
        default=8080,
        help="port to serve on; if it is in use, the next free one is used (default: 8080)",
    )
    sub.add_argument(
        "--resolution", type=float, help="cell size of the surface [m] (default: automatic)"
    )
    sub.add_argument(
        "--export", metavar="FILE", help="write the scene to a .html or .viser file and exit"
    )

    sub = verb(queries.render)
    sub.add_argument("map", metavar="MAP", help=MAP)
    _output(sub, "picture to write: .png")
    sub.add_argument(
        "--slice", type=finite, metavar="Z", help="draw the probability at height Z [m]"
    )
    _resolution(sub, 0.05)
    _surface(sub)
    sub.add_argument(
        "--azimuth", type=finite, default=-60.0, help="camera azimuth [degrees] (default: -60)"
    )
    sub.add_argument(
        "--elevation", type=finite, default=40.0, help="camera elevation [degrees] (default: 40)"
    )
    sub.add_argument(
        "--cut-above", type=finite, metavar="Z", help="remove the surface above height Z [m]"
    )


def _evaluation_verbs(verb: Any) -> None:
    sub = verb(queries.evaluate)
    sub.add_argument("map", metavar="MAP", help=MAP)
    add_scans(sub)
    sub.add_argument("--json", action="store_true", help="print JSON instead of a table")
    sub.add_argument(
        "--reliability", metavar="FILE", help="also draw reliability diagrams to a .png file"
    )
    _seed(sub)

    sub = verb(queries.info)
    sub.add_argument("paths", nargs="+", metavar="PATH", help=f"{MAP}; or SCANS")
    add_reading(sub)
    sub.add_argument("--json", action="store_true", help="print JSON instead of a table")


def _tile_verbs(verb: Any) -> None:
    sub = verb(tiling.tile)
    add_scans(sub, in_pieces=True)
    sub.add_argument("-o", "--output", required=True, metavar="FOLDER", help=FOLDER)
    add_ranges(sub)
    sub.add_argument("--edge", type=float, default=20.0, help="edge of a tile [m] (default: 20)")
    sub.add_argument(
        "--halo",
        type=float,
        help="width of the margin around a tile; the tile is also trained on the points in it [m] "
        "(default: 0.5)",
    )
    _neighbors(sub)
    _dim(sub)
    _seed(sub)

    sub = verb(tiling.fit_tiles)
    sub.add_argument("folder", metavar="FOLDER", help=FOLDER)

    sub = verb(tiling.join)
    sub.add_argument("maps", nargs=2, metavar="MAP", help="two map files, or two tiled maps")
    _output(sub, "map file to write, or folder of the new tiled map")
    _seed(sub)


# --- arguments that several subcommands share ---


def _output(sub: argparse.ArgumentParser, text: str) -> None:
    sub.add_argument("-o", "--output", required=True, metavar="FILE", help=text)


def _neighbors(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--neighbors",
        type=int,
        metavar="K",
        help="nearest clusters used per query point (default: 16)",
    )


def _dim(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--dim",
        type=int,
        help="dimension of the map; 2 drops a constant last coordinate of 3-D scans (default: that of "
        "the scans)",
    )


def _seed(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")


def _precision(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--precision",
        type=int,
        metavar="BITS",
        help="fractional bits of the rounded parameters of a packed map, 1 to 16 (default: 6)",
    )


def _resolution(sub: argparse.ArgumentParser, default: float) -> None:
    sub.add_argument(
        "--resolution",
        type=float,
        default=default,
        help="cell size [m] (default: %(default)s)",
    )


def _surface(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--threshold",
        type=float,
        default=0.5,
        help="probability above which space is occupied (default: 0.5)",
    )
    sub.add_argument(
        "--surface",
        choices=("peak", "crossing"),
        default="peak",
        help="peak: the ridge of the log-odds, where the hits lie; crossing: the level set of the "
        "probability at the threshold (default: peak)",
    )
    sub.add_argument(
        "--color",
        default="height",
        help="quantity shown by colors: height, cluster, probability, variance, or a channel of the "
        "map, such as color, intensity or class (default: height)",
    )
