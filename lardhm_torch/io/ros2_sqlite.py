"""ROS 2 bags in sqlite3: the tables topics and messages."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lardhm_torch.io.bag_chunks import Message, Unpacker, common_kind

_LOGS = ("-wal", "-journal")  # what a recorder that was killed leaves beside its database


def unmerged_log(path: Path) -> Path | None:
    """A log beside a database that holds part of its content; None if there is none."""
    logs = [path.with_name(path.name + ending) for ending in _LOGS]
    return next((log for log in logs if log.is_file() and log.stat().st_size), None)


def read_sqlite(path: Path, unpack: Unpacker) -> Iterator[Message]:
    """All messages; a log that a killed recorder left is merged, in a temporary copy.

    Source: https://github.com/ros2/rosbag2 (rosbag2_storage_sqlite3).
    """
    log = unmerged_log(path)
    if log is None:
        yield from _read_database(f"{path.absolute().as_uri()}?immutable=1", unpack)
        return
    size = path.stat().st_size + 2 * log.stat().st_size
    with tempfile.TemporaryDirectory() as folder:
        if size > shutil.disk_usage(folder).free:
            raise ValueError(
                f"the recorder was killed and left {log.name}, which must be merged first. "
                f'Run: sqlite3 {path.name} "PRAGMA wal_checkpoint(TRUNCATE)"'
            )
        copy = Path(folder) / "bag.db3"
        shutil.copyfile(path, copy)
        shutil.copyfile(log, copy.with_name(copy.name + log.name.removeprefix(path.name)))
        yield from _read_database(copy.as_uri(), unpack)


def _read_database(address: str, unpack: Unpacker) -> Iterator[Message]:
    try:
        connection = sqlite3.connect(address, uri=True)
        try:
            yield from _sqlite_messages(connection, unpack)
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise ValueError(f"the database is damaged: {error}") from error


def _sqlite_messages(connection: sqlite3.Connection, unpack: Unpacker) -> Iterator[Message]:
    """Plain tables only: views and computed columns may take unlimited time."""
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
        yield Message(*topics[number], stamp, unpack(memoryview(content), "", None), False)
