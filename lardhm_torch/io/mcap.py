"""MCAP: records of an operation (uint8), a length (uint64) and a body."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from lardhm_torch.io.bag_chunks import Message, Packed, Unpacker, common_kind, take

_MAGIC = b"\x89MCAP0\r\n"


class _Mcap:
    """Schemas by number, and topics by the number of their channel."""

    def __init__(self) -> None:
        self.kinds: dict[int, str] = {0: ""}
        self.channels: dict[int, tuple[str, str, bool]] = {}

    def read(self, operation: int, body: Packed) -> Iterator[Message]:
        """Take in one record, and give its message if it is one."""
        if operation == 3:
            (number,) = body.unpack("H")
            self.kinds[number] = common_kind(body.string())
        elif operation == 4:
            number, schema = body.unpack("HH")
            topic, encoding = body.string(), body.string()
            if schema not in self.kinds:
                raise ValueError(f"topic {topic} has schema {schema}, which is not described")
            kind = self.kinds[schema] if encoding in ("cdr", "ros1") else ""
            self.channels[number] = (topic, kind, encoding == "ros1")
        elif operation == 5:
            number, _, stamp, _ = body.unpack("HIQQ")
            if number not in self.channels:
                raise ValueError(f"a message belongs to channel {number}, which is not described")
            topic, kind, is_ros1 = self.channels[number]
            content = body.take(len(body.content) - body.position)
            yield Message(topic, kind, stamp, content, is_ros1)


def read_mcap(file: BinaryIO, unpack: Unpacker) -> Iterator[Message]:
    """Source: https://mcap.dev/spec."""
    if bytes(take(file, 8)) != _MAGIC:
        raise ValueError("an MCAP file begins with 89 MCAP0; this one does not")
    start = file.tell()
    file.seek(-8, 2)
    if file.tell() < start or file.read(8) != _MAGIC:
        raise ValueError("an MCAP file ends with 89 MCAP0; this one is cut. Run: mcap recover")
    file.seek(start)
    mcap = _Mcap()
    while True:
        operation, size = struct.unpack("<BQ", take(file, 9))
        body = Packed(take(file, size))
        if operation in (2, 15):  # footer, end of data: a summary follows
            return
        if operation == 6:
            _, _, size, checksum = body.unpack("QQQI")
            compression = body.string()
            content = unpack(body.take(*body.unpack("Q")), compression, size)
            if checksum and zlib.crc32(content) != checksum:
                raise ValueError("the checksum of a chunk is wrong")
            inner = Packed(content)
            while inner:
                operation, size = inner.unpack("BQ")
                yield from mcap.read(operation, Packed(inner.take(size)))
        else:
            yield from mcap.read(operation, body)
