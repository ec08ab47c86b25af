"""The quota of a store, and the pins that protect files from it.

The least recently used files are evicted first, pinned ones never.
"""

from __future__ import annotations

import io
import logging
import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.content.errors import ContentTooLarge, QuotaReached
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, directory_lock, is_locked, sync_directory
from mesh.content.recovery import DAMAGED_SUFFIX, delete_leftovers
from mesh.errors import InputError
from mesh.log_context import log_event
from mesh.private_files import PRIVATE_FILE, PRIVATE_FOLDER
from schemas.cid import CID_LENGTH, parse_cid

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from mesh.content.files import Readable
    from mesh.content.index import BlockIndex, IndexedFile

log = logging.getLogger(__name__)

_AHEAD: Final = 8 << 20
"""Bytes reserved beyond what is needed now, if that evicts nothing."""
_LABEL: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True, kw_only=True)
class EvictionReport:
    """What was deleted to free space: the files, and all bytes (which include the remains of broken fetches)."""

    cids: tuple[str, ...]
    bytes: int


class Pins:
    """The pins of one store's directory, each a CID and a label; several processes may set and remove them.

    A pin is an empty file, so that it survives the loss of the index, and any crash. One that was removed may come back
    after a power loss: then it is removed once more. Deleting files requires the directory's lock; so does pinning a
    file that exists.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory / ".pins"
        self._directory.mkdir(mode=PRIVATE_FOLDER, exist_ok=True)
        sync_directory(directory)

    def add(self, cid: str, label: str, *, sync: bool = True) -> None:
        """Pin a CID, whether or not the file is held yet. Raises `InvalidCid`, and `InputError` for the label."""
        self._path(cid, label).touch(mode=PRIVATE_FILE)
        if sync:
            sync_directory(self._directory)

    def drop(self, cid: str, label: str) -> None:
        """Remove one pin, if it exists. Raises as `add` does."""
        self._path(cid, label).unlink(missing_ok=True)

    def release(self, label: str) -> None:
        """Remove all pins of a label. Raises `InputError` if it is not a valid label."""
        check_label(label)
        for cid, labels in self.by_cid().items():
            if label in labels:
                self._path(cid, label).unlink(missing_ok=True)

    def by_cid(self) -> Mapping[str, frozenset[str]]:
        """All pinned CIDs, each with its labels."""
        found: dict[str, set[str]] = {}
        for name in os.listdir(self._directory):
            found.setdefault(name[:CID_LENGTH], set()).add(name[CID_LENGTH + 1 :])
        return {cid: frozenset(labels) for cid, labels in sorted(found.items())}

    def _path(self, cid: str, label: str) -> Path:
        parse_cid(cid)
        return self._directory / f"{cid}.{check_label(label)}"


def check_label(label: str) -> str:
    """The same label. Raises `InputError` unless it is 1 to 64 letters, digits, `_` and `-`."""
    if not _LABEL.fullmatch(label):
        raise InputError(f"{label[:80]!r} is not a label for a pin: use 1 to 64 letters, digits, _ and -")
    return label


class Quota:
    """The space of one directory: `limit` bytes for all its files, or as much as the disk has if it is None.

    A file that is being written counts from the moment its size is reserved, so that several writers (and processes)
    together stay within the quota.
    """

    def __init__(self, directory: Path, index: BlockIndex, pins: Pins, *, limit: int | None) -> None:
        self.limit: Final = limit
        self._directory = directory
        self._index = index
        self._pins = pins

    def reserve(self, name: str, size: int) -> None:
        """Reserve `size` bytes in all for the file that is being written under `name`, evicting others if necessary.

        Raises `QuotaReached` if evicting everything that may be evicted would not suffice; then nothing is evicted.
        """
        if not self._index.reserve(name, size, quota=self.limit):
            return
        with directory_lock(self._directory):
            delete_leftovers(self._directory, self._index)
            while missing := self._index.reserve(name, size, quota=self.limit):
                self._delete(self._candidates_for(missing))

    def reserve_ahead(self, name: str, size: int) -> int:
        """Reserve `size` bytes, and some more if that evicts nothing. Returns how many were reserved."""
        if not self._index.reserve(name, size + _AHEAD, quota=self.limit):
            return size + _AHEAD
        self.reserve(name, size)
        return size

    def collect(self, limit: int) -> EvictionReport:
        """Evict until all files together are within `limit` bytes, or nothing more may be evicted."""
        with directory_lock(self._directory):
            delete_leftovers(self._directory, self._index)
            excess = sum(file.size for file in self._index.files()) - limit
            chosen: list[IndexedFile] = []
            for file in self._candidates():
                if excess <= 0:
                    break
                chosen.append(file)
                excess -= file.size
            self._delete(chosen)
        cids = tuple(file.name for file in chosen if not _is_leftover(file.name))
        return EvictionReport(cids=cids, bytes=sum(file.size for file in chosen))

    def _candidates_for(self, missing: int) -> list[IndexedFile]:
        """Enough files to free `missing` bytes. Raises `QuotaReached`."""
        assert self.limit is not None
        chosen: list[IndexedFile] = []
        for file in self._candidates():
            chosen.append(file)
            missing -= file.size
            if missing <= 0:
                return chosen
        kept = sum(file.size for file in self._index.files()) - sum(file.size for file in chosen)
        raise QuotaReached(self._directory, missing=missing, quota=self.limit, kept=kept)

    def _candidates(self) -> Iterator[IndexedFile]:
        """The files that may be evicted, in the order of eviction: damaged ones, then the least recently used."""
        pinned = self._pins.by_cid()
        for file in sorted(self._index.files(), key=lambda file: not file.name.endswith(DAMAGED_SUFFIX)):
            if file.name.startswith(PUT_PREFIX) or file.name.removeprefix(PART_PREFIX) in pinned:
                continue
            if not (file.name.startswith(PART_PREFIX) and is_locked(self._directory / file.name)):
                yield file

    def _delete(self, files: Iterable[IndexedFile]) -> None:
        for file in files:
            path = self._directory / file.name
            if file.name.startswith(PART_PREFIX):
                leftover = TemporaryFile.take(path)
                if leftover is None:
                    continue
                with leftover:
                    self._index.forget(file.name)
            else:
                path.unlink(missing_ok=True)
                self._index.forget(file.name)
            event = log_event("content-evicted", name=file.name, bytes=file.size)
            log.info("evicted %s, %d bytes, to free space", file.name, file.size, extra=event)


class CopyingStream(io.RawIOBase):
    """A stream whose bytes are written to `copy` as they are read, within the quota.

    Reading raises `ContentTooLarge` over `limit` bytes, `QuotaReached` and `StoreFull`, before it writes any of the
    bytes that are too many.
    """

    def __init__(self, stream: Readable, copy: TemporaryFile, quota: Quota, *, limit: int) -> None:
        self._stream = stream
        self._copy = copy
        self._quota = quota
        self._limit = limit
        self._reserved = 0
        self._done = 0

    def expect(self, size: int) -> None:
        """Reserve `size` bytes before any is read. Raises as reading does."""
        if size > self._limit:
            raise ContentTooLarge("", size=size, limit=self._limit)
        self._quota.reserve(self._copy.path.name, size)
        self._reserved = size

    def readable(self) -> bool:
        """Always."""
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer from the underlying stream, after writing the same bytes to the file."""
        data = self._stream.read(len(buffer))
        done = self._done + len(data)
        if done > self._limit:
            raise ContentTooLarge("", size=done, limit=self._limit)
        if done > self._reserved:
            self._reserved = self._quota.reserve_ahead(self._copy.path.name, done)
        self._copy.write(data, offset=self._done)
        buffer[: len(data)] = data
        self._done = done
        return len(data)


def _is_leftover(name: str) -> bool:
    return name.startswith(PART_PREFIX) or name.endswith(DAMAGED_SUFFIX)
