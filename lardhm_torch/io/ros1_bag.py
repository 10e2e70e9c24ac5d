"""ROS 1 bags: records of a header (fields name=value) and a body, all lengths uint32."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from lardhm_torch.io.bag_chunks import Message, Packed, Unpacker, common_kind, take
from lardhm_torch.io.records import bytes_left


@dataclass
class _Ros1:
    """Connections and topics of the records so far."""

    topics: dict[int, tuple[str, str]]
    num_chunks: int = 0
    num_connections: int = 0


def read_ros1(file: BinaryIO, unpack: Unpacker) -> Iterator[Message]:
    """Source: https://wiki.ros.org/Bags/Format/2.0."""
    if file.readline(64) != b"#ROSBAG V2.0\n":
        raise ValueError("a ROS 1 bag begins with the line '#ROSBAG V2.0'; this one does not")
    bag, opening = _Ros1({}), _ros1_header(take(file, *_word(file)))
    index_at, promised = _number(opening, "index_pos"), _number(opening, "conn_count")
    chunks = _number(opening, "chunk_count")
    if not index_at:
        raise ValueError("the recording was not closed and has no index. Run: rosbag reindex")
    take(file, *_word(file))
    while bytes_left(file):
        if file.tell() == index_at:
            bag.num_connections = 0  # the connection records are repeated
        header = _ros1_header(take(file, *_word(file)))
        body = take(file, *_word(file))
        if _number(header, "op") == 5:
            bag.num_chunks += 1
            size = _number(header, "size")
            inner = Packed(unpack(body, _text(header, "compression"), size))
            while inner:
                inner_header = _ros1_header(inner.take(*inner.unpack("I")))
                yield from _ros1_message(bag, inner_header, inner.take(*inner.unpack("I")))
        else:
            yield from _ros1_message(bag, header, body)
    if (bag.num_chunks, bag.num_connections) != (chunks, promised):
        raise ValueError(
            f"{chunks} chunks and {promised} connections are declared; "
            f"got {bag.num_chunks} and {bag.num_connections}"
        )


def _ros1_message(bag: _Ros1, header: dict[str, memoryview], body: memoryview) -> Iterator[Message]:
    operation = _number(header, "op")
    if operation == 7:
        kind = _text(_ros1_header(body), "type")
        bag.topics[_number(header, "conn")] = (_text(header, "topic"), common_kind(kind))
        bag.num_connections += 1
    elif operation == 2:
        number = _number(header, "conn")
        if number not in bag.topics:
            raise ValueError(f"a message belongs to connection {number}, which is not described")
        seconds, nanoseconds = Packed(header["time"]).unpack("II")
        yield Message(*bag.topics[number], seconds * 10**9 + nanoseconds, body, True)


def _word(file: BinaryIO) -> tuple[int]:
    return struct.unpack("<I", take(file, 4))


def _ros1_header(content: memoryview) -> dict[str, memoryview]:
    fields, rest = {}, Packed(content)
    while rest:
        field = rest.take(*rest.unpack("I"))
        name, equals, _ = bytes(field[:64]).partition(b"=")
        if not equals:
            raise ValueError(f"a header field must be name=value; got {bytes(field[:40])!r}")
        fields[name.decode("latin-1")] = field[len(name) + 1 :]
    return fields


def _number(header: dict[str, memoryview], name: str) -> int:
    return int.from_bytes(_field(header, name)[:8], "little")


def _text(header: dict[str, memoryview], name: str) -> str:
    return bytes(_field(header, name)).decode()


def _field(header: dict[str, memoryview], name: str) -> memoryview:
    if name not in header:
        raise ValueError(f"a record header must have {name}; got {', '.join(header) or 'nothing'}")
    return header[name]
