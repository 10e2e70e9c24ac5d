"""The messages of ROS bags, one after the other, whatever the container.

The containers are read here and not by a library because a broken bag must neither take memory by
the word of its headers nor unpack without limit. What the messages mean is `bag_scans`'s.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lardhm_torch.io.bag_chunks import Message, Unpacker
from lardhm_torch.io.mcap import read_mcap
from lardhm_torch.io.ros1_bag import read_ros1
from lardhm_torch.io.ros2_sqlite import read_sqlite

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def read_messages(path: Path) -> Iterator[Message]:
    """All messages of a .bag, .db3 or .mcap file in the order of the file.

    Raises:
        ValueError: the file is no such bag, is cut short or damaged.
        ImportError: the bag is compressed and lz4 or zstd is not installed.
    """
    unpack = Unpacker(path.stat().st_size)
    for message in _packed_messages(path, unpack):
        # ROS 2 can pack messages one by one, and only metadata.yaml says so; none begins like this.
        if message.content[:4] == _ZSTD_MAGIC:
            yield message._replace(content=unpack(message.content, "zstd", None))
        else:
            yield message


def _packed_messages(path: Path, unpack: Unpacker) -> Iterator[Message]:
    if path.suffix.lower() == ".db3":
        yield from read_sqlite(path, unpack)
        return
    with open(path, "rb") as file:
        yield from (read_ros1 if path.suffix.lower() == ".bag" else read_mcap)(file, unpack)
