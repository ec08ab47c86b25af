"""Sent transactions on disk: a file for each number of an account, held by the process that waits for it.

A file's name is the number; making it is what reserves the number among all processes of the account. It is locked
(flock) as long as its process lives and waits, so that what a process left behind can be told from what another one
is busy with. Each line is one version of the transaction, written before it is sent.
"""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.accounts import SignedTransaction
from mesh.chain.pending import Pending
from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

SUFFIX: Final = ".jsonl"
UNFINISHED: Final = ".new"
LOCK_ATTEMPTS: Final = 5
LOCK_PAUSE: Final = 0.01
"""Seconds between two attempts to lock an entry."""


class LockedEntry:
    """One entry that this process has locked. All of it blocks for the time of a disk write."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor = descriptor

    def append(self, entry: Pending) -> None:
        """Add the entry's newest version."""
        with _on_disk(self._path):
            # What was cut off, by a crash or a full disk, would make one unreadable line with the next.
            end = os.pread(self._descriptor, os.fstat(self._descriptor).st_size, 0).rfind(b"\n") + 1
            os.ftruncate(self._descriptor, end)
            os.lseek(self._descriptor, end, os.SEEK_SET)
            left = memoryview(_line(entry))
            while left:  # a disk that is nearly full takes a part
                left = left[os.write(self._descriptor, left) :]
            os.fsync(self._descriptor)

    def release(self) -> None:
        """Leave the entry to whoever takes it up."""
        os.close(self._descriptor)

    def remove(self) -> None:
        """End the entry."""
        try:
            with _on_disk(self._path):
                self._path.unlink(missing_ok=True)
        finally:
            os.close(self._descriptor)


class TransactionStore:
    """The folder of an account's entries on one chain. Raises `ConfigurationError` where it can't be written.

    Not for network file systems, whose locks may not be seen by others.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with _on_disk(folder / "x"):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)

    def add(self, entry: Pending) -> LockedEntry | None:
        """Make the entry of a number and hold it; None if the number has one."""
        path = self._path(entry.nonce)
        with _on_disk(path):
            descriptor, unfinished = tempfile.mkstemp(suffix=UNFINISHED, dir=self._folder)
        hold = LockedEntry(path, descriptor)
        try:
            hold.append(entry)
            with _on_disk(path):
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                # The entry is whole and locked before others can see it.
                if not _linked(unfinished, path):
                    hold.release()
                    return None
        except BaseException:
            hold.release()
            raise
        finally:
            with suppress(OSError):  # what was in the way is told already
                os.unlink(unfinished)
        return hold

    def hold(self, entry: Pending) -> LockedEntry | None:
        """LockedEntry the entry that a number has; None if there is none, or another process holds it."""
        path = self._path(entry.nonce)
        for attempt in range(LOCK_ATTEMPTS):
            with _on_disk(path):
                descriptor = _locked(path, fcntl.LOCK_EX)
            if descriptor is not None:
                return LockedEntry(path, descriptor)
            if attempt and not path.exists():
                break
            # A reader has it for a moment only.
            time.sleep(LOCK_PAUSE)
        return None

    def read(self, mine: Collection[int]) -> tuple[list[Pending], frozenset[int]]:
        """What nobody holds, and the numbers that other processes hold; `mine` are this one's, and left out."""
        left, elsewhere = [], set()
        for path in sorted(self._folder.glob(f"*{SUFFIX}")):
            nonce = int(path.stem)
            if nonce in mine:
                continue
            with _on_disk(path):
                descriptor = _locked(path, fcntl.LOCK_SH)
            if descriptor is not None:
                try:
                    with _on_disk(path):
                        left.append(_parse(nonce, path))
                finally:
                    os.close(descriptor)
            elif path.exists():
                elsewhere.add(nonce)
        return left, frozenset(elsewhere)

    def _path(self, nonce: int) -> Path:
        return self._folder / f"{nonce:012}{SUFFIX}"


@contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    """Work on the entry at `path`. Raises `ConfigurationError` where the disk does not let it."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"can't keep sent transactions in {path.parent}: {error.strerror}",
            hint="make room on that disk, let this user write there, or name another folder with --data-dir",
        ) from None


def _linked(unfinished: str, path: Path) -> bool:
    """Give a whole entry its name; False when there is one of that name."""
    try:
        os.link(unfinished, path)
    except FileExistsError:
        return False
    return True


def _line(entry: Pending) -> bytes:
    signed = entry.versions[-1]
    fields = entry.fields | {"to": entry.fields["to"] or ""}
    held = {"sentAt": entry.sent_at, "hash": signed.hash, "raw": signed.raw.hex(), "fields": fields}
    return json.dumps(held).encode() + b"\n"


def _parse(nonce: int, path: Path) -> Pending:
    """The entry in a file. A last line that was cut off was not sent yet; the first one never is."""
    lines: list[dict[str, Any]] = []
    with suppress(ValueError):
        for line in path.read_text(encoding="utf-8").splitlines():
            lines.append(json.loads(line))
    if not lines:
        raise ConfigurationError(f"{path} holds no sent transaction", hint="it is damaged; move it away")
    fields = lines[-1]["fields"] | {"to": lines[-1]["fields"]["to"] or b""}
    versions = [SignedTransaction(raw=bytes.fromhex(line["raw"]), hash=line["hash"]) for line in lines]
    return Pending(nonce=nonce, fields=fields, versions=versions, sent_at=lines[0]["sentAt"], is_watched=False)


def _locked(path: Path, how: int) -> int | None:
    """The opened and locked file; None if there is none, or somebody has it."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND)
    except FileNotFoundError:
        return None
    with suppress(BlockingIOError, FileNotFoundError):
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
        # It may have been ended, and made again, between the opening and the lock.
        if os.stat(path).st_ino == os.fstat(descriptor).st_ino:
            return descriptor
    os.close(descriptor)
    return None
