"""Training points from rays: hits are occupied, points before them free, points behind unknown."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lardhm_torch.channels import Channels, check_channels, pad_channels, select_channels
from lardhm_torch.native.crossings import Lines, never_crossed, passages
from lardhm_torch.scans import Scans, seeded_generator

UNKNOWN = 0.5  # label of points in unobserved space
LOST = 0.5  # if a larger fraction of the hits is outside the range limits, the units are wrong


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Settings of the labeled points that are sampled from rays.

    The paper takes one free sample every one to two meters of a ray (Section II-A). This leaves
    almost no data in the last section before the surface, where the map must change from free to
    occupied. ``near_samples`` adds points there.
    """

    min_range: float = 0.3  # [m] shorter rays end on the robot itself and are dropped
    max_range: float = 100.0  # [m] longer rays are truncated and count as no-return
    free_samples: int = 6  # free samples per ray, one in each of as many equal sections
    near_samples: int = 2  # free samples close in front of each hit
    near_margin: float = 0.15  # [m] minimum distance of free samples from the hit of their ray
    near_reach: float = 0.6  # [m] maximum distance of near samples from the hit
    behind_samples: int = 1  # unknown samples behind each hit, at the same distances
    # free samples per ray that passes through a flat patch of other hits; 1 for other patches; 0: none
    passing_samples: int = 2
    cell_edge: float = 0.1  # [m] edge of the cells used to test whether a ray crossed a place

    def __post_init__(self) -> None:
        if not 0 <= self.min_range < self.max_range < float("inf"):
            raise ValueError(
                "min_range and max_range must satisfy 0 <= min_range < max_range < inf; "
                f"got {self.min_range} and {self.max_range}"
            )
        if self.free_samples < 1:
            raise ValueError(f"free_samples must be 1 or more; got {self.free_samples}")
        if self.near_samples < 0:
            raise ValueError(f"near_samples must be 0 or more; got {self.near_samples}")
        if self.behind_samples < 0 or not self.cell_edge > 0:
            raise ValueError(
                "behind_samples must be 0 or more and cell_edge > 0; "
                f"got {self.behind_samples} and {self.cell_edge}"
            )
        if self.passing_samples < 0:
            raise ValueError(f"passing_samples must be 0 or more; got {self.passing_samples}")
        if not 0 <= self.near_margin < self.near_reach:
            raise ValueError(
                "near_margin and near_reach must satisfy 0 <= near_margin < near_reach; "
                f"got {self.near_margin} and {self.near_reach}"
            )


class NoUsableRayError(ValueError):
    """The scans contain no ray that can be sampled; the message counts the reasons."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Training pairs of points and labels, world frame.

    Args:
        points: (N, D) float64 positions [m]: hits first, then free points, then unknown points.
        labels: (N,) 1 occupied, 0 free, 1/2 unknown (not observed by any ray).
        ray_id: (N,) index of the ray that each point belongs to.
        dropped: number of rays left out, by reason.
        channels: additional values of the points by name (see `channels`). Hits have those of their
            rays; they are missing (NaN, or class -1) at all other points.

    Raises:
        ValueError: a channel does not have N rows, or one of its values is out of range.
    """

    points: Tensor
    labels: Tensor
    ray_id: Tensor
    dropped: dict[str, int]
    channels: Channels = field(default_factory=dict)

    def __post_init__(self) -> None:
        channels = check_channels(self.channels, len(self.points))
        object.__setattr__(self, "channels", channels)

    def __len__(self) -> int:
        """Number of points N."""
        return len(self.points)

    def to(self, like: torch.device | str | torch.dtype) -> Samples:
        """The same samples with points and labels on another device or of another floating point type.

        World coordinates far from zero (UTM) lose precision in float32; maps accept float64 points.
        """
        points, labels = self.points.to(like), self.labels.to(like)
        if isinstance(like, torch.dtype):
            return replace(self, points=points, labels=labels)
        channels = {name: values.to(like) for name, values in self.channels.items()}
        return Samples(points, labels, self.ray_id.to(like), self.dropped, channels)


def usable_rays(scans: Scans, config: SamplingConfig) -> tuple[Tensor, dict[str, int]]:
    """Mask of the rays that can be sampled, and number of the other rays by reason.

    Returns:
        ((R,) mask, counts): NaN or infinite ends or origins; ends closer than ``min_range``
        (zero-length rays among them), which lie in the sensor's own body; later returns of a
        pulse, before which space is not free.
    """
    ranges = scans.ranges
    finite = ranges.isfinite()  # not if a coordinate of either end is not
    inside = finite & ~(ranges >= max(config.min_range, 1e-9))
    later = finite & ~inside & (scans.target_index > 1)
    long = finite & scans.is_return & (ranges > config.max_range)
    counts = {
        "not finite": int((~finite).sum()),
        f"shorter than {config.min_range} m": int(inside.sum()),
        f"hits beyond {config.max_range:g} m (no hit, free space kept)": int(long.sum()),
        "later returns (hit kept, no free space)": int(later.sum()),
    }
    return finite & ~inside, counts


def _check_unit(scans: Scans, keep: Tensor, config: SamplingConfig) -> None:
    """Raise an error if most hits are outside the range limits: coordinates are not in meters."""
    ranges = scans.ranges
    rays = scans.is_return & ranges.isfinite() & (ranges > 0)
    count, short = int(rays.sum()), int((rays & ~keep).sum())
    long = int((rays & (ranges > config.max_range)).sum())
    if count and max(short, long) > LOST * count:
        which = (
            f"{short} of {count} hits are nearer than min_range = {config.min_range:g} m"
            if short > long
            else f"{long} of {count} hits are farther than max_range = {config.max_range:g} m"
        )
        raise NoUsableRayError(
            f"coordinates must be in meters; {which} (median range {float(ranges[rays].median()):.3g}). "
            "Scale points and sensor positions to meters, correct the sensor positions "
            "(`lardhm info SCANS` prints them), or give a SamplingConfig with other limits"
        )


def sample_rays(
    scans: Scans,
    config: SamplingConfig | None = None,
    *,
    seed: int = 0,
    max_points: int | None = None,
) -> Samples:
    """Sample labeled points from scans: hits are occupied, points before them free, behind them unknown.

    Each ray is divided into ``free_samples`` equal sections, with one uniform random point in each
    (stratified sampling), and has ``near_samples`` more points close in front of its hit. A beam
    without return, or one longer than ``max_range``, has free points only, up to its end or to
    ``max_range``. Later returns of a pulse (``target_index`` > 1) have a hit but no free points. Where
    a ray passes through a surface that other rays hit (`crossings.passages`), as in an open door,
    there are ``passing_samples`` more free points. Behind each hit there are ``behind_samples``
    unknown points (label 1/2), except where another ray crossed the cell.

    Args:
        scans: range scans, world frame.
        config: numbers of samples and range limits; the defaults are suitable for all scenes.
        seed: random seed of the positions.
        max_points: maximum number of points of each label. A stratified random subset is drawn, and
            only its points are computed. None: no limit.

    Returns:
        Labeled points, the hits first, with the channels of their rays.

    Raises:
        NoUsableRayError: no ray is usable, or more than half of the hits are outside the range
            limits. This is a ValueError whose message gives the reason.

    Source: Guizilini & Ramos 2016, Section II-A.
    """
    config = config or SamplingConfig()
    keep, dropped = usable_rays(scans, config)
    _check_unit(scans, keep, config)
    if not keep.any():
        raise NoUsableRayError(
            f"scans must hold at least one usable ray of {len(scans)}; got {dropped}"
        )
    rays = _rows(keep)
    # the starts of a single scan are one point: gathering them for every ray would take longest
    starts = scans.origins[:1] if scans.num_scans == 1 else scans.ray_origins[rays]
    offsets = _taken(scans.ends, rays) - starts
    ranges = torch.linalg.vector_norm(offsets, dim=1)
    is_hit = _taken(scans.is_return, rays) & (ranges <= config.max_range)
    reach = ranges.clamp(max=config.max_range)
    free_end = torch.where(is_hit, (reach - config.near_margin).clamp(min=0), reach)
    first = _taken(scans.target_index, rays) == 1
    ahead = offsets / ranges[:, None]
    rng = seeded_generator(seed, "sampling", ranges.device)
    limits = _free_limits(int(first.sum()), int((is_hit & first).sum()), config, max_points)
    groups = [
        _stratified_depths(_rows(first), free_end, config.free_samples, limits[0], rng),
        _near_depths(_rows(is_hit & first), free_end, config, limits[1], rng),
    ]
    hits = _rows(is_hit)
    if max_points is not None and max_points < len(hits) and not scans.channels:
        hits = hits[spread_rows(len(hits), max_points, rng)]
    count = len(hits) + sum(depths.numel() for _, depths in groups)
    points, ray_id = ranges.new_empty(count, scans.dim), hits.new_empty(count)
    hit_rays = _taken(rays, hits)
    points[: len(hits)], ray_id[: len(hits)] = _taken(scans.ends, hit_rays), hit_rays
    begin = len(hits)
    for members, depths in groups:  # written in place: on a full scan a million points
        rows = slice(begin, begin := begin + depths.numel())
        of_rays = _taken if limits[0] is None else Tensor.__getitem__
        start = starts if scans.num_scans == 1 else of_rays(starts, members)
        along, block = of_rays(ahead, members), points[rows].view(*depths.shape, scans.dim)
        for axis in range(scans.dim):  # three times as fast as all axes at once
            column = slice(axis, axis + 1)
            torch.addcmul(start[:, column], depths, along[:, column], out=block[..., axis])
        ray_id[rows].view_as(depths).copy_(of_rays(rays, members)[:, None])
    labels = torch.zeros(count, device=points.device)
    labels[: len(hits)] = 1
    samples = Samples(points, labels, ray_id, dropped)
    channels = select_channels(scans.channels, hit_rays)
    seen = _rows(first)
    from_there = starts if len(starts) == 1 else _taken(starts, seen)
    lines = Lines(from_there, _taken(ahead, seen), _taken(free_end, seen))
    if config.passing_samples:
        whole = lines._replace(reach=_taken(reach, seen))
        passing = seeded_generator(seed, "passing", ranges.device)
        samples = _with_passing(
            samples, len(hits), whole, lines.reach, _taken(rays, seen), config, passing
        )
        if max_points is not None:
            samples = _thinned(samples, len(hits), max_points, passing)
    if config.behind_samples:
        samples = _with_unknown(samples, _taken(ahead, hits), lines, config, rng)
    return _with_channels(samples, channels)


def _with_passing(
    known: Samples,
    num_hits: int,
    lines: Lines,
    ends: Tensor,
    ray_id: Tensor,
    config: SamplingConfig,
    rng: torch.Generator,
) -> Samples:
    """The samples and, after them, free points where rays pass through surfaces (`passages`).

    Args:
        known: occupied and free samples, the hits first.
        num_hits: number of hits.
        lines: R rays, as far as the hit of each.
        ends: (R,) depths before which space is free [m].
        ray_id: (R,) their numbers.
        config: how many, and how far behind a surface a ray must end.
        rng: random state.
    """
    found = passages(known.points[:num_hits], lines, ends, config.near_reach)
    counts = torch.where(found.is_flat, config.passing_samples, 1)
    rays, depths, widths = (column.repeat_interleave(counts) for column in found[:3])
    place = torch.rand(len(rays), generator=rng, device=rng.device, dtype=depths.dtype)
    depths = (depths + widths * (2 * place - 1)).clamp(min=0).minimum(ends[rays])
    places = lines.starts_of(rays) + depths[:, None] * lines.ahead[rays]
    return _appended(known, places, 0.0, ray_id[rays])


def _thinned(samples: Samples, num_hits: int, limit: int, rng: torch.Generator) -> Samples:
    """All hits and at most ``limit`` of the free points after them: a stratified random subset."""
    if (free := len(samples) - num_hits) <= limit:
        return samples
    kept = num_hits + spread_rows(free, limit, rng)
    rows = torch.cat([torch.arange(num_hits, device=kept.device), kept])
    return Samples(
        samples.points[rows], samples.labels[rows], samples.ray_id[rows], samples.dropped
    )


def _with_channels(samples: Samples, of_hits: Channels) -> Samples:
    """The samples with the channels of the hits, which come first."""
    if not of_hits:
        return samples
    return replace(samples, channels=pad_channels(of_hits, len(samples)))


def _with_unknown(
    known: Samples, ahead: Tensor, lines: Lines, config: SamplingConfig, rng: torch.Generator
) -> Samples:
    """The samples and, after them, unknown points behind the hits, where no ray went.

    Args:
        known: occupied and free samples, the H hits first.
        ahead: (H, D) directions of the hits' rays.
        lines: all rays.
        config: how many, how deep.
        rng: random state.
    """
    count = config.behind_samples
    depths = _depths_behind(len(ahead), config, rng)
    places = (known.points[: len(ahead), None] + depths * ahead[:, None]).flatten(0, 1)
    rows = _rows(never_crossed(places, *lines, config.cell_edge))
    rays = known.ray_id[: len(ahead)].repeat_interleave(count)[rows]
    return _appended(known, _taken(places, rows), UNKNOWN, rays)


def _appended(samples: Samples, points: Tensor, label: float, ray_id: Tensor) -> Samples:
    """The samples and, after them, (N, D) points with one label, on (N,) rays."""
    return Samples(
        torch.cat([samples.points, points]),
        torch.cat([samples.labels, samples.labels.new_full((len(points),), label)]),
        torch.cat([samples.ray_id, ray_id]),
        samples.dropped,
    )


def _free_limits(
    rays: int, hits: int, config: SamplingConfig, max_points: int | None
) -> tuple[int | None, int | None]:
    """Maximum numbers of free points along all rays and close to hits, in proportion to all of them."""
    along, near = rays * config.free_samples, hits * config.near_samples
    if max_points is None or along + near <= max_points:
        return None, None
    limit = round(max_points * along / (along + near))
    return limit, max_points - limit


def _stretches(
    rays: Tensor, count: int, limit: int | None, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Which stretches of the rays are sampled: all, or a stratified random subset.

    Args:
        rays: (R,) rows.
        count: stretches of each ray.
        limit: maximum number of stretches; None: all.
        rng: random generator.

    Returns:
        (Q,) rows and (Q, C) or (1, C) numbers of stretches.
    """
    if limit is None or len(rays) * count <= limit:
        return rays, torch.arange(count, device=rays.device)[None]
    chosen = spread_rows(len(rays) * count, limit, rng)
    return rays[chosen // max(1, count)], (chosen % max(1, count))[:, None]


def _stratified_depths(
    rays: Tensor, free_end: Tensor, count: int, limit: int | None, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """(Q,) rows of rays, and (Q, C) depths [m], one in each of ``count`` equal stretches of a ray."""
    members, stretches = _stretches(rays, count, limit, rng)
    shape = (len(members), stretches.shape[1])
    depths = torch.rand(shape, generator=rng, device=rng.device, dtype=free_end.dtype)
    depths += stretches
    return members, depths.mul_((free_end[members] / count)[:, None])


def _near_depths(
    rays: Tensor, free_end: Tensor, config: SamplingConfig, limit: int | None, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """(Q,) rows of rays, and (Q, C) depths [m] close in front of their hits."""
    members, stretches = _stretches(rays, config.near_samples, limit, rng)
    shape = (len(members), stretches.shape[1])
    depths = torch.rand(shape, generator=rng, device=rng.device, dtype=free_end.dtype)
    end = free_end[members][:, None]
    # A short ray is sampled over its whole free part, so that no sample lies in the sensor.
    return members, end - depths * end.clamp(max=config.near_reach - config.near_margin)


def _depths_behind(count: int, config: SamplingConfig, rng: torch.Generator) -> Tensor:
    """(count, behind_samples, 1) depths behind hits [m], log-uniform from near_margin to near_reach."""
    shape = (count, config.behind_samples, 1)
    share = torch.rand(shape, generator=rng, device=rng.device, dtype=torch.float64)
    share += torch.arange(config.behind_samples, device=rng.device)[:, None]
    low = max(config.near_margin, 1e-2 * config.near_reach)
    return low * (config.near_reach / low) ** (share / config.behind_samples)


def _rows(mask: Tensor) -> Tensor:
    """``mask.nonzero().squeeze(1)``, several times as fast where all are meant."""
    if bool(mask.all()):
        return torch.arange(len(mask), device=mask.device)
    return mask.nonzero().squeeze(1)


def _taken(tensor: Tensor, rows: Tensor) -> Tensor:
    """``tensor[rows]`` of rows that ascend: the tensor itself, not copied, where they are all."""
    return tensor if len(rows) == len(tensor) else tensor.index_select(0, rows)


def spread_rows(num_points: int, count: int, rng: torch.Generator, *times: int) -> Tensor:
    """(*times, count) ascending random rows of N: one from each of ``count`` <= N equal strata."""
    shape = (*times, count)
    place = torch.rand(shape, generator=rng, device=rng.device, dtype=torch.double)
    place += torch.arange(count, device=rng.device)
    return (place * (num_points / count)).long().clamp_(max=num_points - 1)
