"""Scan after scan into a map, with checkpoints from which a killed run goes on."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import torch
from tqdm import tqdm

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io import map_files
from lardhm_torch.io.atomic_files import remove_partials
from lardhm_torch.learning.clustering import scan_clusters, split_labels
from lardhm_torch.learning.update import UpdateConfig
from lardhm_torch.sampling import (
    NoUsableRayError,
    Samples,
    SamplingConfig,
    sample_rays,
    seeded_generator,
)
from lardhm_torch.scans import Scans


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """How a stream of scans is learned."""

    num_clusters: int | None = None  # of a scan in a place the map does not know; None: from data
    max_clusters: int | None = None  # of such a scan, however much data it has; None: no limit
    max_rays: int | None = None  # of a scan, at random; None: all
    radius: float | None = None  # [m] around the sensor, beyond which the map forgets; None: never
    checkpoint_every: int = 1  # scans between two checkpoints
    seed: int = 0  # of everything random; scan n uses seed + n
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)

    def __post_init__(self) -> None:
        for name in ("num_clusters", "max_clusters", "max_rays", "radius", "checkpoint_every"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be > 0; got {value}")


def real_time(config: StreamConfig | None = None) -> StreamConfig:
    """Settings for real-time updates: all rays, with fewer free points, clusters and pseudo-samples.

    An update takes about half the time: ten full 64-beam scans per second on two cores.
    benchmarks/incremental.py measures the accuracy.

    Args:
        config: settings to start from; None: the defaults.

    Returns:
        New settings; ``config`` is unchanged.
    """
    config = config or StreamConfig()
    fit = replace(config.update.fit, batch_size=2048)
    return replace(
        config,
        max_clusters=6_800,
        sampling=replace(config.sampling, free_samples=2, near_samples=1),
        update=replace(config.update, replay=3, fit=fit),
    )


@dataclass(frozen=True)
class Progress:
    """How much of a stream is in a map: scans taken (or passed over), and rays in them."""

    scans: int = 0
    rays: int = 0


def stream_scans(
    model: LardHilbertMap,
    scans: Iterable[Scans],
    config: StreamConfig | None = None,
    *,
    path: str | os.PathLike[str] | None = None,
    done: Progress | None = None,
    after_scan: Callable[[LardHilbertMap], None] | None = None,
    progress: bool = False,
) -> Progress:
    """Update a map with one scan after the other.

    Every ``checkpoint_every`` scans, and at the end, the map and how many scans are in it are
    written to ``path`` in one atomic step: a run killed at any moment goes on from there
    (`resume_stream`) and ends with the very map of a run that was not killed.

    Args:
        model: changed in place.
        scans: one scan each (`iter_scans`); a scan without a usable ray is passed over, with a
            warning.
        config: clusters, forgetting, checkpoints.
        path: map file; None: no checkpoints.
        done: what `resume_stream` found; so many scans are passed over.
        after_scan: called with the map after every scan it learned, for a live view say.
        progress: show a bar with the rate on a terminal.

    Returns:
        What is in the map now.

    Raises:
        ValueError: the scans are not those that ``done`` was counted in.
    """
    config, done = config or StreamConfig(), done or Progress()
    seen, saved = Progress(), done
    with tqdm(desc="scans", unit="scan", disable=None if progress else True) as bar:
        for scan in scans:
            number = seen.scans
            seen = Progress(number + 1, seen.rays + len(scan))
            if seen.scans == done.scans and seen.rays != done.rays:
                raise ValueError(
                    f"scans must be those of the checkpoint, {done.rays} rays in the first "
                    f"{done.scans}; got {seen.rays}"
                )
            if seen.scans > done.scans:
                _learn(model, scan, number, config)
                if path is not None and seen.scans % config.checkpoint_every == 0:
                    _save(model, seen, path)
                    saved = seen
                if after_scan is not None:
                    after_scan(model)
            bar.set_postfix(clusters=len(model), refresh=False)
            bar.update()
    if seen.scans < done.scans:
        raise ValueError(
            f"scans must be those of the checkpoint, which holds {done.scans}; got {seen.scans}"
        )
    if path is not None and saved != seen:
        _save(model, seen, path)
    return seen


def resume_stream(path: str | os.PathLike[str]) -> tuple[LardHilbertMap, Progress]:
    """The map of a checkpoint and how much of the stream is in it.

    Partial files that an interrupted run left beside the checkpoint are removed.

    Args:
        path: checkpoint that `stream_scans` wrote.

    Returns:
        The map, and how many scans and rays are in it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a map, or not one that a stream wrote.
    """
    found = map_files.load_state(path).get(map_files.STREAM_KEY)
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), int) for name in ("scans", "rays")
    ):
        raise ValueError(f"{os.fspath(path)} must be the checkpoint of a stream; it is another map")
    model = LardHilbertMap.load(path)
    remove_partials(path)
    return model, Progress(found["scans"], found["rays"])


def _save(model: LardHilbertMap, seen: Progress, path: str | os.PathLike[str]) -> None:
    stream = {"scans": seen.scans, "rays": seen.rays}
    map_files.save_state({**model.state_dict(), map_files.STREAM_KEY: stream}, path)


def _learn(model: LardHilbertMap, scan: Scans, number: int, config: StreamConfig) -> None:
    seed = config.seed + number
    if config.max_rays is not None and len(scan) > config.max_rays:
        rng = seeded_generator(seed, "thinning", scan.ends.device)
        rows = torch.randperm(len(scan), generator=rng, device=rng.device)[: config.max_rays]
        scan = scan.select(rows.sort().values)
    try:
        sampling = config.sampling
        if len(model):  # `update` learns nothing from unknown points
            sampling = replace(sampling, behind_samples=0)
        samples = sample_rays(scan, sampling, seed=seed)
    except NoUsableRayError as error:
        warnings.warn(f"scan {number} was passed over: no usable ray; {error}", stacklevel=3)
        return
    num_clusters = _num_clusters(samples, config)
    model.update(samples.points, samples.labels, num_clusters, seed=seed, config=config.update)
    if config.radius is not None:
        model.crop(scan.origins[0], config.radius)


def _num_clusters(samples: Samples, config: StreamConfig) -> int | None:
    if config.max_clusters is None:
        return config.num_clusters
    *classes, unknown = split_labels(samples.points, samples.labels)
    shares = 2 if len(unknown) else 1  # free space beside the unknown takes as many again
    chosen = config.num_clusters or shares * sum(scan_clusters(classes))
    return config.num_clusters if chosen <= config.max_clusters else config.max_clusters
