"""A robot's loop: scan after scan into a map, with checkpoints from which a killed run goes on.

    python scripts/stream.py scans/ map.pt                       # a folder, or one file of many scans
    python scripts/stream.py scans/ map.pt --resume              # after a kill, with the same scans
    python scripts/stream.py scans/ map.pt --real-time --radius 80

The map file is a whole map at every moment: `lardhm query map.pt ...` works while this runs.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path

from lardhm_torch import LardHilbertMap, StreamConfig, iter_scans, resume_stream, stream_scans
from lardhm_torch.streaming import real_time


def main() -> None:
    """Read the command line, stream, print the rate."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scans", nargs="+", help="files or folders, in the order of the drive")
    parser.add_argument("map", type=Path)
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in MAP")
    parser.add_argument("--real-time", action="store_true", help="fewer rays and free points")
    parser.add_argument("--radius", type=float, help="[m] forget what is farther from the sensor")
    parser.add_argument("--checkpoint-every", type=int, default=1, help="scans between two (1)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    config = StreamConfig(
        radius=arguments.radius, checkpoint_every=arguments.checkpoint_every, seed=arguments.seed
    )
    if arguments.real_time:
        config = real_time(config)
    scans = iter_scans(arguments.scans)
    if arguments.resume:
        model, done = resume_stream(arguments.map)
        print(f"{done.scans} scans are in {arguments.map} already", flush=True)
    else:
        first = next(scans)
        model, done = LardHilbertMap(first.dim), None
        scans = itertools.chain([first], scans)
    start = time.perf_counter()
    seen = stream_scans(model, scans, config, path=arguments.map, done=done, progress=True)
    rate = (seen.scans - (done.scans if done else 0)) / (time.perf_counter() - start)
    print(f"{seen.scans} scans, {len(model)} clusters, {rate:.1f} scans/s -> {arguments.map}")


if __name__ == "__main__":
    main()
