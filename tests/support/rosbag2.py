"""Recordings of rosbag2, as the package rosbags writes them, and databases as nobody does."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from collections.abc import Iterable

    from schemas.payloads import Payload

Storage = Literal["MCAP", "SQLITE3"]
Sent = tuple[str, int, "Payload"]
"""A message: topic, nanoseconds, payload."""


def rosbag2(folder: Path, messages: Iterable[Sent], storage: Storage, *, definitions: bool = True) -> Path:
    """Write a folder of rosbag2, and return its file of messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connections: dict[str, Any] = {}
        for topic, time, payload in messages:
            name = payload.type.schema_name
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, name, msgdef=payload.type.schema_data.decode(), rihs01=store.hash_rihs01(name)
                )
            writer.write(connections[topic], time, payload.data)
    (path,) = (file for file in folder.iterdir() if file.suffix != ".yaml")
    if not definitions:
        with sqlite3.connect(path) as database:
            database.execute("DROP TABLE message_definitions")
        database.close()
    return path


def database(path: Path, *statements: str, rows: Iterable[tuple[Any, ...]] = ()) -> Path:
    """A database with the tables of rosbag2, changed by these statements; `rows` are messages."""
    with sqlite3.connect(path) as opened:
        opened.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr');"
        )
        opened.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        for statement in statements:
            opened.executescript(statement)
    opened.close()
    return path


def database_bytes(*statements: str, rows: Iterable[tuple[Any, ...]] = ()) -> bytes:
    with TemporaryDirectory() as folder:
        return database(Path(folder) / "it.db3", *statements, rows=rows).read_bytes()
