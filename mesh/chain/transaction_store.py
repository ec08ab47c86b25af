"""Sent transactions on disk: a file for each nonce of an account, locked by the process that waits for it.

The name of a file is the nonce: creating it reserves the nonce among all processes of the account. It is locked
(flock) while its process lives and waits: a file that is not locked was left behind.
Each line is one version of the transaction, written before it is sent.
"""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from mesh.chain.errors import TransactionDamaged, TransactionsNotKept
from mesh.private_files import make_private_folder

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

SUFFIX: Final = ".jsonl"
UNFINISHED: Final = ".new"
LOCK_ATTEMPTS: Final = 5
LOCK_PAUSE: Final = 0.01
"""Seconds between two attempts to lock a file, which a reader holds for a moment only."""

Version: TypeAlias = dict[str, Any]
"""A version of a transaction, as JSON."""


class LockedEntry:
    """The file of one transaction, locked by this process. Its methods block for the time of a disk write."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor = descriptor

    def append(self, version: Version) -> None:
        """Write the newest version of the transaction."""
        with _on_disk(self._path):
            # A line that a crash or a full disk cut off would make the next one unreadable too.
            end = os.pread(self._descriptor, os.fstat(self._descriptor).st_size, 0).rfind(b"\n") + 1
            os.ftruncate(self._descriptor, end)
            os.lseek(self._descriptor, end, os.SEEK_SET)
            left = memoryview(json.dumps(version).encode() + b"\n")
            while left:  # a disk that is nearly full takes a part
                left = left[os.write(self._descriptor, left) :]
            os.fsync(self._descriptor)

    def release(self) -> None:
        """Unlock the file; another process may lock it."""
        os.close(self._descriptor)

    def remove(self) -> None:
        """Delete the file, and unlock it."""
        try:
            with _on_disk(self._path):
                self._path.unlink(missing_ok=True)
        finally:
            os.close(self._descriptor)


class TransactionStore:
    """The folder with an account's sent transactions on one chain. Raises `TransactionsNotKept` if it can't be written.

    Not for network file systems, whose locks other machines may not see.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with _on_disk(folder / "x"):
            make_private_folder(folder)

    def add(self, nonce: int, version: Version) -> LockedEntry | None:
        """Create and lock the file of a nonce; None if it exists."""
        path = self._path(nonce)
        with _on_disk(path):
            descriptor, unfinished = tempfile.mkstemp(suffix=UNFINISHED, dir=self._folder)
        locked = LockedEntry(path, descriptor)
        try:
            locked.append(version)
            with _on_disk(path):
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                # The file is complete and locked before others can see it.
                if not _linked(unfinished, path):
                    locked.release()
                    return None
        except BaseException:
            locked.release()
            raise
        finally:
            with suppress(OSError):  # whatever is wrong with the disk was raised above
                os.unlink(unfinished)
        return locked

    def lock(self, nonce: int) -> LockedEntry | None:
        """Lock the file of a nonce; None if there is none, or another process has locked it."""
        path = self._path(nonce)
        for attempt in range(LOCK_ATTEMPTS):
            with _on_disk(path):
                descriptor = lock_file(path, fcntl.LOCK_EX)
            if descriptor is not None:
                return LockedEntry(path, descriptor)
            if attempt and not path.exists():
                break
            time.sleep(LOCK_PAUSE)
        return None

    def read(self, mine: Collection[int]) -> tuple[dict[int, list[Version]], frozenset[int]]:
        """The versions of the transactions that no process has locked, by nonce, and the nonces that others have.

        `mine` are the nonces that this process has locked; they are left out.
        """
        left, elsewhere = {}, set()
        for path in sorted(self._folder.glob(f"*{SUFFIX}")):
            nonce = int(path.stem)
            if nonce in mine:
                continue
            with _on_disk(path):
                descriptor = lock_file(path, fcntl.LOCK_SH)
            if descriptor is not None:
                try:
                    with _on_disk(path):
                        left[nonce] = _parse(path)
                finally:
                    os.close(descriptor)
            elif path.exists():
                elsewhere.add(nonce)
        return left, frozenset(elsewhere)

    def _path(self, nonce: int) -> Path:
        return self._folder / f"{nonce:012}{SUFFIX}"


def lock_file(path: Path, operation: int) -> int | None:
    """Open a file and lock it by a `flock` operation; its descriptor, None if it is missing or locked by another."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND)
    except FileNotFoundError:
        return None
    with suppress(BlockingIOError, FileNotFoundError):
        fcntl.flock(descriptor, operation | fcntl.LOCK_NB)
        # It may have been deleted and created again between opening and locking.
        if os.stat(path).st_ino == os.fstat(descriptor).st_ino:
            return descriptor
    os.close(descriptor)
    return None


@contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    """Work on the file at `path`. Raises `TransactionsNotKept` if the disk refuses."""
    try:
        yield
    except OSError as error:
        raise TransactionsNotKept(path.parent, error.strerror or str(error)) from None


def _linked(unfinished: str, path: Path) -> bool:
    """Give a complete file its name; False if the name is taken."""
    try:
        os.link(unfinished, path)
    except FileExistsError:
        return False
    return True


def _parse(path: Path) -> list[Version]:
    """The versions in a file. A last line that was cut off was not sent; the first line never is cut off."""
    versions: list[Version] = []
    with suppress(ValueError):
        for line in path.read_text(encoding="utf-8").splitlines():
            versions.append(json.loads(line))
    if not versions:
        raise TransactionDamaged(path)
    return versions
