"""Update a map scan by scan, with checkpoints from which an interrupted run resumes.

    python scripts/stream.py scans/ map.pt                       # a folder, or one file of many scans
    python scripts/stream.py scans/ map.pt --resume              # after a kill, with the same scans
    python scripts/stream.py scans/ map.pt --real-time --radius 80

The map file is valid at any time: `lardhm query map.pt ...` works while this runs.
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
    parser.add_argument("scans", nargs="+", help="files or folders, in the order of recording")
    parser.add_argument("map", type=Path)
    parser.add_argument("--resume", action="store_true", help="resume from the checkpoint in MAP")
    parser.add_argument("--real-time", action="store_true", help="use the settings of real_time()")
    parser.add_argument(
        "--radius", type=float, help="remove clusters farther than this from the sensor [m]"
    )
    parser.add_argument(
        "--checkpoint-every",
        type=int,
        default=1,
        help="write a checkpoint every N scans (default: 1)",
    )
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
