#!/usr/bin/env bash
# rosbags 0.11.9: the reader of .db3 files opens the database with immutable=1, so SQLite does not
# look at the write-ahead log. A ROS 2 recorder that was killed leaves bag_0.db3 and bag_0.db3-wal;
# sqlite3 reads all messages of the pair, rosbags those that had reached the database, without a
# warning. The same happens in rosbags-convert, which then writes a bag that has lost them for good.
# Cure before reading: sqlite3 bag_0.db3 "PRAGMA wal_checkpoint(TRUNCATE)".
#
# Output seen: sqlite3 reads 5 messages, rosbags reads 2, warnings: 0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q rosbags==0.11.9
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import shutil
import sqlite3
import warnings
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
kind = "std_msgs/msg/String"
with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
    connection = writer.add_connection("/text", kind, typestore=store)
    for number in range(2):
        message = store.types[kind](data=str(number))
        writer.write(connection, number + 1, store.serialize_cdr(message, kind))
# A recorder in WAL mode, with three more messages in its log, is killed: the copy has no shutdown.
path = next(Path("bag").glob("*.db3"))
live = sqlite3.connect(path)
live.execute("PRAGMA journal_mode=WAL")
live.execute("PRAGMA wal_autocheckpoint=0")
for number in range(2, 5):
    content = bytes(store.serialize_cdr(store.types[kind](data=str(number)), kind))
    live.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (number + 1, content)
    )
live.commit()
shutil.copytree("bag", "killed", ignore=shutil.ignore_patterns("*-shm"))
live.close()
shutil.copytree("killed", "copy")  # sqlite3 itself merges the log when it opens the file
by_sqlite = sqlite3.connect(next(Path("copy").glob("*.db3")))
(expected,) = by_sqlite.execute("SELECT COUNT(*) FROM messages").fetchone()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    with AnyReader([Path("killed")]) as reader:
        got = len(list(reader.messages()))
print(f"sqlite3 reads {expected} messages, rosbags reads {got}, warnings: {len(caught)}")
assert (expected, got, len(caught)) == (5, 2, 0), "the behavior has changed"
PYTHON
