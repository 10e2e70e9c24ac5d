"""Reading the SCANS arguments of the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lardhm_torch.scans import Scans


def read_scans(arguments: argparse.Namespace, dim: int | None = None) -> Scans:
    """The scans named on the command line, without z where ``--dim 2`` or a 2-D map asks for it."""
    from lardhm_torch import load_scans

    scans = load_scans(arguments.scans, **_reading(arguments))
    return _with_dim(scans, arguments, dim)


def iter_scans_of(arguments: argparse.Namespace, dim: int | None = None) -> Iterator[Scans]:
    """The same, one after the other."""
    from lardhm_torch import iter_scans

    for scan in iter_scans(arguments.scans, **_reading(arguments)):
        yield _with_dim(scan, arguments, dim)


def iter_pieces_of(arguments: argparse.Namespace, dim: int | None = None) -> Iterator[Scans]:
    """The same in pieces of bounded size, for scans larger than memory."""
    from lardhm_torch.io.scan_files import iter_pieces

    for piece in iter_pieces(arguments.scans, **_reading(arguments)):
        yield _with_dim(piece, arguments, dim)


def _reading(arguments: argparse.Namespace) -> dict[str, Any]:
    """How the files are to be read."""
    from lardhm_torch.io.scan_files import Camera

    return {
        "origin": arguments.origin,
        "frame": arguments.frame,
        "topic": arguments.topic,
        "camera": Camera(intrinsics=arguments.camera, pixel_step=arguments.pixel_step),
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
    """Say on the error stream which rays were left out, and why."""
    for reason, count in dropped.items():
        if count:
            print(f"{count} rays {reason}", file=sys.stderr)
