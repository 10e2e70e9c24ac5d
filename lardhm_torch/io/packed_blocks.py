"""The block of channels that a packed map file may begin with; docs/map_format.md describes it."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

from lardhm_torch.io.packed_files import (
    CHANNELS_MAGIC,
    LEVEL,
    MOST_INFLATED,
    PLANES,
    block_size,
    from_planes,
    to_planes,
)

VERSION = 1
HEAD = struct.Struct(
    "<8sB3xIII"
)  # magic, version, CRC-32, bytes of the description and of the rows


def encode_block(description: dict[str, Any], tables: list[np.ndarray]) -> bytes:
    """A block of plain values and tables of int32.

    Args:
        description: what the tables are; plain values.
        tables: (rows, columns) integers.
    """
    shapes = [list(table.shape) for table in tables]
    text = json.dumps({**description, "shapes": shapes}, separators=(",", ":")).encode()
    body = b"".join(zlib.compress(to_planes(table), LEVEL) for table in tables)
    check = zlib.crc32(text + body)
    return HEAD.pack(CHANNELS_MAGIC, VERSION, check, len(text), len(body)) + text + body


def decode_block(content: bytes) -> tuple[dict[str, Any], list[np.ndarray]] | None:
    """Description and tables of the block that a file begins with; None if there is none.

    Raises:
        ValueError: the block is damaged, or of a newer version.
    """
    size = block_size(content)
    if not size:
        return None
    _, version, check, length, _ = HEAD.unpack(content[: HEAD.size])
    if version != VERSION:
        raise ValueError(f"version of the channels must be {VERSION}; got {version}")
    if size > len(content) or zlib.crc32(content[HEAD.size : size]) != check:
        raise ValueError("the checksum or the length of the channels differs: they are damaged")
    description = json.loads(content[HEAD.size : HEAD.size + length])
    body, tables = content[HEAD.size + length : size], []
    for rows, columns in description.pop("shapes"):
        if PLANES * rows * columns > MOST_INFLATED * size:
            raise ValueError(f"channels must hold {rows} rows of {columns}; they are too short")
        table, body = from_planes(body, rows, columns)
        tables.append(table)
    return description, tables
