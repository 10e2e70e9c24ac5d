"""Subcommands that make scans, and maps from scans."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lardhm_torch.cli.forgetting import check_not_at_once, set_max_age
from lardhm_torch.cli.map_size import check_not_incremental, fit_settings
from lardhm_torch.cli.outputs import MAP_SUFFIXES, SCAN_OUTPUTS, check_output
from lardhm_torch.cli.scan_files import (
    far_hits,
    iter_scans_of,
    read_scans,
    report_dropped,
    sampling_of,
)
from lardhm_torch.cli.tiling import update_folder

if TYPE_CHECKING:
    from lardhm_torch import LardHilbertMap, Samples, Scans
    from lardhm_torch.io.map_logs import MapLog

LOGS = {"mcap": ".mcap", "rerun": ".rrd"}
# Imports of torch are inside the functions: `lardhm --help` must be fast.


def simulate(arguments: argparse.Namespace) -> None:
    """Simulate scans of a furnished room."""
    from lardhm_torch import save_scans, simulate_room

    check_output(arguments.output, SCAN_OUTPUTS)
    scans = simulate_room(
        num_rays=arguments.rays,
        seed=arguments.seed,
        exposure_noise=arguments.exposure_noise,
        wrong_labels=arguments.wrong_labels,
    )
    save_scans(scans, arguments.output)
    print(f"{len(scans)} rays of {scans.num_scans} scans -> {arguments.output}")


def split(arguments: argparse.Namespace) -> None:
    """Split scans at random into training and test rays."""
    from lardhm_torch import save_scans, split_rays

    for path in arguments.output:
        check_output(path, SCAN_OUTPUTS, arguments.scans)
    if len({Path(path).resolve() for path in arguments.output}) == 1:
        raise ValueError(f"--output must be two different files; got {arguments.output[0]} twice")
    scans = read_scans(arguments)
    if len(scans) < 2:
        raise ValueError(f"SCANS must hold at least two rays to be split; got {len(scans)}")
    parts = split_rays(scans, arguments.ratio, seed=arguments.seed)
    for part, path in zip(parts, arguments.output, strict=True):
        save_scans(part, path)
        print(f"{len(part)} rays -> {path}")


def fit(arguments: argparse.Namespace) -> None:
    """Fit a map to scans."""
    check_output(arguments.output, MAP_SUFFIXES, arguments.scans)
    if arguments.tune_state is not None:
        inputs = [*arguments.scans, arguments.output]
        check_output(arguments.tune_state, MAP_SUFFIXES, inputs, option="--tune-state")
    for option in LOGS:
        if (path := getattr(arguments, option)) is not None:
            check_output(path, (LOGS[option],), arguments.scans, option=f"--{option}")
    if arguments.incremental:
        check_not_incremental(arguments)
        _fit_incrementally(arguments)
    else:
        _fit_at_once(arguments)


def _fit_at_once(arguments: argparse.Namespace) -> None:
    from lardhm_torch import sample_rays, scan_disagreement

    if arguments.resume or arguments.view:
        raise ValueError("--resume and --view need --incremental")
    check_not_at_once(arguments)
    if arguments.send is not None or arguments.precision is not None:
        raise ValueError(
            "--send and --precision need --incremental; `lardhm pack` packs a finished map"
        )
    for option in LOGS:
        if getattr(arguments, option) is not None:
            raise ValueError(f"--{option} needs --incremental")
    state = _tune_state(arguments.tune_state)
    scans = read_scans(arguments)
    samples = sample_rays(scans, sampling_of(arguments), seed=arguments.seed)
    report_dropped(samples.dropped)
    if not bool((samples.labels == 1).any()):
        raise ValueError(f"scans must hold at least one hit within range; got {samples.dropped}")
    apart = scan_disagreement(scans)
    noise = apart if arguments.hit_noise is None else arguments.hit_noise
    model = _new_map(scans.dim, arguments)
    model.fit(
        samples.points,
        samples.labels,
        seed=arguments.seed,
        channels=samples.channels,
        rays=scans if arguments.clear_rays else None,
        progress=True,
        **fit_settings(arguments, noise),
    )
    if arguments.tune or arguments.tune_state:
        _tune(model, scans, samples, state, noise, arguments)
    if arguments.uncertainty:
        model.fit_uncertainty(samples.points, samples.labels)
    model.save(arguments.output)
    hits, free = (int((samples.labels == label).sum()) for label in (1, 0))
    disagree = f"; scans disagree by {100 * apart:.1f} cm" if apart else ""
    print(
        f"{hits} hits and {free} free points -> {len(model)} clusters -> {arguments.output}"
        f"{far_hits(arguments)}{disagree}"
    )


def _new_map(dim: int, arguments: argparse.Namespace) -> LardHilbertMap:
    from lardhm_torch import LardHilbertMap

    settings = {} if arguments.neighbors is None else {"num_neighbors": arguments.neighbors}
    return LardHilbertMap(dim, **settings)


def _tune_state(path: str | None) -> dict[str, Any] | None:
    """The checkpoint of an earlier fine-tuning run; None if there is none."""
    from lardhm_torch.io.map_files import load_state

    if path is None or not Path(path).exists():
        return None
    state = load_state(path)
    if not {"config", "epoch"} <= state.keys():
        raise ValueError(f"--tune-state must be a checkpoint of fine-tuning; {path} is not")
    return state


def _tune(
    model: LardHilbertMap,
    scans: Scans,
    samples: Samples,
    state: dict[str, Any] | None,
    hit_noise: float,
    arguments: argparse.Namespace,
) -> None:
    """Fine-tune with free points sampled again in every epoch."""
    from lardhm_torch import TuneConfig, fine_tune, sample_rays
    from lardhm_torch.io.map_files import save_state

    path, sampling = arguments.tune_state, sampling_of(arguments)
    fine_tune(
        model,
        samples.points,
        samples.labels,
        resample=lambda epoch: sample_rays(scans, sampling, seed=arguments.seed + epoch),
        seed=arguments.seed,
        state=state,
        after_epoch=(lambda state: save_state(state, path)) if path else None,
        progress=True,
        config=TuneConfig(hit_noise=hit_noise),
    )


def _fit_incrementally(arguments: argparse.Namespace) -> None:
    """Update an empty map, or that of a checkpoint, with one scan at a time."""
    import itertools

    from lardhm_torch import StreamConfig, resume_stream, stream_scans

    if arguments.tune or arguments.tune_state:
        raise ValueError("--tune and --tune-state need all scans at once; omit --incremental")
    if arguments.uncertainty:
        raise ValueError("--uncertainty needs all scans at once; omit --incremental")
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
        first = next(scans, None)
        if first is None:
            raise ValueError("SCANS must hold at least one ray; got none")
        scans, done = itertools.chain([first], scans), None
        model = _new_map(first.dim, arguments)
    set_max_age(model, arguments)
    send = _packet_writer(arguments)
    with _live_view(arguments.view) as show, ExitStack() as stack:
        watchers = [watch for watch in (send, show) if watch is not None]
        for log in [stack.enter_context(start) for start in _map_logs(arguments)]:
            scans = log.watch(scans)
            watchers.append(log.send)

        def after_scan(model: LardHilbertMap) -> None:
            for watch in watchers:
                watch(model)

        seen = stream_scans(
            model, scans, config, path=arguments.output, done=done,
            after_scan=after_scan, progress=True,
        )  # fmt: skip
    if len(model) == 0:
        raise ValueError(f"SCANS must hold a usable ray; the map of {seen.scans} scans is empty")
    print(
        f"{seen.scans} scans, {seen.rays} rays -> {len(model)} clusters -> {arguments.output}"
        f"{far_hits(arguments)}"
    )


def _packet_writer(arguments: argparse.Namespace) -> Callable[[LardHilbertMap], None] | None:
    """The function that writes a packet after each scan; None if not wanted."""
    if arguments.send is None:
        if arguments.precision is not None:
            raise ValueError("--precision needs --send")
        return None
    from lardhm_torch.streaming import PacketWriter

    settings = {} if arguments.precision is None else {"precision": arguments.precision}
    return PacketWriter(arguments.send, resume=arguments.resume, **settings).send


def _map_logs(arguments: argparse.Namespace) -> list[AbstractContextManager[MapLog]]:
    """Writers of the logs that are wanted, to be opened."""
    from lardhm_torch.io.foxglove_files import foxglove_log
    from lardhm_torch.io.rerun_files import rerun_log

    wanted = [
        (path, start)
        for path, start in ((arguments.mcap, foxglove_log), (arguments.rerun, rerun_log))
        if path is not None
    ]
    if not wanted and arguments.heights is not None:
        raise ValueError("--heights needs --mcap or --rerun")
    return [
        start(
            path,
            every=arguments.log_every,
            resolution=arguments.log_resolution,
            heights=arguments.heights and tuple(arguments.heights),
        )
        for path, start in wanted
    ]


@contextmanager
def _live_view(is_wanted: bool) -> Iterator[Callable[[LardHilbertMap], None] | None]:
    """The function that shows a map in the browser after each scan; None if not wanted."""
    if not is_wanted:
        yield None
        return
    from lardhm_torch.viewing.viewer import LiveView

    live = LiveView()
    try:
        yield live.update
    finally:
        live.close()


def update(arguments: argparse.Namespace) -> None:
    """Update a map with more scans, one at a time."""
    if Path(arguments.map).is_dir():
        update_folder(arguments)
        return
    if arguments.output is None:
        raise ValueError(
            "--output is required for a map file; only a tiled map is updated in place"
        )
    check_output(arguments.output, MAP_SUFFIXES, arguments.scans)
    from lardhm_torch import LardHilbertMap, StreamConfig, stream_scans

    model = LardHilbertMap.load(arguments.map)
    set_max_age(model, arguments)
    config = StreamConfig(
        num_clusters=arguments.clusters,
        radius=arguments.radius,
        seed=arguments.seed,
        sampling=sampling_of(arguments),
    )
    before = len(model)
    seen = stream_scans(model, iter_scans_of(arguments, model.dim), config, progress=True)
    if seen.rays == 0:
        raise ValueError("SCANS must hold at least one ray; got none")
    model.save(arguments.output)
    print(
        f"{seen.scans} scans, {seen.rays} rays -> {before} clusters became {len(model)} "
        f"-> {arguments.output}{far_hits(arguments)}"
    )
