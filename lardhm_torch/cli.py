"""The command `lardhm`: one verb for each thing a map is for."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lardhm_torch.scans import Scans

# torch and the rooms are imported inside the verbs: `lardhm --help` must be instant.


def main(argv: list[str] | None = None) -> int:
    """Run one verb; 0, or 1 after a one-line error, or 2 for a wrong command line."""
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except (ValueError, OSError, ImportError) as error:
        print(f"lardhm {arguments.verb}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"lardhm {arguments.verb}: interrupted; nothing was written", file=sys.stderr)
        return 130
    return 0


def simulate(arguments: argparse.Namespace) -> None:
    """Scans of the simulated room to a file."""
    from lardhm_torch import save_scans, simulate_room

    scans = simulate_room(num_rays=arguments.rays, seed=arguments.seed)
    save_scans(scans, arguments.output)
    print(f"{len(scans)} rays of {scans.num_scans} scans -> {arguments.output}")


def split(arguments: argparse.Namespace) -> None:
    """Whole rays to a training and a test file."""
    from lardhm_torch import save_scans, split_rays

    parts = split_rays(_load_scans(arguments), arguments.ratio, arguments.seed)
    for part, path in zip(parts, arguments.output, strict=True):
        save_scans(part, path)
        print(f"{len(part)} rays -> {path}")


def fit(arguments: argparse.Namespace) -> None:
    """Scans to a map."""
    from lardhm_torch import LardHilbertMap, fine_tune, sample_rays
    from lardhm_torch.checkpoint import load_state, save_state

    if arguments.incremental:
        _fit_incrementally(arguments)
        return
    if arguments.resume or arguments.view or arguments.radius is not None:
        raise ValueError(
            "--resume, --view and --radius belong to --incremental, which is not given"
        )
    scans = _load_scans(arguments)
    samples = sample_rays(scans, seed=arguments.seed)
    _report_dropped(samples.dropped)
    settings = {} if arguments.neighbors is None else {"num_neighbors": arguments.neighbors}
    model = LardHilbertMap(scans.dim, **settings)
    model.fit(
        samples.points, samples.labels, arguments.clusters, seed=arguments.seed, progress=True
    )
    if arguments.tune or arguments.tune_state:
        path = arguments.tune_state
        fine_tune(
            model,
            samples.points,
            samples.labels,
            resample=lambda epoch: sample_rays(scans, seed=arguments.seed + epoch),
            seed=arguments.seed,
            state=load_state(path) if path and Path(path).exists() else None,
            after_epoch=(lambda state: save_state(state, path)) if path else None,
            progress=True,
        )
    model.save(arguments.output)
    hits = int(samples.labels.sum())
    print(
        f"{hits} hits and {len(samples) - hits} free points -> {len(model)} clusters "
        f"-> {arguments.output}"
    )


def _fit_incrementally(arguments: argparse.Namespace) -> None:
    """One scan after the other, with checkpoints in the output file."""
    import itertools

    from lardhm_torch import LardHilbertMap, StreamConfig, resume_stream, stream_scans

    if arguments.tune:
        raise ValueError("--tune needs all scans at once; leave out --incremental")
    config = StreamConfig(
        num_clusters=arguments.clusters,
        radius=arguments.radius,
        checkpoint_every=arguments.checkpoint_every,
        seed=arguments.seed,
    )
    scans = _iter_scans(arguments)
    if arguments.resume:
        model, done = resume_stream(arguments.output)
    else:
        first = next(scans)
        scans, done = itertools.chain([first], scans), None
        settings = {} if arguments.neighbors is None else {"num_neighbors": arguments.neighbors}
        model = LardHilbertMap(first.dim, **settings)
    live = None
    if arguments.view:
        from lardhm_torch.viewer import LiveView

        live = LiveView()
    try:
        seen = stream_scans(
            model, scans, config, path=arguments.output, done=done,
            after_scan=live.update if live else None, progress=True,
        )  # fmt: skip
    finally:
        if live:
            live.close()
    print(f"{seen.scans} scans, {seen.rays} rays -> {len(model)} clusters -> {arguments.output}")


def update(arguments: argparse.Namespace) -> None:
    """More scans into a map, one after the other."""
    from lardhm_torch import LardHilbertMap, StreamConfig, stream_scans

    model = LardHilbertMap.load(arguments.map)
    config = StreamConfig(
        num_clusters=arguments.clusters, radius=arguments.radius, seed=arguments.seed
    )
    before = len(model)
    seen = stream_scans(model, _iter_scans(arguments, model.dim), config, progress=True)
    model.save(arguments.output)
    print(
        f"{seen.scans} scans, {seen.rays} rays -> {before} clusters became {len(model)} "
        f"-> {arguments.output}"
    )


def query(arguments: argparse.Namespace) -> None:
    """Points to probabilities, in the order of the points."""
    import numpy as np
    import torch

    from lardhm_torch import LardHilbertMap
    from lardhm_torch.files import replaced_file
    from lardhm_torch.io import load_points

    model = LardHilbertMap.load(arguments.map)
    points = load_points(arguments.points)
    if points.shape[1] == model.dim + 1 and bool((points[:, -1] == points[:1, -1]).all()):
        points = points[:, :-1]  # flat scans, as `fit --dim 2` takes them
    with torch.no_grad():
        probability = model(points).float().numpy()
    with replaced_file(arguments.output) as partial, open(partial, "wb") as file:
        np.save(file, probability)
    print(f"{len(probability)} probabilities -> {arguments.output}")


def mesh(arguments: argparse.Namespace) -> None:
    """A map to a surface."""
    from lardhm_torch import LardHilbertMap, extract_mesh
    from lardhm_torch.mesh_files import save_mesh

    surface = extract_mesh(
        LardHilbertMap.load(arguments.map),
        arguments.resolution,
        arguments.threshold,
        color=arguments.color,
        progress=True,
    )
    save_mesh(surface, arguments.output)
    print(f"{len(surface.vertices)} vertices, {len(surface.faces)} faces -> {arguments.output}")


def grid(arguments: argparse.Namespace) -> None:
    """A map to a grid of probabilities: .npz, or OctoMap's .bt and .ot."""
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.exporting import save_grid

    model = LardHilbertMap.load(arguments.map)
    count = save_grid(model, arguments.output, arguments.resolution)
    print(f"{count} cells of {arguments.resolution} m -> {arguments.output}")


def view(arguments: argparse.Namespace) -> None:
    """A map on a page for the browser, with its scans."""
    import threading

    from lardhm_torch import LardHilbertMap
    from lardhm_torch.viewer import MapViewer, ViewConfig

    model = LardHilbertMap.load(arguments.map)
    scans = _load_scans(arguments, model.dim) if arguments.scans else None
    config = ViewConfig(host=arguments.host, port=arguments.port, resolution=arguments.resolution)
    viewer = MapViewer(model, scans, config)
    try:
        if arguments.export is not None:
            viewer.export(arguments.export)
            print(f"{len(model)} clusters -> {arguments.export}")
            return
        print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("ended")
    finally:
        viewer.close()


def render(arguments: argparse.Namespace) -> None:
    """A map to a picture, without a screen."""
    from lardhm_torch import LardHilbertMap, extract_mesh
    from lardhm_torch.rendering import render_mesh, render_slice

    model = LardHilbertMap.load(arguments.map)
    if arguments.slice is not None or model.dim == 2:
        render_slice(model, arguments.output, arguments.slice, arguments.resolution)
        print(f"slice -> {arguments.output}")
        return
    surface = extract_mesh(
        model, arguments.resolution, arguments.threshold, color=arguments.color, progress=True
    )
    angles = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    render_mesh(surface, arguments.output, cut_above=arguments.cut_above, **angles)
    print(f"{len(surface.faces)} faces -> {arguments.output}")


def evaluate(arguments: argparse.Namespace) -> None:
    """A map against held-out rays."""
    from lardhm_torch import LardHilbertMap, metrics
    from lardhm_torch.calibration import draw_reliability

    model = LardHilbertMap.load(arguments.map)
    scans = _load_scans(arguments, model.dim)
    answers = metrics.answer_held_out(model, scans, seed=arguments.seed)
    table = metrics.score_held_out(answers)
    if arguments.reliability:
        draw_reliability(metrics.reliability_held_out(answers), arguments.reliability)
    print(json.dumps(table, indent=2) if arguments.json else metrics.format_metrics(table))


def info(arguments: argparse.Namespace) -> None:
    """What a map file holds."""
    from lardhm_torch import LardHilbertMap
    from lardhm_torch.querying import map_bounds

    model = LardHilbertMap.load(arguments.map)
    occupied = int(model.is_occupied.sum())
    rows: dict[str, Any] = {
        "file size [bytes]": Path(arguments.map).stat().st_size,
        **model.settings,
        "dtype": str(model.centers.dtype).removeprefix("torch."),
        "clusters": len(model),
        "occupied clusters": occupied,
        "free clusters": len(model) - occupied,
        "training points": int(model.counts.sum()),
        "origin [m]": model.origin.tolist(),
    }
    if len(model):
        lower, upper = map_bounds(model)
        rows["bounds [m]"] = [[round(float(v), 3) for v in corner] for corner in (lower, upper)]
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    for name, value in rows.items():
        print(f"{name:<22}{value}")


def _load_scans(arguments: argparse.Namespace, dim: int | None = None) -> Scans:
    """The scans named on the command line, without z where ``--dim 2`` or a 2-D map asks for it."""
    from lardhm_torch import load_scans

    scans = load_scans(arguments.scans, **_reading(arguments))
    return _with_dim(scans, arguments, dim)


def _iter_scans(arguments: argparse.Namespace, dim: int | None = None) -> Iterator[Scans]:
    """The same, one after the other."""
    from lardhm_torch import iter_scans

    for scan in iter_scans(arguments.scans, **_reading(arguments)):
        yield _with_dim(scan, arguments, dim)


def _reading(arguments: argparse.Namespace) -> dict[str, Any]:
    """How the files are to be read."""
    from lardhm_torch.io import Camera

    return {
        "origin": arguments.origin,
        "frame": arguments.frame,
        "topic": arguments.topic,
        "camera": Camera(intrinsics=arguments.camera, pixel_step=arguments.pixel_step),
    }


def _with_dim(scans: Scans, arguments: argparse.Namespace, dim: int | None) -> Scans:
    dim = getattr(arguments, "dim", None) or dim or scans.dim
    if dim == scans.dim - 1:
        return scans.drop_constant_column()
    if dim != scans.dim:
        raise ValueError(f"scans must have {dim} coordinates; got {scans.dim}")
    return scans


def _report_dropped(dropped: dict[str, int]) -> None:
    for reason, count in dropped.items():
        if count:
            print(f"{count} rays {reason}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lardhm",
        description="Continuous, probabilistic maps of occupancy from range scans.",
        epilog="SCANS is one file or several, or a folder: npz, ply, pcd, xyz, csv, KITTI bin, las, "
        "e57, ROS bags (bag, db3, mcap), depth images (7-Scenes, TUM).",
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(run: Any, **defaults: Any) -> argparse.ArgumentParser:
        sub = verbs.add_parser(run.__name__, help=run.__doc__, description=run.__doc__)
        sub.set_defaults(run=run, **defaults)
        return sub

    _scan_verbs(verb)
    _map_verbs(verb)
    return parser


def _scan_verbs(verb: Any) -> None:
    sub = verb(simulate)
    _output(sub)
    sub.add_argument("--rays", type=int, default=50_000, help="number of rays (50000)")
    _seed(sub)

    sub = verb(split)
    _scans(sub)
    sub.add_argument("--ratio", type=float, default=0.5, help="share that trains (0.5)")
    _seed(sub)
    sub.add_argument("-o", "--output", nargs=2, required=True, metavar=("TRAIN", "TEST"))

    sub = verb(fit)
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
    sub.add_argument("--dim", type=int, help="2 drops a constant last column")
    _seed(sub)


def _map_verbs(verb: Any) -> None:
    sub = verb(update)
    sub.add_argument("map")
    _scans(sub)
    _output(sub)
    sub.add_argument("--clusters", type=int, help="of a scan in an unknown place (from the data)")
    _radius(sub)
    _seed(sub)

    sub = verb(query)
    sub.add_argument("map")
    sub.add_argument("points", help=".npy or .npz of (N, D), or any scan file")
    _output(sub)

    sub = verb(mesh)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--resolution", type=float, default=0.05, help="lattice cell [m] (0.05)")
    sub.add_argument("--threshold", type=float, default=0.5, help="probability (0.5)")
    sub.add_argument("--color", choices=("height", "cluster", "probability"), default="height")

    sub = verb(grid)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--resolution", type=float, default=0.1, help="edge of a cell [m] (0.1)")

    sub = verb(view)
    sub.add_argument("map")
    _scans(sub, nargs="*")
    sub.add_argument("--host", default="127.0.0.1", help="0.0.0.0: for other machines, too")
    sub.add_argument("--port", type=int, default=8080, help="of the page (8080 or the next free)")
    sub.add_argument("--resolution", type=float, help="of the surface [m] (about 200,000 faces)")
    sub.add_argument("--export", metavar="FILE", help="write the scene to .html or .viser and end")

    sub = verb(render)
    sub.add_argument("map")
    _output(sub)
    sub.add_argument("--slice", type=float, metavar="Z", help="the probability at this height [m]")
    sub.add_argument("--resolution", type=float, default=0.05, help="lattice cell [m] (0.05)")
    sub.add_argument("--threshold", type=float, default=0.5, help="probability (0.5)")
    sub.add_argument("--color", choices=("height", "cluster", "probability"), default="height")
    sub.add_argument("--azimuth", type=float, default=-60.0, help="of the camera [degrees] (-60)")
    sub.add_argument("--elevation", type=float, default=40.0, help="of the camera [degrees] (40)")
    sub.add_argument("--cut-above", type=float, metavar="Z", help="leave out what is higher [m]")

    sub = verb(evaluate)
    sub.add_argument("map")
    _scans(sub)
    sub.add_argument("--json", action="store_true", help="print JSON instead of a table")
    sub.add_argument("--reliability", metavar="FILE", help="reliability diagrams, .png")
    _seed(sub)

    sub = verb(info)
    sub.add_argument("map")
    sub.add_argument("--json", action="store_true", help="print JSON instead of lines")


def _scans(sub: argparse.ArgumentParser, nargs: str = "+") -> None:
    sub.add_argument("scans", nargs=nargs, metavar="SCANS")
    sub.add_argument(
        "--origin",
        type=_numbers,
        metavar="X,Y,Z",
        help="sensor position of files that do not tell it",
    )
    sub.add_argument(
        "--frame",
        choices=("sensor", "world"),
        help="of points beside a pose file: moved by the poses, or only seen from there",
    )
    sub.add_argument(
        "--topic", action="append", default=[], help="of a bag's clouds or poses, if there are more"
    )
    sub.add_argument(
        "--camera", type=_numbers, metavar="FX,FY,CX,CY", help="of depth images without intrinsics"
    )
    sub.add_argument(
        "--pixel-step", type=int, default=4, help="of depth images, rows and columns read (4)"
    )


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


if __name__ == "__main__":
    sys.exit(main())
