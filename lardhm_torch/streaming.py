"""Incremental mapping of a stream of scans: checkpoints to resume from, and packets to send.

A packet is a packed map, or its differences from the previous one (`io.packed_files`). A receiver that
applies all packets has exactly the integers of the sender's packed map, so queries give the same results.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from tqdm import tqdm

from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io import map_files, packed_files
from lardhm_torch.io.atomic_files import remove_partials, replaced_file
from lardhm_torch.learning import packing
from lardhm_torch.learning.clustering import scan_clusters, split_labels
from lardhm_torch.learning.points import at_most
from lardhm_torch.learning.update import UpdateConfig
from lardhm_torch.native.thinning import few_per_cell
from lardhm_torch.sampling import (
    NoUsableRayError,
    Samples,
    SamplingConfig,
    sample_rays,
)
from lardhm_torch.scans import Scans, seeded_generator


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """Settings of incremental mapping."""

    # clusters of the first scan, and maximum near each later scan; None: chosen from the data
    num_clusters: int | None = None
    max_clusters: int | None = None  # upper bound on num_clusters; None: no limit
    max_rays: int | None = None  # rays per scan, drawn at random; None: all
    radius: float | None = None  # [m] clusters farther from the sensor are removed; None: keep all
    checkpoint_every: int = 1  # write a checkpoint every N scans
    seed: int = 0  # random seed; scan n uses seed + n
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)

    def __post_init__(self) -> None:
        for name in ("num_clusters", "max_clusters", "max_rays", "radius", "checkpoint_every"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be > 0; got {value}")


def real_time(config: StreamConfig | None = None) -> StreamConfig:
    """Settings for real-time updates: fewer points per scan, and fewer kept points trained per update.

    benchmarks/incremental.py measures time and accuracy.

    Args:
        config: settings to start from; None: the defaults.

    Returns:
        New settings; ``config`` is unchanged.
    """
    config = config or StreamConfig()
    return replace(
        config,
        sampling=replace(config.sampling, free_samples=2, near_samples=1),
        update=replace(config.update, cell_edge=0.2, max_points=10_000, max_trained_points=30_000),
    )


@dataclass(frozen=True)
class Progress:
    """Progress of a stream: number of processed scans (skipped ones included) and of their rays."""

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
    """Update a map with each scan of a stream.

    Every ``checkpoint_every`` scans and at the end, the map and the progress are written to ``path``
    atomically. An interrupted run can be resumed from there (`resume_stream`) and yields exactly the
    map of an uninterrupted run.

    Args:
        model: map, changed in place.
        scans: iterable of single scans (`iter_scans`); a scan without usable rays is skipped with a
            warning.
        config: clusters, sampling, checkpoints; None: the defaults.
        path: map file; None: no checkpoints.
        done: progress returned by `resume_stream`; these scans are skipped.
        after_scan: callback that receives the map after every processed scan, e.g. a live view.
        progress: show a progress bar on a terminal.

    Returns:
        Progress after the last scan.

    Raises:
        ValueError: the scans do not match ``done``.
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
    """Load the map and the progress of a checkpoint.

    Partial files that an interrupted run left in the folder of the checkpoint are removed.

    Args:
        path: checkpoint written by `stream_scans`.

    Returns:
        The map and the progress of its stream.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a map, or not a checkpoint of a stream.
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
    scan = _thinned(scan, config, seeded_generator(seed, "thinning", scan.ends.device))
    try:
        samples = sample_rays(scan, config.sampling, seed=seed, max_points=config.update.max_points)
    except NoUsableRayError as error:
        warnings.warn(f"scan {number} was skipped: no usable ray; {error}", stacklevel=3)
        return
    num_clusters = _num_clusters(samples, config)
    model.update(
        samples.points,
        samples.labels,
        num_clusters,
        seed=seed,
        channels=samples.channels,
        time=None if scan.times is None or scan.times.isnan().any() else float(scan.times.max()),
        rays=scan,
        config=config.update,
    )
    if config.radius is not None:
        model.crop(scan.origins[0], config.radius)


def _thinned(scan: Scans, config: StreamConfig, rng: torch.Generator) -> Scans:
    """The rays of a scan that are used: at most ``max_rays``, and of those that end in one cell, four.

    Of the others, at most ``max_points`` with and ``max_points`` without a hit are drawn. All hits are
    used if they have channels.
    """
    if config.max_rays is not None and len(scan) > config.max_rays:
        rows = torch.randperm(len(scan), generator=rng, device=rng.device)[: config.max_rays]
        scan = scan.select(rows.sort().values)
    if scan.channels:
        return scan
    limit = config.update.max_points
    rows = few_per_cell(scan.ends, scan.is_return.long(), config.update.cell_edge)
    is_return = scan.is_return[rows]
    parts = [at_most(rows[kind], limit, rng) for kind in (is_return, ~is_return)]
    return scan.select(torch.cat(parts).sort().values)


def _num_clusters(samples: Samples, config: StreamConfig) -> int | None:
    if config.max_clusters is None:
        return config.num_clusters
    *classes, unknown = split_labels(samples.points, samples.labels)
    factor = 2 if len(unknown) else 1  # with unknown points, the free class gets twice as many
    chosen = config.num_clusters or factor * sum(scan_clusters(classes))
    return config.num_clusters if chosen <= config.max_clusters else config.max_clusters


# --- packets ---


class PacketSender:
    """Encodes the changes of a map as packets.

    Args:
        precision: fractional bits of the rounded parameters, 1 to 16, see `LardHilbertMap.pack`.

    Attributes:
        number: number of the last packet, -1 before the first.
    """

    def __init__(self, precision: int = packing.PRECISION) -> None:
        packing.check_precision(precision)
        self.precision = precision
        self.number = -1
        self._last: packed_files.Packed | None = None

    def packet(self, model: LardHilbertMap, *, whole: bool = False) -> bytes:
        """The next packet: the changes of the map since the last one.

        Args:
            model: the map, with any number of clusters.
            whole: encode the whole map, for receivers that missed packets. This is always done if the
                origin or the settings of the map have changed.
        """
        packed = packing.rounded(model, self.precision)
        last = None if whole else self._last
        if last is not None and last.frame != packed.frame:
            last = None
        content = packed_files.encode(packed, self.number + 1, last)
        self.number, self._last = self.number + 1, packed
        return content


class PacketReceiver:
    """Decodes packets of a `PacketSender` to a map."""

    def __init__(self) -> None:
        self._last: tuple[int, packed_files.Packed] | None = None

    @property
    def number(self) -> int:
        """Number of the last packet, -1 before the first."""
        return -1 if self._last is None else self._last[0]

    def apply(self, packet: bytes) -> None:
        """Apply the next packet. A packet with a whole map may come at any time.

        Raises:
            ValueError: the packet is damaged, of another stream, or not the next one. The map is
                unchanged.
        """
        self._last = packed_files.decode(packet, self._last)

    def map(self) -> LardHilbertMap:
        """The packed map, for queries only.

        Raises:
            RuntimeError: no packet has been applied.
        """
        if self._last is None:
            raise RuntimeError("map needs a packet; call apply first")
        return LardHilbertMap.from_state(packing.state_dict_of(self._last[1]))


class PacketWriter:
    """Writes the packets of a map to a file or a folder, for `stream_scans(after_scan=writer.send)`.

    Args:
        path: a folder, for one file per packet, or an ``.lhm`` file, to which packets are appended.
            `LardHilbertMap.load` reads both.
        precision: fractional bits, see `LardHilbertMap.pack`.
        resume: continue after the existing packets; an unfinished packet at the end of a file is
            removed. If False, existing packets are replaced.

    Raises:
        FileNotFoundError: the folder of path does not exist.
        ValueError: the existing packets are damaged, or have another precision.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        precision: int = packing.PRECISION,
        resume: bool = False,
    ) -> None:
        self.path = Path(path)
        self._sender = PacketSender(precision)
        self._in_folder = self.path.suffix != packed_files.SUFFIX
        if resume and packed_files.is_packed(self.path):
            self._resume()
        elif self._in_folder:
            self.path.mkdir(exist_ok=True)
            for file in packed_files.packet_files(self.path):
                file.unlink()
        else:
            with replaced_file(self.path):
                pass

    def send(self, model: LardHilbertMap) -> None:
        """Write the next packet."""
        content = self._sender.packet(model)
        if self._in_folder:
            with replaced_file(packed_files.packet_path(self.path, self._sender.number)) as partial:
                partial.write_bytes(content)
            return
        with open(self.path, "ab") as file:
            file.write(content)

    def _resume(self) -> None:
        if not self._in_folder:
            packed_files.drop_unfinished(self.path)
        number, packed = packed_files.load_packed(self.path)
        if packed.precision != self._sender.precision:
            raise ValueError(
                f"precision must be that of the packets in {self.path}, {packed.precision}; "
                f"got {self._sender.precision}"
            )
        self._sender.number, self._sender._last = number, packed
