"""What a crash of the machine leaves of a folder (what was synced, and chance decides about the rest), and full disks.

Files are real. What `os.fsync` was called for is remembered here, and what SQLite has synced: the database itself, and
of its log what it has moved there. A process may crash at each commit.
"""

from __future__ import annotations

import builtins
import errno
import fcntl
import io
import os
import shutil
import sqlite3
import stat
import struct
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from mesh.base.private_files import is_locked
from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from tests.simulation.chance import FaultDraw

LOG: Final = "-wal"
"""How SQLite names the log of a database."""
INDEX: Final = "-shm"
"""The index of that log, which SQLite makes again."""
LOG_HEADER: Final = 32
FRAME_HEADER: Final = 24
"""Bytes before the first frame of a log, and before the page of each."""
SALTS: Final = slice(16, 24)
"""Where a log's header has what changes whenever SQLite begins it again."""
INDEX_HEADER: Final = struct.Struct("=14xHI12x8s56xI")
"""The index: the page's size, the log's frames, its salts, and how many frames are in the database."""
LOCK_POLL_NS: Final = 1_000_000
"""Between two looks at a file that another thread has locked."""
WRITES: Final = ("INSERT", "UPDATE", "DELETE", "REPLACE", "CREATE", "ALTER", "DROP", "COMMIT")


class LogState(NamedTuple):
    """How far a database's log goes."""

    page: int
    frames: int
    salts: bytes
    moved: int
    """Frames that are in the database, which were synced before."""

    @classmethod
    def of(cls, database: str) -> Self | None:
        """That of a database now; None if it has no log."""
        try:
            index = os.open(database + INDEX, os.O_RDONLY)
        except FileNotFoundError:
            return None
        try:
            return cls(*INDEX_HEADER.unpack(os.pread(index, INDEX_HEADER.size, 0)))
        finally:
            os.close(index)

    def cut(self, log: bytes) -> bytes:
        """A log up to here: without what SQLite has not written over since it began the log again."""
        if log[SALTS] != self.salts:
            return b""
        return log[: LOG_HEADER + self.frames * (FRAME_HEADER + self.page)]

    def ending_at(self, size: int) -> Self:
        """The same with the frames that a log of that size has."""
        return self._replace(frames=max(0, size - LOG_HEADER) // (FRAME_HEADER + self.page))


class SimulatedDisk:
    """The disk under the folder at `root`: of all processes, each with its own folder."""

    def __init__(self, root: Path, draw: FaultDraw) -> None:
        self.root = root
        self.full: set[str] = set()
        """The folders of processes whose disk is full."""
        self.synced: dict[int, bytes] = {}
        """What files have on the disk, by inode."""
        self.databases: set[int] = set()
        """The inodes of databases; all that is in one is on the disk: SQLite syncs what it moves there from the log."""
        self.logs: dict[int, LogState] = {}
        """How far databases' logs are on the disk, by inode."""
        self._entries: dict[int, dict[str, int]] = {}
        """What directories have on the disk: names and inodes."""
        self._draw = draw

    def fsync(self, descriptor: int) -> None:
        """`os.fsync`."""
        found = os.fstat(descriptor)
        path = f"/proc/self/fd/{descriptor}"
        if stat.S_ISDIR(found.st_mode):
            self._entries[found.st_ino] = {entry.name: entry.inode() for entry in os.scandir(path)}
        elif found.st_ino in self.logs:
            latest = LogState.of(os.readlink(path).removesuffix(LOG))
            if latest is not None:
                self.logs[found.st_ino] = latest
        else:
            self.synced[found.st_ino] = Path(path).read_bytes()
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

        Databases and locked files become copies: the locks of the dead process are on the old ones.
        """
        self._restore(str(folder), power=power)

    def _restore(self, folder: str, *, power: bool) -> None:
        entries = self._entries.get(os.stat(folder).st_ino, {})
        # An index comes last: it says how far its log goes.
        for entry in sorted(os.scandir(folder), key=lambda one: (one.name.endswith(INDEX), one.name)):
            path, inode = entry.path, entry.inode()
            if entry.is_dir():
                self._restore(path, power=power)
            elif path.endswith(INDEX):
                os.unlink(path)
            elif not power:
                if self._is_held(path, inode):
                    self._copy(path, inode, Path(path).read_bytes())
            elif (left := self._after_power_failure(path, inode, now := Path(path).read_bytes(), entries)) is None:
                self._draw.counts["file-lost"] += 1
                os.unlink(path)
            else:
                if left != now or self._is_held(path, inode):
                    inode = self._copy(path, inode, left)
                if inode in self.logs:
                    self.logs[inode] = self.logs[inode].ending_at(len(left))
                elif inode not in self.databases:
                    self.synced[inode] = left

    def _is_held(self, path: str, inode: int) -> bool:
        """Whether the dead process may still have a file, as SQLite or by a lock."""
        is_database = inode in self.databases or os.path.exists(path + LOG)
        return is_database or inode in self.logs or path.endswith(LOG) or is_locked(Path(path))

    def _copy(self, path: str, inode: int, data: bytes) -> int:
        """Put a new file with this content in the place of one, of which it inherits the rest; its inode."""
        new = path + ".new"
        Path(new).write_bytes(data)
        shutil.copystat(path, new)
        os.replace(new, path)
        copy = os.stat(path).st_ino
        if inode in self.databases:
            self.databases.add(copy)
        elif inode in self.logs:
            self.logs[copy] = self.logs[inode]
        elif inode in self.synced:
            self.synced[copy] = self.synced[inode]
        return copy

    def _after_power_failure(self, path: str, inode: int, now: bytes, entries: dict[str, int]) -> bytes | None:
        """What is left of a file; None if its name was not synced, and is lost with it."""
        if inode in self.databases:
            return now
        if inode in self.logs:
            latest = LogState.of(path.removesuffix(LOG))
            now, synced = now if latest is None else latest.cut(now), self.logs[inode].cut(now)
        elif inode in self.synced:
            synced = self.synced[inode]
        elif os.path.basename(path) not in entries and self._draw.random.random() < 0.5:
            return None
        else:
            synced = b""
        left = self._torn(now, synced)
        self._draw.counts["write-torn"] += left != now
        return left

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
        """Take the place of `os.fsync`, of what locks and writes files, and of SQLite's connections."""
        module: Any = os
        module.fsync = self.fsync
        fcntl.flock = _waiting(fcntl.flock)
        for name in ("write", "pwrite"):
            setattr(os, name, _checked(self, getattr(os, name)))
        io.open = builtins.open = _opener(self)
        connect = sqlite3.connect

        def connect_here(path: Any, *arguments: Any, **options: Any) -> sqlite3.Connection:
            connection: DatabaseConnection = connect(path, *arguments, factory=DatabaseConnection, **options)
            connection.disk, connection.path = self, str(path)
            return connection

        sqlite3.connect = connect_here  # type: ignore[assignment]


def _waiting(flock: Any) -> Any:
    """`flock` that lets others run while it waits: one of them may have the lock."""

    def lock(descriptor: Any, operation: int) -> None:
        while True:
            try:
                return flock(descriptor, operation | fcntl.LOCK_NB)  # type: ignore[no-any-return]
            except BlockingIOError:
                if operation & fcntl.LOCK_NB:
                    raise
            scheduler().wait(LOCK_POLL_NS)

    return lock


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
    path: str
    _log = 0
    _moved: tuple[bytes, int] | None = None

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
        """A commit is synced by who made it, or once SQLite moves it from the log to the database."""
        if not self._log:
            self._find_files()
        latest = LogState.of(self.path)
        if latest is not None:
            moved = (latest.salts, latest.moved)
            if latest.moved and moved != self._moved:
                self.disk.logs[self._log] = latest
            else:
                self.disk.logs.setdefault(self._log, latest._replace(frames=0))
            self._moved = moved
        process = scheduler().process
        if process is not None:
            process.commit()

    def _find_files(self) -> None:
        with suppress(FileNotFoundError):
            self.disk.databases.add(os.stat(self.path).st_ino)
            self._log = os.stat(self.path + LOG).st_ino
