"""Reading the SCANS arguments of the command line."""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lardhm_torch.io.notes import ScanReport
    from lardhm_torch.sampling import SamplingConfig
    from lardhm_torch.scans import Scans


def read_scans(arguments: argparse.Namespace, dim: int | None = None) -> Scans:
    """The scans named on the command line, without z for ``--dim 2`` or a 2-D map."""
    from lardhm_torch import load_scans
    from lardhm_torch.scans import every_scan, thin_rays

    scans = load_scans(arguments.scans, **_reading(arguments))
    scans = thin_rays(every_scan(scans, arguments.every), arguments.voxel)
    _count_far(scans, arguments)
    return _with_dim(scans, arguments, dim)


def iter_scans_of(arguments: argparse.Namespace, dim: int | None = None) -> Iterator[Scans]:
    """The same, one after the other."""
    from lardhm_torch import iter_scans
    from lardhm_torch.scans import thin_rays

    scans = iter_scans(arguments.scans, **_reading(arguments))
    for scan in itertools.islice(scans, 0, None, arguments.every):
        thinned = thin_rays(scan, arguments.voxel)
        _count_far(thinned, arguments)
        yield _with_dim(thinned, arguments, dim)


def iter_pieces_of(arguments: argparse.Namespace, dim: int | None = None) -> Iterator[Scans]:
    """The same in pieces of bounded size, for scans larger than memory."""
    from lardhm_torch.io.scan_files import Reading, iter_pieces
    from lardhm_torch.scans import thin_rays

    if arguments.every != 1:
        raise ValueError("--every cannot be used with tiled maps, which read files in pieces")
    is_empty = True
    for piece in iter_pieces(arguments.scans, Reading(**_reading(arguments))):
        is_empty = False
        thinned = thin_rays(piece, arguments.voxel)
        _count_far(thinned, arguments)
        yield _with_dim(thinned, arguments, dim)
    if is_empty:
        raise ValueError("SCANS must hold at least one usable ray; got none")


def describe_scans(arguments: argparse.Namespace) -> ScanReport:
    """What the readers find in the scans named on the command line, and what they assume."""
    from lardhm_torch.io.scan_files import Reading, iter_pieces

    for _ in iter_pieces(arguments.scans, Reading(**_reading(arguments))):
        pass
    report: ScanReport = arguments.report
    arguments.report = None  # the verb prints it itself
    return report


def sampling_of(arguments: argparse.Namespace) -> SamplingConfig:
    """The sampling settings with ``--min-range`` and ``--max-range``."""
    from lardhm_torch import SamplingConfig

    limits = {"min_range": arguments.min_range, "max_range": arguments.max_range}
    return SamplingConfig(**{name: value for name, value in limits.items() if value is not None})


def far_hits(arguments: argparse.Namespace) -> str:
    """How many hits lie beyond ``--max-range``, for the last line that a command prints."""
    count = arguments.num_far
    limit = sampling_of(arguments).max_range
    return f"; {count} hits beyond {limit:g} m (no hit, free space kept)" if count else ""


def _count_far(scans: Scans, arguments: argparse.Namespace) -> None:
    """Count the hits beyond the maximum range, for commands that sample rays."""
    if hasattr(arguments, "max_range"):
        far = scans.is_return & (scans.ranges > sampling_of(arguments).max_range)
        arguments.num_far += int(far.sum())


def _reading(arguments: argparse.Namespace) -> dict[str, Any]:
    """How the files are to be read; what is assumed goes into ``arguments.report``."""
    from lardhm_torch.io.notes import ScanFileWarning, ScanReport
    from lardhm_torch.io.scan_files import Camera

    arguments.report = ScanReport()
    warnings.simplefilter("ignore", ScanFileWarning)  # the report says it, too
    return {
        "origin": arguments.origin,
        "frame": arguments.frame,
        "poses_frame": arguments.poses_frame,
        "sensor_frame": arguments.sensor_frame,
        "topic": arguments.topic,
        "camera": Camera(
            intrinsics=arguments.camera,
            pixel_step=arguments.pixel_step,
            depth_scale=arguments.depth_scale,
        ),
        "strict": arguments.strict,
        "report": arguments.report,
    }


def _with_dim(scans: Scans, arguments: argparse.Namespace, dim: int | None) -> Scans:
    asked = getattr(arguments, "dim", None)
    dim = next(value for value in (asked, dim, scans.dim) if value is not None)
    if dim == scans.dim - 1:
        return scans.drop_constant_column()
    if dim != scans.dim:
        raise ValueError(f"scans must have {dim} coordinates; got {scans.dim}")
    return scans


def report_dropped(dropped: dict[str, int]) -> None:
    """Print to the error stream which rays were left out, and why."""
    for reason, count in dropped.items():
        if count:
            print(f"{count} rays: {reason}", file=sys.stderr)
