"""Temporary files that belong to whoever holds their lock, and names that last."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, Self

from mesh.content.errors import StoreFull

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import TracebackType

PUT_PREFIX: Final = ".put-"
"""Starts the name of a file that is being written; worthless once its writer is gone."""
PART_PREFIX: Final = ".part-"
"""Starts the name of a file that is being fetched; the next fetch of the same CID goes on from it."""

_WRITE_BEHIND: Final = 8 << 20
"""Bytes that are written before the disk is told to begin with them."""
_NO_ROOM: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class TemporaryFile:
    """An open file under a temporary name in the directory of its final one, locked while it is open.

    Leaving the `with` block closes it and, unless it was kept or got its name, deletes it. Other processes tell by
    the lock whether its writer still lives.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor
        self._mine = True
        self._unwritten = 0

    @classmethod
    def create(cls, directory: Path, prefix: str) -> TemporaryFile:
        """A new, empty file with a name of its own."""
        while True:
            made = cls.take(directory / f"{prefix}{secrets.token_hex(8)}")
            if made is not None:
                return made

    @classmethod
    def take(cls, path: Path) -> TemporaryFile | None:
        """The file at `path`, made if it is not there, or None while somebody else holds it."""
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            same = os.fstat(descriptor).st_ino == os.stat(path).st_ino
        except (BlockingIOError, FileNotFoundError):
            same = False
        if same:
            return cls(path, descriptor)
        os.close(descriptor)
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._mine:
            with suppress(FileNotFoundError):
                self.path.unlink()
        os.close(self._descriptor)

    @property
    def is_kept(self) -> bool:
        """Whether the file will be there, under either name, after the `with` block."""
        return not self._mine

    @property
    def size(self) -> int:
        """Its length in bytes now."""
        return os.fstat(self._descriptor).st_size

    def write(self, data: bytes, *, offset: int) -> None:
        """Write all of `data` at `offset`. Raises `StoreFull`."""
        with raising_store_full(self.path.parent):
            view = memoryview(data)
            while view:
                done = os.pwrite(self._descriptor, view, offset)
                view, offset = view[done:], offset + done
            self._unwritten += len(data)
            if self._unwritten >= _WRITE_BEHIND:
                self._unwritten = 0
                # Has the disk begin with what is there, so that `finish` does not wait for all of a large file.
                os.posix_fadvise(self._descriptor, 0, 0, os.POSIX_FADV_DONTNEED)

    def read(self, length: int, *, offset: int) -> bytes:
        """The bytes from `offset`; fewer than `length` at the end of the file."""
        return os.pread(self._descriptor, length, offset)

    def keep(self) -> None:
        """Leave the file where it is when the `with` block ends."""
        self._mine = False

    def discard(self) -> None:
        """Delete the file when the `with` block ends, even if it was kept."""
        self._mine = True

    def finish(self, size: int, *, mode: int = 0o444) -> None:
        """Put its first `size` bytes on the disk, and nothing after them. Raises `StoreFull`."""
        with raising_store_full(self.path.parent):
            os.ftruncate(self._descriptor, size)
            os.fchmod(self._descriptor, mode)
            os.fsync(self._descriptor)

    def rename(self, final: Path) -> None:
        """Give the file its final name, replacing what is there. Atomic; lasts once the directory is synced."""
        self.path.rename(final)
        self._mine = False


@contextmanager
def raising_store_full(directory: Path) -> Iterator[None]:
    """Turn an `OSError` that means a full disk into `StoreFull`."""
    try:
        yield
    except OSError as error:
        if error.errno in _NO_ROOM:
            raise StoreFull(directory) from error
        raise


@contextmanager
def directory_lock(directory: Path) -> Iterator[None]:
    """LockedEntry the directory for this process (and thread) alone; waits for whoever has it."""
    descriptor = os.open(directory / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def is_taken(path: Path) -> bool:
    """Whether somebody has locked the file at `path`, in this process or another: who writes it, or has it in use."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def sync_directory(directory: Path) -> None:
    """Put the directory's names on the disk: a rename lasts only after this."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def stamp(path: Path) -> tuple[int, ...]:
    """What is different once a file was changed or replaced."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
