"""LAS and LAZ through laspy (extra "io"): scaled coordinates and return numbers."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lardhm_torch.io.readout import Readout

_POINTS_AT_A_TIME = 1_000_000
_VLR_BYTES = 54


def read_las(path: Path) -> Readout:
    """Coordinates X scale + offset, float64, and the return number of each point.

    A return number of 0, which the format forbids, is what writers leave when they know none: such
    points count as first returns.

    Raises:
        ImportError: laspy or its LAZ part is not installed.
        ValueError: the header is not one of LAS, or the file is shorter than it says.

    Source: ASPRS LAS 1.4 R15, public header block.
    """
    _check_header(path)
    try:
        import laspy
        import lazrs  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"{path} needs laspy. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    ends, returns = [], []
    with laspy.open(path, read_evlrs=False) as reader:
        for points in reader.chunk_iterator(_POINTS_AT_A_TIME):
            ends.append(np.stack([points.x, points.y, points.z], axis=1).astype(np.float64))
            returns.append(np.asarray(points.return_number, dtype=np.int64))
        promised = reader.header.point_count
    got = sum(map(len, ends))
    if got == 0 or got != promised:
        raise ValueError(f"{promised} points are promised, at least one is needed; got {got}")
    return Readout(
        np.concatenate(ends),
        target_index=np.maximum(np.concatenate(returns), 1),
        origin_cure="The format has no place for it: convert to .npz with origins,",
    )


def _check_header(path: Path) -> None:
    """Hold what the header promises against the file's size, before anything is allocated."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        header = file.read(375).ljust(375, b"\0")
    if header[:4] != b"LASF" or size < 227:
        raise ValueError(f"a LAS file begins with LASF; got {header[:4]!r}")
    header_size, points_at, num_vlrs = struct.unpack_from("<HII", header, 94)
    point_format, point_bytes, count = struct.unpack_from("<BHI", header, 104)
    if header[25] >= 4:
        (count,) = struct.unpack_from("<Q", header, 247)
    if not header_size + num_vlrs * _VLR_BYTES <= points_at <= size:
        raise ValueError(
            f"{num_vlrs} variable records are promised before byte {points_at} of {size}"
        )
    is_compressed = point_format & 0x80
    if not is_compressed and count * point_bytes > size - points_at:
        raise ValueError(
            f"{count} points of {point_bytes} bytes are promised; got {size - points_at} bytes"
        )
