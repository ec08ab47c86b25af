"""What a bridge must know when it starts again: which messages have crossed, and which still wait."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import time
from typing import TYPE_CHECKING, Any, Final, Self

from bridges.ipfs.errors import JournalFailed
from bridges.ipfs.gate import Passenger
from bridges.ipfs.memory import LASTS, Side
from bridges.ipfs.outbox import Waiting
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType

_TABLES: Final = """
    CREATE TABLE IF NOT EXISTS crossed (fingerprint BLOB PRIMARY KEY, at REAL NOT NULL) WITHOUT ROWID;
    CREATE TABLE IF NOT EXISTS waiting (
        fingerprint BLOB, key TEXT, payload BLOB, legacy BLOB, side TEXT, shared INTEGER,
        PRIMARY KEY (fingerprint, side));
"""


class Journal:
    """A file for one bridge at a time: `with Journal(path) as journal`.

    What was written is there after `kill -9`; after a power cut the last moments may be missing. Calls take some tens
    of microseconds and are made on the event loop. Raises `ConfigurationError` when another bridge uses the file, and
    `JournalFailed`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise ConfigurationError(f"can't keep a journal in {self._path.parent}: {error.strerror}") from None
        try:
            self._open()
        except BaseException:
            os.close(self._lock)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._base.close()
        os.close(self._lock)

    def wait(self, to: Side, waiting: Waiting) -> None:
        """The message waits to be carried."""
        row = (*waiting.passenger, to.value, waiting.shared)
        self._do("INSERT OR REPLACE INTO waiting VALUES (?, ?, ?, ?, ?, ?)", *row)

    def crossed(self, fingerprint: bytes) -> None:
        """The message is on both sides."""
        self._do("INSERT OR REPLACE INTO crossed VALUES (?, ?)", fingerprint, time.time())
        self._do("DELETE FROM waiting WHERE fingerprint = ?", fingerprint)

    def given_up(self, fingerprint: bytes) -> None:
        """The message will not be carried."""
        self._do("DELETE FROM waiting WHERE fingerprint = ?", fingerprint)

    def tidy(self) -> None:
        """Forget what crossed so long ago that it may cross again."""
        self._do("DELETE FROM crossed WHERE at < ?", time.time() - LASTS)

    def known(self) -> Iterator[tuple[bytes, float]]:
        """The messages that have crossed, oldest first, and how many seconds ago."""
        now = time.time()
        for fingerprint, at in self._do("SELECT fingerprint, at FROM crossed ORDER BY at"):
            yield fingerprint, now - at

    def left_over(self) -> Iterator[tuple[Side, Waiting]]:
        """The messages that waited, in the order in which they came."""
        rows = self._do("SELECT fingerprint, key, payload, legacy, side, shared FROM waiting ORDER BY rowid")
        for *passenger, side, shared in rows:
            yield Side(side), Waiting(Passenger(*passenger), bool(shared), None, 0.0)

    def _open(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigurationError(
                f"another bridge uses {self._path}", hint="give this one a folder of its own with --data-dir"
            ) from None
        self._base = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False)
        try:
            self._base.executescript("PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL;" + _TABLES)
            self.tidy()
        except sqlite3.Error as error:
            self._base.close()
            raise JournalFailed(self._path, str(error)) from error

    def _do(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        try:
            return self._base.execute(statement, values).fetchall()
        except sqlite3.Error as error:
            raise JournalFailed(self._path, str(error)) from error
