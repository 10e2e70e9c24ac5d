"""ROS 2 bags in sqlite3: the tables topics and messages."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from lardhm_torch.io.bag_chunks import Message, Unpacker, common_kind


def read_sqlite(path: Path, unpack: Unpacker) -> Iterator[Message]:
    """Source: https://github.com/ros2/rosbag2 (rosbag2_storage_sqlite3)."""
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
        try:
            yield from _sqlite_messages(connection, unpack)
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise ValueError(f"the database is damaged: {error}") from error


def _sqlite_messages(connection: sqlite3.Connection, unpack: Unpacker) -> Iterator[Message]:
    """Plain tables only: views and computed columns can stand for endless work."""
    described = connection.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
    tables = {name for kind, name, _ in described if kind == "table"}
    if not {"topics", "messages"} <= tables:
        raise ValueError(f"tables topics and messages are needed; got {sorted(tables)[:10]}")
    for kind, name, sql in described:
        words = (sql or "").upper().replace("(", " ( ").split()
        if kind not in ("table", "index") or "VIRTUAL" in words or "AS" in words:
            raise ValueError(f"plain tables are needed; {name} is none")
    topics = {
        number: (str(name), common_kind(str(kind)))
        for number, name, kind in connection.execute("SELECT id, name, type FROM topics")
    }
    rows = connection.execute("SELECT topic_id, timestamp, data FROM messages")
    for number, stamp, content in rows:
        if number not in topics or not isinstance(stamp, int) or not isinstance(content, bytes):
            raise ValueError(f"a message of topic {number!r} at {stamp!r} is damaged")
        yield Message(*topics[number], 1e-9 * stamp, unpack(memoryview(content), "", None), False)
