"""Shared by the containers of ROS bags: messages, chunk decompression, binary values."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, BinaryIO, NamedTuple

from lardhm_torch.io.records import bytes_left

_LEAST_BYTES = 16  # least size of a message for the limit, so that empty messages count


class Message(NamedTuple):
    """One message of a bag, still packed."""

    topic: str
    kind: str  # "sensor_msgs/PointCloud2"
    recorded: int  # when [ns]
    content: memoryview
    is_ros1: bool


def common_kind(kind: str) -> str:
    """ROS 2 calls sensor_msgs/msg/PointCloud2 what ROS 1 calls sensor_msgs/PointCloud2."""
    return kind.replace("/msg/", "/")


class Unpacker:
    """Unpacks the chunks of one file, with a limit on their total size.

    Scans shrink by half or to a tenth; whole clouds of zeros to almost nothing, hence the constant.
    """

    def __init__(self, file_size: int) -> None:
        self.left = 200 * file_size + (1 << 24)

    def __call__(self, packed: memoryview, compression: str, size: int | None) -> memoryview:
        """The bytes of a chunk; size is how many there must be, None if it does not say."""
        limit = self.left if size is None else size
        if limit > self.left or limit < 0 or (compression == "lz4" and limit > 256 * len(packed)):
            raise ValueError(f"a chunk declares {size} bytes, more than the file can hold")
        if compression in ("", "none"):
            content = packed
        else:
            content = memoryview(_decompressor(compression)(bytes(packed), limit + 1))
        if len(content) > limit or (size is not None and len(content) != size):
            raise ValueError(f"a chunk declares {size} bytes; got {len(content)} or more")
        self.left -= len(content) + _LEAST_BYTES
        return content


def _decompressor(compression: str) -> Callable[[bytes, int], bytes]:
    """A function of the packed bytes and the largest size to unpack."""
    try:
        if compression == "bz2":
            import bz2

            return bz2.BZ2Decompressor().decompress
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return LZ4FrameDecompressor().decompress
        if compression == "zstd":
            try:
                from compression import zstd  # type: ignore[import-not-found]
            except ImportError:
                from backports import zstd
            return zstd.ZstdDecompressor().decompress
    except ImportError as error:
        raise ImportError(
            f"a bag compressed with {compression} needs the extra: pip install 'lardhm_torch[io]'"
        ) from error
    raise ValueError(f"compression must be none, bz2, lz4 or zstd; got {compression[:40]!r}")


class Packed:
    """Reads little-endian values from a buffer, one after the other."""

    def __init__(self, content: memoryview) -> None:
        self.content = content
        self.position = 0

    def __bool__(self) -> bool:
        return self.position < len(self.content)

    def take(self, count: int) -> memoryview:
        """The next count bytes."""
        end = self.position + count
        if end > len(self.content):
            raise ValueError(f"{count} bytes are declared; a record ends before")
        piece = self.content[self.position : end]
        self.position = end
        return piece

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """The next values by a struct layout."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def string(self) -> str:
        """Text with its length (uint32) before it."""
        return bytes(self.take(*self.unpack("I"))).decode()


def take(file: BinaryIO, count: int) -> memoryview:
    """The next count bytes of a file, allocated only if they are there."""
    if count > bytes_left(file):
        raise ValueError(f"{count} bytes are declared at {file.tell()}; got {bytes_left(file)}")
    return memoryview(file.read(count))
