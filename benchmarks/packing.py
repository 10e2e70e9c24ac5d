"""Bytes of packed maps and their accuracy, beside the trees of OctoMap; packets of a stream.

Half of the rays of a set (at most ``--rays``) train, the other half gives the test points, as in
accuracy.py. A packed map is loaded from its file before it is scored. OctoMap's tree is its ``.bt`` file
at the best of four voxel sizes, by the mean accuracy of both kinds of free points.

    python benchmarks/packing.py --sets paper_virtual --fractions 1 0.5 0.25 --tune
    python benchmarks/packing.py --stream stream_sevenscenes --frames 400
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from accuracy import RESOLUTIONS, find_sets
from conditions import ROOT, conditions, describe, write_json
from scenes import made_up_map
from timing import format_rows

from lardhm_torch import (
    LardHilbertMap,
    PacketReceiver,
    PacketSender,
    Scans,
    fine_tune,
    load_scans,
    sample_rays,
    split_rays,
)
from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.learning.sized_maps import SMALL

Row = dict[str, Any]
FRAME_RAYS = 8_000  # training rays of a frame, at most


def scores(model: Any, test: Scans, seed: int) -> Row:
    """Balanced accuracy and log-loss, unif and near."""
    found = evaluate(model, test, seed=seed)
    return {
        f"{short} {kind}": f"{found[kind][name]:.4f}"
        for short, name in (("accuracy", "balanced_accuracy"), ("log-loss", "log_loss"))
        for kind in ("unif", "near")
    }


def set_rows(name: str, path: Path, folder: Path, arguments: argparse.Namespace) -> list[Row]:
    """The default map, its packed file, smaller packed maps, and OctoMap."""
    seed = arguments.seed
    train, test = split_rays(
        protocol_rays(load_scans(path), arguments.rays, seed=seed), 0.5, seed=seed
    )
    samples = sample_rays(train, seed=seed)
    rows, whole = [], None
    for fraction in arguments.fractions:
        wanted = None if whole is None else max(2, round(fraction * whole))
        config = SMALL if arguments.small else None
        model = LardHilbertMap().fit(
            samples.points, samples.labels, wanted, seed=seed, config=config
        )
        whole = whole or len(model)
        if arguments.tune:
            with torch.enable_grad():
                fine_tune(model, samples.points, samples.labels, seed=seed,
                          resample=lambda epoch: sample_rays(train, seed=seed + epoch))  # fmt: skip
        if fraction == arguments.fractions[0]:
            model.save(folder / "map.pt", evidence=False)
            size = (folder / "map.pt").stat().st_size
            rows.append({"set": name, "map": "map.pt without evidence", "clusters": len(model),
                         "bytes": size, **scores(model, test, seed)})  # fmt: skip
        model.pack(folder / "map.lhm")
        size = (folder / "map.lhm").stat().st_size
        packed = LardHilbertMap.load(folder / "map.lhm")
        rows.append({"set": name, "map": "packed", "clusters": len(packed), "bytes": size,
                     **scores(packed, test, seed)})  # fmt: skip
    return [*rows, best_tree(name, train, test, folder, seed)]


def best_tree(name: str, train: Scans, test: Scans, folder: Path, seed: int) -> Row:
    """OctoMap at the voxel size of the best accuracy."""
    rows = []
    for resolution in RESOLUTIONS:
        model = OctoMapBaseline(resolution).fit(train)
        found = scores(model, test, seed)
        model.tree.writeBinary(str(folder / "map.bt").encode())
        size = (folder / "map.bt").stat().st_size
        rows.append({"set": name, "map": f"OctoMap {resolution} m", "clusters": 0, "bytes": size,
                     **found})  # fmt: skip
    return max(rows, key=lambda row: float(row["accuracy unif"]) + float(row["accuracy near"]))


def time_rows(folder: Path) -> list[Row]:
    """Processor time of packing and loading made-up maps."""
    rows = []
    for count in (1_000, 10_000, 100_000):
        model, path = made_up_map(count, 16), folder / "map.lhm"
        times: list[list[float]] = [[], []]
        for _ in range(8):
            start = time.process_time()
            model.pack(path)
            middle = time.process_time()
            LardHilbertMap.load(path)
            times[0].append(1e3 * (middle - start))
            times[1].append(1e3 * (time.process_time() - middle))
        pack, load = (statistics.median(runs[1:]) for runs in times)
        rows.append({"clusters": count, "pack [ms]": pack, "load [ms]": load})
    return rows


def stream_rows(path: Path, folder: Path, frames: int) -> list[Row]:
    """Packets of a stream; fails if a receiver's map is not the sender's packed map after a frame."""
    scans = load_scans(path)
    model, sender, receiver = LardHilbertMap(), PacketSender(), PacketReceiver()
    sizes: list[int] = []
    rows: list[Row] = []
    for number in range(min(frames, scans.num_scans)):
        rays = protocol_rays(scans.select(scans.scan_id == number), 2 * FRAME_RAYS, seed=number)
        train, _ = split_rays(rays, 0.5, seed=number)
        samples = sample_rays(train, seed=number)
        model.update(samples.points, samples.labels, seed=number, rays=train)
        receiver.apply(packet := sender.packet(model))
        sizes.append(len(packet))
        model.pack(folder / "map.lhm")
        expected, found = LardHilbertMap.load(folder / "map.lhm"), receiver.map()
        tensors = zip(expected.state_tensors(), found.state_tensors(), strict=True)
        if not all(torch.equal(ours, theirs) for (_, ours), (_, theirs) in tensors):
            raise AssertionError(f"the receiver's map differs after frame {number}")
        if number % 50 == 49 or number == frames - 1:
            whole = (folder / "map.lhm").stat().st_size
            rows.append({"frames": number + 1, "clusters": len(model), "whole [bytes]": whole,
                         "mean packet": round(statistics.fmean(sizes)),
                         "last 50": round(statistics.fmean(sizes[-50:])),
                         "mean / whole": statistics.fmean(sizes) / whole})  # fmt: skip
    return rows


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="*", help="names of folders (default: all 3-D sets)")
    parser.add_argument("--rays", type=int, default=120_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--fractions", type=float, nargs="+", default=[1.0], help="of the default clusters"
    )
    parser.add_argument("--tune", action="store_true", help="fine-tune the maps")
    parser.add_argument("--small", action="store_true", help="clusters with trained shapes")
    parser.add_argument("--stream", help="name of the folder of a stream")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "packing.json")
    return parser.parse_args()


@torch.no_grad()
def main() -> None:
    arguments = parse_arguments()
    record: Row = {"conditions": conditions(), "tables": []}
    print(describe(record["conditions"]), end="\n\n")

    def show(title: str, rows: list[Row]) -> None:
        record["tables"].append({"title": title, "rows": rows})
        print(format_rows(record["tables"][-1]), end="\n\n", flush=True)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        show("packing and loading", time_rows(folder))
        if arguments.stream:
            (path,) = find_sets(arguments.data, [arguments.stream]).values()
            show(f"packets of {arguments.stream}", stream_rows(path, folder, arguments.frames))
        else:
            for key, path in find_sets(arguments.data, arguments.sets).items():
                show(key, set_rows(key, path, folder, arguments))
    write_json(arguments.json, record)


if __name__ == "__main__":
    main()
