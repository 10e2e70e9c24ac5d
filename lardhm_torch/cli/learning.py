"""Verbs that make maps of scans."""

from __future__ import annotations

import argparse
from pathlib import Path

from lardhm_torch.cli.scan_files import (
    check_hits,
    far_hits,
    iter_scans_of,
    read_scans,
    report_dropped,
    sampling_of,
)
from lardhm_torch.cli.tiling import update_folder

# torch and the rooms are imported inside the verbs: `lardhm --help` must be instant.


def simulate(arguments: argparse.Namespace) -> None:
    """Scans of the simulated room to a file."""
    from lardhm_torch import save_scans, simulate_room

    scans = simulate_room(num_rays=arguments.rays, seed=arguments.seed)
    save_scans(scans, arguments.output)
    print(f"{len(scans)} rays of {scans.num_scans} scans -> {arguments.output}")


def split(arguments: argparse.Namespace) -> None:
    """Whole rays to a training and a test file."""
    from lardhm_torch import save_scans, split_rays

    parts = split_rays(read_scans(arguments), arguments.ratio, arguments.seed)
    for part, path in zip(parts, arguments.output, strict=True):
        save_scans(part, path)
        print(f"{len(part)} rays -> {path}")


def fit(arguments: argparse.Namespace) -> None:
    """Scans to a map."""
    from lardhm_torch import LardHilbertMap, fine_tune, sample_rays
    from lardhm_torch.io.map_files import load_state, save_state

    if arguments.incremental:
        _fit_incrementally(arguments)
        return
    if arguments.resume or arguments.view or arguments.radius is not None:
        raise ValueError(
            "--resume, --view and --radius belong to --incremental, which is not given"
        )
    scans = read_scans(arguments)
    sampling = sampling_of(arguments)
    samples = sample_rays(scans, sampling, seed=arguments.seed)
    hits = int(samples.labels.sum())
    check_hits(arguments, hits)
    report_dropped(samples.dropped)
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
            resample=lambda epoch: sample_rays(scans, sampling, seed=arguments.seed + epoch),
            seed=arguments.seed,
            state=load_state(path) if path and Path(path).exists() else None,
            after_epoch=(lambda state: save_state(state, path)) if path else None,
            progress=True,
        )
    model.save(arguments.output)
    print(
        f"{hits} hits and {len(samples) - hits} free points -> {len(model)} clusters "
        f"-> {arguments.output}{far_hits(arguments)}"
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
        sampling=sampling_of(arguments),
        seed=arguments.seed,
    )
    scans = iter_scans_of(arguments)
    if arguments.resume:
        model, done = resume_stream(arguments.output)
    else:
        first = next(scans)
        scans, done = itertools.chain([first], scans), None
        settings = {} if arguments.neighbors is None else {"num_neighbors": arguments.neighbors}
        model = LardHilbertMap(first.dim, **settings)
    live = None
    if arguments.view:
        from lardhm_torch.viewing.viewer import LiveView

        live = LiveView()
    try:
        seen = stream_scans(
            model, scans, config, path=arguments.output, done=done,
            after_scan=live.update if live else None, progress=True,
        )  # fmt: skip
    finally:
        if live:
            live.close()
    print(
        f"{seen.scans} scans, {seen.rays} rays -> {len(model)} clusters -> {arguments.output}"
        f"{far_hits(arguments)}"
    )


def update(arguments: argparse.Namespace) -> None:
    """More scans into a map, one after the other; a tiled map is updated in place."""
    if Path(arguments.map).is_dir():
        update_folder(arguments)
        return
    if arguments.output is None:
        raise ValueError("--output FILE is needed; only a tiled map is updated in place")
    from lardhm_torch import LardHilbertMap, StreamConfig, stream_scans

    model = LardHilbertMap.load(arguments.map)
    config = StreamConfig(
        num_clusters=arguments.clusters,
        radius=arguments.radius,
        seed=arguments.seed,
        sampling=sampling_of(arguments),
    )
    before = len(model)
    seen = stream_scans(model, iter_scans_of(arguments, model.dim), config, progress=True)
    model.save(arguments.output)
    print(
        f"{seen.scans} scans, {seen.rays} rays -> {before} clusters became {len(model)} "
        f"-> {arguments.output}{far_hits(arguments)}"
    )
