"""Colors and classes: accuracy against look-ups of the training hits, calibration, time and size.

    python benchmarks/channels.py
    python benchmarks/channels.py --only room         # frames, room, time

frames: six RGB-D frames of 7-Scenes, mean absolute error of the colors of held-out pixels, against the
    color of the nearest training pixel. One frame at a time is held out, or half of the pixels at random.
    Errors are of the pixels for which the map has a color, and the fraction of those is given.
room: 50,000 rays of the simulated room with 10 classes, half of them for training, 5 % of the labels
    wrong. Accuracy and expected calibration error (ECE, 15 bins) against the true classes of held-out
    hits, against a vote of the 15 nearest training hits. A tenth of the training rays calibrates the map;
    scan by scan, each scan calibrates the map before it is added.
time: of a fit with three channels, and of a query of a channel and of 10 classes, as ratios to a fit and
    a query without; CPU time of one thread, best of five.

Sizes are bytes of the map without evidence (.safetensors), and of the training pixels as float32
positions with 3 bytes of color, and as float64 positions with float32 colors.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from conditions import ROOT, conditions, describe
from scipy.spatial import cKDTree
from torch import Tensor

from lardhm_torch import LardHilbertMap, Scans, load_scans, sample_rays, simulate_room, split_rays
from lardhm_torch.io.rgbd import Camera
from lardhm_torch.simulation import true_classes

FRAMES = ROOT.parent / "shared" / "data" / "sevenscenes_rgbd" / "frames"
WRONG = 0.05  # fraction of wrong labels
NEIGHBORS = 15
BINS = 15


def fitted(train: Scans, num_clusters: int | None = None) -> LardHilbertMap:
    """A map of the scans with their channels."""
    samples = sample_rays(train, seed=0)
    model = LardHilbertMap(train.dim)
    return model.fit(samples.points, samples.labels, num_clusters, channels=samples.channels)


def size_of(model: LardHilbertMap) -> int:
    """Bytes of the map file without evidence."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        model.save(path, evidence=False)
        return path.stat().st_size


@torch.no_grad()
def color_errors(train: Scans, test: Scans, num_clusters: int | None) -> dict[str, float]:
    """Mean absolute error a channel of map and nearest-hit look-up, and their sizes."""
    truth = test.channels["color"]
    nearest = cKDTree(train.ends.numpy()).query(test.ends.numpy())[1]
    looked_up = train.channels["color"][torch.from_numpy(nearest)]
    model = fitted(train, num_clusters)
    answer = model.channel(test.ends, "color")
    known = ~answer.isnan().any(dim=1)
    ours = float((answer - truth)[known].abs().mean())
    theirs = float((looked_up - truth)[known].abs().mean())
    return {
        "map": ours,
        "nearest hit": theirs,
        "ratio": ours / theirs,
        "known": float(known.double().mean()),
        "clusters": len(model),
        "map bytes": size_of(model),
        "pixels (15 B)": 15 * len(train),
        "pixels (36 B)": 36 * len(train),
    }


def frames(pixel_step: int) -> dict[str, Any]:
    """Held-out frames, and held-out pixels."""
    scans = load_scans(FRAMES, camera=Camera(pixel_step=pixel_step))
    rows = []
    for number in range(scans.num_scans):
        is_held = scans.scan_id == number
        rows.append(color_errors(scans.select(~is_held), scans.select(is_held), None))
    held = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
    held["ratio"] = held["map"] / held["nearest hit"]
    return {
        "held-out frames": held,
        "held-out pixels": color_errors(*split_rays(scans, 0.5, seed=0), None),
    }


def calibration_error(probability: Tensor, classes: Tensor) -> float:
    """Expected calibration error of the most likely class."""
    confidence, found = probability.max(dim=1)
    place = (confidence * BINS).long().clamp(max=BINS - 1)
    gap = (confidence - (found == classes).to(confidence)).double()
    return float(torch.zeros(BINS).double().index_add_(0, place, gap).abs().sum()) / len(classes)


def class_scores(probability: Tensor, classes: Tensor) -> dict[str, float]:
    """Accuracy and calibration error."""
    is_right = probability.argmax(dim=1) == classes
    error = calibration_error(probability, classes)
    return {"accuracy": float(is_right.double().mean()), "ece": error}


@torch.no_grad()
def room(seed: int) -> dict[str, Any]:
    """The classes of the room: at once, scan by scan, and by a vote of neighbors."""
    scans = simulate_room(50_000, seed=seed, wrong_labels=WRONG)
    whole, test = split_rays(scans, 0.5, seed=seed)
    train, held = split_rays(whole, 0.9, seed=seed + 1)
    test, held = test.select(test.is_return), held.select(held.is_return)
    true = true_classes(test.ends, test.ray_origins)
    hits = whole.select(whole.is_return)
    near = cKDTree(hits.ends.numpy()).query(test.ends.numpy(), NEIGHBORS)[1]
    labels = hits.channels["class"][torch.from_numpy(near)]
    votes = torch.nn.functional.one_hot(labels, 10).float().mean(dim=1)
    batch, stream = fitted(train), LardHilbertMap(3)
    uncalibrated = ordered(batch, test.ends)
    batch.calibrate_classes(held.ends, held.channels["class"], wrong_labels=WRONG)
    for number in range(scans.num_scans):
        scan = whole.select(whole.scan_id == number)
        own = scan.select(scan.is_return)
        if len(stream):
            stream.calibrate_classes(own.ends, own.channels["class"], wrong_labels=WRONG)
        samples = sample_rays(scan, seed=number)
        given = samples.points, samples.labels
        stream.update(*given, seed=number, channels=samples.channels)
    rows = {
        f"vote of {NEIGHBORS} nearest hits": class_scores(votes, true),
        "map, before calibration": class_scores(uncalibrated, true),
        "map, at once": class_scores(ordered(batch, test.ends), true),
        "map, scan by scan": class_scores(ordered(stream, test.ends), true),
    }
    trained = batch.fit_classes(hits.ends, hits.channels["class"], wrong_labels=WRONG)
    rows["map, class weights trained"] = class_scores(ordered(trained, test.ends), true)
    return rows


def ordered(model: LardHilbertMap, points: Tensor) -> Tensor:
    """Class probabilities in ascending order of the class numbers."""
    return model.class_probability(points)[:, torch.tensor(model.classes).argsort()]


def best_time(run: Callable[[], Any], repeats: int) -> float:
    """Shortest CPU time of some runs [s]."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


@torch.no_grad()
def times(seed: int) -> dict[str, float]:
    """Ratios of CPU times with channels to those without; the runs alternate."""
    scans = simulate_room(50_000, seed=seed, exposure_noise=0.1)
    intensity = scans.channels["color"].mean(dim=1)
    channels = {**scans.channels, "intensity": intensity}
    colored = Scans(scans.origins, scans.ends, scans.scan_id, scans.is_return, channels=channels)
    samples = sample_rays(colored)
    given = samples.points, samples.labels
    bare = LardHilbertMap(3)
    model = LardHilbertMap(3)
    fits = [
        (
            best_time(lambda: bare.fit(*given), 1),
            best_time(lambda: model.fit(*given, channels=samples.channels), 1),
        )
        for _ in range(5)
    ]
    order = torch.randperm(len(samples), generator=torch.Generator().manual_seed(0))[:200_000]
    points = samples.points[order]
    asked = {
        "query, map with channels": lambda: model(points),
        "channel color": lambda: model.channel(points, "color"),
        "channel intensity": lambda: model.channel(points, "intensity"),
        "class_probability, 10 classes": lambda: model.class_probability(points),
    }
    base = best_time(lambda: bare(points), 5)
    ratios = {name: best_time(run, 5) / base for name, run in asked.items()}
    without, with_channels = (min(column) for column in zip(*fits, strict=True))
    return {"fit with three channels": with_channels / without, **ratios}


def main() -> None:
    """Print the tables, and write them as JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=("frames", "room", "time"))
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted = arguments.only or ("frames", "room", "time")
    found: dict[str, Any] = {"conditions": conditions()}
    print(describe(found["conditions"]))
    if "frames" in wanted and not FRAMES.is_dir():
        print(f"frames: skipped, {FRAMES} is missing")
    elif "frames" in wanted:
        found["frames"] = frames(arguments.pixel_step)
    if "room" in wanted:
        found["room"] = room(arguments.seed)
    if "time" in wanted:
        found["time"] = {"ratios to a map without channels": times(arguments.seed)}
    for title in wanted:
        for name, row in found.get(title, {}).items():
            print(f"{title}: {name}: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items()))
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
