"""Deduplication: the messages a bridge has seen on each side, in memory, and its journal on disk across restarts."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import time
from collections import OrderedDict
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, Self

from bridges.ipfs.errors import JournalFailed
from bridges.ipfs.publish_queue import QueuedMessage
from bridges.ipfs.validation import RelayMessage
from mesh.errors import ConfigurationError
from mesh.private_files import make_private_database, make_private_folder, open_private
from mesh.retry import RetryPolicy
from schemas.keys import market_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

DEDUPLICATION_WINDOW: Final = 600.0
"""Seconds for which a message that was seen on a side is known to be there."""
REPETITION: Final = RetryPolicy(initial=60.0, ceiling=DEDUPLICATION_WINDOW)
"""How long after a message was relayed a copy from its own side is relayed again: its sender still waits for an effect,
so the message may have been lost on the way, or nobody who could use it had joined yet."""
DEDUPLICATION_LIMIT: Final = 131_072
"""Messages remembered per side, at most; the oldest are forgotten first."""
_TABLES: Final = """
    CREATE TABLE IF NOT EXISTS crossed (fingerprint BLOB PRIMARY KEY, at REAL NOT NULL) WITHOUT ROWID;
    CREATE TABLE IF NOT EXISTS waiting (
        fingerprint BLOB, key TEXT, payload BLOB, legacy BLOB, side TEXT, shared INTEGER, hash TEXT NOT NULL DEFAULT '',
        PRIMARY KEY (fingerprint, side));
"""


class Side(Enum):
    """A side of the bridge."""

    MESH = "mesh"
    IPFS = "ipfs"

    @property
    def other(self) -> Side:
        """The opposite side."""
        return Side.IPFS if self is Side.MESH else Side.MESH


class SeenMessages:
    """The fingerprints of messages seen on each side within the deduplication window. `clock` returns seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen: dict[Side, OrderedDict[bytes, float]] = {side: OrderedDict() for side in Side}

    def add(self, fingerprint: bytes, side: Side, *, age: float = 0.0) -> None:
        """Record that the message was on `side` `age` seconds ago. Recording it again keeps the first time."""
        seen = self._seen[side]
        if self.contains(fingerprint, side):
            return
        seen.pop(fingerprint, None)
        seen[fingerprint] = self._clock() - age
        if len(seen) > DEDUPLICATION_LIMIT:
            seen.popitem(last=False)

    def contains(self, fingerprint: bytes, side: Side) -> bool:
        """Whether the message was seen on that side within the window."""
        seen = self._seen[side].get(fingerprint)
        return seen is not None and self._clock() - seen < DEDUPLICATION_WINDOW

    def __len__(self) -> int:
        """The number of messages remembered, on the side with more."""
        return max(len(seen) for seen in self._seen.values())


class RelayedMessages:
    """The fingerprints of messages relayed to one side: how often, and when last. `clock` returns seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._relayed: OrderedDict[bytes, tuple[int, float]] = OrderedDict()

    def add(self, fingerprint: bytes) -> None:
        """The message was relayed now."""
        times, _ = self._relayed.pop(fingerprint, (0, 0.0))
        self._relayed[fingerprint] = (times + 1, self._clock())
        if len(self._relayed) > DEDUPLICATION_LIMIT:
            self._relayed.popitem(last=False)

    def is_due(self, fingerprint: bytes) -> bool | None:
        """Whether to relay another copy from its sender; None for a message that was never relayed."""
        if fingerprint not in self._relayed:
            return None
        times, at = self._relayed[fingerprint]
        return self._clock() - at >= REPETITION.delay(times)

    def __len__(self) -> int:
        return len(self._relayed)


class RelayJournal:
    """The SQLite file of one bridge: `with RelayJournal(path) as journal`.

    Writes survive `kill -9`; a power failure may lose the last moments. Calls take tens of microseconds and run on the
    event loop. Raises `ConfigurationError` when another bridge uses the file, and `JournalFailed`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        try:
            make_private_folder(self._path.parent)
            self._lock = open_private(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT)
            make_private_database(self._path)
        except OSError as error:
            raise ConfigurationError(f"can't write a journal in {self._path.parent}: {error.strerror}") from None
        try:
            self._open()
        except BaseException:
            os.close(self._lock)
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._database.close()
        os.close(self._lock)

    def add_waiting(self, to: Side, queued: QueuedMessage) -> None:
        """The message waits to be sent to side `to`."""
        one = queued.message
        row = (one.fingerprint, one.key, one.payload, one.legacy, to.value, queued.shared, one.hash)
        self._do("INSERT OR REPLACE INTO waiting VALUES (?, ?, ?, ?, ?, ?, ?)", *row)

    def mark_relayed(self, fingerprint: bytes) -> None:
        """The message is on both sides."""
        self._do("INSERT OR REPLACE INTO crossed VALUES (?, ?)", fingerprint, time.time())
        self._do("DELETE FROM waiting WHERE fingerprint = ?", fingerprint)

    def remove_waiting(self, fingerprint: bytes) -> None:
        """The message will not be sent."""
        self._do("DELETE FROM waiting WHERE fingerprint = ?", fingerprint)

    def prune(self) -> None:
        """Delete messages that were relayed before the deduplication window."""
        self._do("DELETE FROM crossed WHERE at < ?", time.time() - DEDUPLICATION_WINDOW)

    def relayed(self) -> Iterator[tuple[bytes, float]]:
        """The fingerprints of relayed messages, oldest first, with their age in seconds."""
        now = time.time()
        for fingerprint, at in self._do("SELECT fingerprint, at FROM crossed ORDER BY at"):
            yield fingerprint, now - at

    def waiting(self) -> Iterator[tuple[Side, QueuedMessage]]:
        """The waiting messages with their destination, in their order of arrival."""
        rows = self._do("SELECT fingerprint, key, payload, legacy, hash, side, shared FROM waiting ORDER BY rowid")
        for *message, side, shared in rows:
            yield Side(side), QueuedMessage(RelayMessage(*message), bool(shared), None, 0.0)

    def _open(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigurationError(
                f"another bridge uses {self._path}", hint="give this bridge a folder of its own with --data-dir"
            ) from None
        self._database = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False)
        try:
            self._database.executescript("PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL;" + _TABLES)
            self._convert_old_keys()
            self.prune()
        except sqlite3.Error as error:
            self._database.close()
            raise JournalFailed(self._path, str(error)) from error

    def _convert_old_keys(self) -> None:
        """In files of version 0, keys end with the message's hash."""
        if self._do("PRAGMA user_version")[0][0]:
            return
        if "hash" not in (row[1] for row in self._do("PRAGMA table_info(waiting)")):
            self._do("ALTER TABLE waiting ADD COLUMN hash TEXT NOT NULL DEFAULT ''")
            for rowid, key in self._do("SELECT rowid, key FROM waiting"):
                self._do("UPDATE waiting SET key = ?, hash = ? WHERE rowid = ?", *_key_and_hash(key), rowid)
        self._do("PRAGMA user_version = 1")

    def _do(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        try:
            return self._database.execute(statement, values).fetchall()
        except sqlite3.Error as error:
            raise JournalFailed(self._path, str(error)) from error


def _key_and_hash(old: str) -> tuple[str, str]:
    """The key and the hash of a message, from a key that ends with the hash."""
    match old.split("/"):
        case ["aira", lighthouse, ("demand" | "offer") as kind, model, digest]:
            return market_key(lighthouse, kind, model), digest
        case ["aira", lighthouse, "result", _, digest]:
            return market_key(lighthouse, "result", ""), digest
    return old.rsplit("/", 2 if "/feedback/" in old else 1)[0], ""
