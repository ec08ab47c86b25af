"""What a crash of the machine leaves of a folder (what was synced, and chance decides about the rest), and full disks.

Files are real. What `os.fsync` was called for is remembered here, and what SQLite has synced: each commit with
`synchronous = FULL`; otherwise what it has moved from its log to the database. A process may crash at each commit.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import shutil
import sqlite3
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from tests.simulation.chance import FaultDraw

LOG: Final = "-wal"
"""How SQLite names the log of a database."""
INDEX: Final = "-shm"
"""The index of that log, which SQLite makes again."""
FULL: Final = 2
"""SQLite's `synchronous` from which each commit is synced."""
WRITES: Final = ("INSERT", "UPDATE", "DELETE", "REPLACE", "CREATE", "ALTER", "DROP", "COMMIT")


class SimulatedDisk:
    """The disk under the folder at `root`: of all processes, each with its own folder."""

    def __init__(self, root: Path, draw: FaultDraw) -> None:
        self.root = root
        self.full: set[str] = set()
        """The folders of processes whose disk is full."""
        self.synced: dict[int, bytes] = {}
        """What files have on the disk, by inode."""
        self._entries: dict[int, dict[str, int]] = {}
        """What directories have on the disk: names and inodes."""
        self._draw = draw

    def fsync(self, descriptor: int) -> None:
        """`os.fsync`."""
        found = os.fstat(descriptor)
        path = Path(f"/proc/self/fd/{descriptor}")
        if stat.S_ISDIR(found.st_mode):
            self._entries[found.st_ino] = {entry.name: entry.inode() for entry in os.scandir(path)}
        else:
            self.synced[found.st_ino] = path.read_bytes()
        process = scheduler().process
        if process is not None:
            process.commit()

    def check_space(self, path: object) -> None:
        """Raise `OSError` if the disk of a file, or of a descriptor, is full."""
        if self.full and self.is_full(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def is_full(self, path: object) -> bool:
        """Whether the disk of a file, or of a descriptor, is full."""
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}")
        if self.full.isdisjoint(Path(os.fspath(path)).parts):  # type: ignore[call-overload]
            return False
        self._draw.counts["write-refused"] += 1
        return True

    def crash(self, folder: Path, *, power: bool) -> None:
        """Bring a folder to what a crash leaves: all that was written, unless the machine lost its `power`.

        The files are copies: the locks of the dead process are on the old ones.
        """
        gone = folder.with_name(f"{folder.name}.gone")
        folder.rename(gone)
        self._restore(gone, folder, power=power)
        shutil.rmtree(gone)

    def _restore(self, gone: Path, folder: Path, *, power: bool) -> None:
        folder.mkdir()
        entries = self._entries.get(gone.stat().st_ino)
        for path in sorted(gone.iterdir()):
            target = folder / path.name
            if path.is_dir():
                self._restore(path, target, power=power)
                continue
            if path.name.endswith(INDEX):
                continue
            kept = path.read_bytes()
            if power:
                left = self._after_power_failure(path, kept, entries or {})
                if left is None:
                    self._draw.counts["file-lost"] += 1
                    continue
                self._draw.counts["write-torn"] += left != kept
                kept = left
            target.write_bytes(kept)
            shutil.copystat(path, target)
            synced = kept if power else self.synced.get(path.stat().st_ino)
            if synced is not None:
                self.synced[target.stat().st_ino] = synced
        if entries is not None:
            self._entries[folder.stat().st_ino] = entries

    def _after_power_failure(self, path: Path, now: bytes, entries: dict[str, int]) -> bytes | None:
        """What is left of a file; None if its name was not synced, and is lost with it."""
        synced = self.synced.get(path.stat().st_ino)
        if synced is None and path.name not in entries and self._draw.random.random() < 0.5:
            return None
        return self._torn(now, synced or b"")

    def _torn(self, now: bytes, synced: bytes) -> bytes:
        """What is left of a file: all, what was synced, or a part of what was added since."""
        if now == synced:
            return now
        choice = self._draw.random.random()
        if choice < 0.3:
            return now
        if choice < 0.6 or not now.startswith(synced):
            return synced
        return now[: self._draw.random.randint(len(synced), len(now))]

    def install(self) -> None:
        """Take the place of `os.fsync`, of what writes to files, and of SQLite's connections."""
        module: Any = os
        module.fsync = self.fsync
        for name in ("write", "pwrite"):
            setattr(os, name, _checked(self, getattr(os, name)))
        io.open = builtins.open = _opener(self)
        connect = sqlite3.connect

        def connect_here(path: Any, *arguments: Any, **options: Any) -> sqlite3.Connection:
            connection: DatabaseConnection = connect(path, *arguments, factory=DatabaseConnection, **options)
            connection.disk, connection.path = self, Path(path)
            return connection

        sqlite3.connect = connect_here  # type: ignore[assignment]


def _checked(disk: SimulatedDisk, write: Any) -> Any:
    def checked(descriptor: int, *arguments: Any) -> Any:
        disk.check_space(descriptor)
        return write(descriptor, *arguments)

    return checked


def _opener(disk: SimulatedDisk) -> Any:
    """`open`, for files that notice when the disk is full."""
    original = io.open

    class File(io.FileIO):
        def write(self, data: Any, /) -> int:
            disk.check_space(self.fileno())
            return super().write(data)

    def open_here(file: Any, mode: str = "r", buffering: int = -1, *arguments: Any, **options: Any) -> Any:
        if "b" not in mode or not set("wax+") & set(mode) or arguments:
            return original(file, mode, buffering, *arguments, **options)
        raw = File(
            file, mode.replace("b", ""), **{name: options[name] for name in ("opener", "closefd") if name in options}
        )
        if buffering == 0:
            return raw
        size = buffering if buffering > 1 else io.DEFAULT_BUFFER_SIZE
        return io.BufferedRandom(raw, size) if "+" in mode else io.BufferedWriter(raw, size)

    return open_here


class DatabaseConnection(sqlite3.Connection):
    """A connection whose commits may fail on a full disk, and after which its process may crash."""

    disk: SimulatedDisk
    path: Path
    _moved: tuple[int, int] = (0, 0)

    def execute(self, statement: str, *arguments: Any) -> sqlite3.Cursor:
        """Execute a statement."""
        done: sqlite3.Cursor = self._guarded(statement, super().execute, statement, *arguments)
        return done

    def executemany(self, statement: str, *arguments: Any) -> sqlite3.Cursor:
        """Execute a statement for each row."""
        done: sqlite3.Cursor = self._guarded(statement, super().executemany, statement, *arguments)
        return done

    def executescript(self, statements: str) -> sqlite3.Cursor:
        """Execute several statements."""
        done: sqlite3.Cursor = self._guarded("CREATE", super().executescript, statements)
        return done

    def commit(self) -> None:
        """Commit."""
        if self.in_transaction:
            self._guarded("COMMIT", super().commit)

    def _guarded(self, statement: str, function: Any, *arguments: Any) -> Any:
        word = statement.lstrip()[:8].upper()
        is_commit = word.startswith(WRITES) and (word.startswith("COMMIT") or not self.in_transaction)
        if is_commit and self.disk.full and self.disk.is_full(self.path):
            if self.in_transaction:
                super().rollback()
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise error
        found = function(*arguments)
        if is_commit:
            self._committed()
        return found

    def _committed(self) -> None:
        """A commit is synced if SQLite does that, and in any case once it is moved from the log to the database."""
        if not self.path.exists():  # of a process that is dead
            return
        (level,) = super().execute("PRAGMA synchronous").fetchone()
        log, found = self.path.with_name(self.path.name + LOG), self.path.stat()
        moved, before = (found.st_size, found.st_mtime_ns), self._moved
        self._moved = moved
        if moved != before:
            self.disk.synced[found.st_ino] = self.path.read_bytes()
        if log.exists() and (moved != before or level >= FULL):
            self.disk.synced[log.stat().st_ino] = log.read_bytes()
        process = scheduler().process
        if process is not None:
            process.commit()
