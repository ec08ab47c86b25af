"""Safe writing of files: temporary files with a lock, names that survive a crash, and streams that report progress."""

from __future__ import annotations

import errno
import os
import secrets
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, BinaryIO, Final, Protocol, Self, TypeAlias, cast

from mesh.base.private_files import lock, open_private, try_lock
from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

Progress: TypeAlias = "Callable[[int, int | None], None]"
"""Is called with how far a long operation is: bytes done, and bytes in all or None if that is not known."""

PUT_PREFIX: Final = ".put-"
"""Prefix of a file that is being written. It is deleted once its writer is gone."""
PART_PREFIX: Final = ".part-"
"""Prefix of a file that is being fetched. The next fetch of the same CID continues it."""

_DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class StoreFull(AiraError, code="store-full"):
    """The store has no space for a file: its disk is full.

    Or its quota is reached (`quota-reached`), even after evicting all that may be evicted.
    """

    def __init__(self, path: Path, *, why: str = "", hint: str = "", code: str = "") -> None:
        hint = hint or "free some space, or move the store to another disk"
        super().__init__(why or f"the disk of {path} is full", hint=hint, code=code)
        self.path = path


class Readable(Protocol):
    """Anything to read bytes from; an empty read is its end."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, at most `size`."""


class TemporaryFile:
    """An open file under a temporary name in the directory of its final one, locked while it is open.

    Leaving the `with` block closes the file and deletes it, unless it was kept or renamed. The lock shows other
    processes that its writer is still alive.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor
        self.is_kept = False
        """Whether the file will still exist, under either name, after the `with` block."""
        self._unwritten = 0

    @classmethod
    def create(cls, directory: Path, prefix: str) -> TemporaryFile:
        """A new, empty file with a unique name."""
        while True:
            created = cls.take(directory / f"{prefix}{secrets.token_hex(8)}")
            if created is not None:
                return created

    @classmethod
    def take(cls, path: Path) -> TemporaryFile | None:
        """The file at `path`, created if it does not exist, or None if another writer has it locked."""
        descriptor = open_private(path, os.O_RDWR | os.O_CREAT)
        try:
            same = try_lock(descriptor) and os.fstat(descriptor).st_ino == os.stat(path).st_ino
        except FileNotFoundError:
            same = False
        if same:
            return cls(path, descriptor)
        os.close(descriptor)
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        if not self.is_kept:
            with suppress(FileNotFoundError):
                self.path.unlink()
        os.close(self._descriptor)

    @property
    def size(self) -> int:
        """Its current length in bytes."""
        return os.fstat(self._descriptor).st_size

    def write(self, data: bytes, *, offset: int) -> None:
        """Write all of `data` at `offset`. Raises `StoreFull`."""
        with raising_store_full(self.path.parent):
            view = memoryview(data)
            while view:
                done = os.pwrite(self._descriptor, view, offset)
                view, offset = view[done:], offset + done
            self._unwritten += len(data)
            if self._unwritten >= 8 << 20:
                self._unwritten = 0
                if hasattr(os, "posix_fadvise"):  # macOS has none
                    # Starts the write-back now, so that `finish` does not wait for all of a large file.
                    os.posix_fadvise(self._descriptor, 0, 0, os.POSIX_FADV_DONTNEED)

    def read(self, length: int, *, offset: int) -> bytes:
        """The bytes from `offset`; fewer than `length` at the end of the file."""
        return os.pread(self._descriptor, length, offset)

    def finish(self, size: int, *, mode: int = 0o400, sync: bool = True) -> None:
        """Cut the file to `size` bytes and `sync` it to the disk. Raises `StoreFull`."""
        with raising_store_full(self.path.parent):
            os.ftruncate(self._descriptor, size)
            os.fchmod(self._descriptor, mode)
            if sync:
                os.fsync(self._descriptor)

    def rename(self, final: Path) -> None:
        """Give the file its final name, replacing any file of that name. Atomic; durable after `sync_directory`."""
        self.path.rename(final)
        self.is_kept = True


@contextmanager
def raising_store_full(directory: Path) -> Iterator[None]:
    """Turn an `OSError` that means a full disk into `StoreFull`."""
    try:
        yield
    except OSError as error:
        if error.errno in _DISK_FULL:
            raise StoreFull(directory) from error
        raise


@contextmanager
def directory_lock(directory: Path) -> Iterator[None]:
    """Hold the exclusive lock of the directory, waiting for any other process or thread that has it."""
    descriptor = open_private(directory / ".lock", os.O_RDWR | os.O_CREAT)
    try:
        lock(descriptor)
        yield
    finally:
        os.close(descriptor)


def stamp(path: Path) -> tuple[int, ...]:
    """A value that changes whenever the file is changed or replaced."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def read_or_nothing(descriptor: int, length: int, offset: int) -> bytes:
    """The bytes at `offset`, or none if the disk fails to read them (EIO)."""
    try:
        return os.pread(descriptor, length, offset)
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        return b""


def with_progress(stream: BinaryIO, progress: Progress | None, *, total: int | None) -> BinaryIO:
    """The same stream, for reading only, which calls `progress`, if given, after each read."""
    return stream if progress is None else cast("BinaryIO", _ProgressStream(stream, progress, total=total))


class _ProgressStream:
    def __init__(self, stream: Readable, progress: Progress, *, total: int | None) -> None:
        self._stream = stream
        self._progress = progress
        self._total = total
        self._done = 0

    def read(self, size: int, /) -> bytes:
        data = self._stream.read(size)
        self._done += len(data)
        self._progress(self._done, self._total)
        return data
