"""Colors and classes: accuracy against look-ups of the training hits, calibration, time and size.

    python benchmarks/channels.py
    python benchmarks/channels.py --only room         # frames, pixels, room, time

frames: six RGB-D frames of 7-Scenes, mean absolute error of the colors of a held-out frame, relative to
    that of the nearest training pixel. Errors are of the pixels for which the map has a color, and the
    fraction of those is given.
pixels: the same for half of the pixels at random; also of a fine map, which has no free space.
room: 50,000 rays of the simulated room with 10 classes, half of them for training, 5 % of the labels
    wrong. Accuracy and expected calibration error (ECE, 15 bins) against the true classes of held-out
    hits, against a vote of the 15 nearest training hits. A tenth of the training rays calibrates the map;
    scan by scan, each scan calibrates the map before it is added.
time: of a fit with three channels, and of a query of a channel and of 10 classes, as ratios to a fit and
    a query without; CPU time of one thread, best of five.

Sizes are bytes of the map without evidence (.safetensors), of the packed map, and of the training pixels
as float32 positions with 3 bytes of color, and as float64 positions with float32 colors.
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
HITS_EACH = 12.5  # of a cluster of a fine map, chosen on frame 1 alone
MOST_PIXELS = 100_000  # that are tested
BINS = 15
TITLES = ("frames", "pixels", "room", "time")
Row = dict[str, float]


def fitted(train: Scans, num_clusters: int | None = None) -> LardHilbertMap:
    """A map of the scans with their channels."""
    samples = sample_rays(train, seed=0)
    model = LardHilbertMap(train.dim)
    return model.fit(samples.points, samples.labels, num_clusters, channels=samples.channels)


def fine_map(train: Scans) -> LardHilbertMap:
    """A map of the hits alone, with many small clusters: as a picture of the surfaces."""
    hits, settings = train.select(train.is_return), {"min_lengthscale": 0.002}
    model, labels = LardHilbertMap(train.dim, 8, **settings), torch.ones(len(hits))
    return model.fit(hits.ends, labels, int(len(hits) / HITS_EACH), channels=hits.channels)


def sizes_of(model: LardHilbertMap, precision: int) -> tuple[int, int, LardHilbertMap]:
    """Bytes of the map file without evidence and of the packed file, and the packed map."""
    with tempfile.TemporaryDirectory() as folder:
        path, packed = Path(folder) / "map.safetensors", Path(folder) / "map.lhm"
        model.save(path, evidence=False)
        model.pack(packed, precision=precision)
        return path.stat().st_size, packed.stat().st_size, LardHilbertMap.load(packed)


def color_error(model: LardHilbertMap, test: Scans) -> tuple[float, float]:
    """Mean absolute error a channel of the pixels with a color, and the fraction of those."""
    answer = model.channel(test.ends, "color")
    known = ~answer.isnan().any(dim=1)
    error = (answer - test.channels["color"])[known].abs().mean()
    return float(error), float(known.double().mean())


@torch.no_grad()
def color_errors(model: LardHilbertMap, train: Scans, test: Scans, precision: int = 6) -> Row:
    """Errors of map, packed map and nearest-hit look-up, and their sizes."""
    if len(test) > MOST_PIXELS:
        order = torch.randperm(len(test), generator=torch.Generator().manual_seed(1))
        test = test.select(order[:MOST_PIXELS])
    nearest = cKDTree(train.ends.numpy()).query(test.ends.numpy())[1]
    looked_up = train.channels["color"][torch.from_numpy(nearest)]
    theirs = float((looked_up - test.channels["color"]).abs().mean())
    ours, known = color_error(model, test)
    map_bytes, packed_bytes, packed = sizes_of(model, precision)
    return {
        "nearest hit": theirs,
        "map": ours / theirs,
        "packed map": color_error(packed, test)[0] / theirs,
        "known": known,
        "clusters": len(model),
        "map bytes": map_bytes,
        "packed bytes": packed_bytes,
        "pixels (15 B) / map": 15 * len(train) / map_bytes,
        "pixels (15 B) / packed map": 15 * len(train) / packed_bytes,
        "pixels (36 B) / packed map": 36 * len(train) / packed_bytes,
    }


def frames(pixel_step: int) -> dict[str, Row]:
    """Held-out frames, and held-out pixels."""
    scans = load_scans(FRAMES, camera=Camera(pixel_step=pixel_step))
    rows = []
    for number in range(scans.num_scans):
        is_held = scans.scan_id == number
        train = scans.select(~is_held)
        rows.append(color_errors(fitted(train), train, scans.select(is_held)))
    return {"held-out frames": {name: sum(r[name] for r in rows) / len(rows) for name in rows[0]}}


def pixels(pixel_step: int) -> dict[str, Row]:
    """Held-out pixels: the default map, and a fine map of the hits."""
    scans = load_scans(FRAMES, camera=Camera(pixel_step=pixel_step))
    train, test = split_rays(scans, 0.5, seed=0)
    return {
        "held-out pixels, fine map": color_errors(fine_map(train), train, test, precision=4),
        "held-out pixels": color_errors(fitted(train), train, test),
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
        stream.update(*given, seed=number, channels=samples.channels, rays=scan)
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
    parser.add_argument("--only", nargs="+", choices=TITLES)
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted = arguments.only or TITLES
    found: dict[str, Any] = {"conditions": conditions()}
    print(describe(found["conditions"]))
    for title, ask in (("frames", frames), ("pixels", pixels)):
        if title in wanted and not FRAMES.is_dir():
            print(f"{title}: skipped, {FRAMES} is missing")
        elif title in wanted:
            found[title] = ask(arguments.pixel_step)
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
