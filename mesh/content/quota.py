"""Keeping all files together within the store's quota: the least recently used go first, pinned ones never."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from mesh.content.errors import QuotaReached
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, directory_lock, is_taken
from mesh.content.holdings import EvictionReport
from mesh.content.recovery import DAMAGED_SUFFIX, clear_remains

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.content.index import BlockIndex, IndexedFile
    from mesh.content.pins import Pins

log = logging.getLogger(__name__)

_AHEAD: Final = 8 << 20
"""Bytes reserved beyond what is needed at once, while there is room for them anyway."""


class Room:
    """The room of one directory: `quota` bytes for all its files, or as much as the disk has if it is None.

    What is being written counts from the moment it is reserved, so that several writers (and processes) together
    stay within the quota.
    """

    def __init__(self, directory: Path, index: BlockIndex, pins: Pins, *, quota: int | None) -> None:
        self.quota: Final = quota
        self._directory = directory
        self._index = index
        self._pins = pins

    def reserve(self, name: str, size: int) -> None:
        """Have room for `size` bytes, in all, of the file that is being written under `name`.

        Deletes what is needed. Raises `QuotaReached` if deleting all that may be would not do; then nothing is deleted.
        """
        if not self._index.reserve(name, size, quota=self.quota):
            return
        with directory_lock(self._directory):
            clear_remains(self._directory, self._index)
            while missing := self._index.reserve(name, size, quota=self.quota):
                self._delete(self._chosen(missing))

    def reserve_ahead(self, name: str, size: int) -> int:
        """Have room for `size` bytes, and for some more unless files would have to go for these; for how many."""
        if not self._index.reserve(name, size + _AHEAD, quota=self.quota):
            return size + _AHEAD
        self.reserve(name, size)
        return size

    def collect(self, quota: int) -> EvictionReport:
        """Delete until all files together are within `quota` bytes, or only what must stay is left."""
        with directory_lock(self._directory):
            clear_remains(self._directory, self._index)
            excess = sum(file.size for file in self._index.files()) - quota
            chosen: list[IndexedFile] = []
            for file in self._deletable():
                if excess <= 0:
                    break
                chosen.append(file)
                excess -= file.size
            self._delete(chosen)
        cids = tuple(file.name for file in chosen if not _is_remains(file.name))
        return EvictionReport(cids=cids, bytes=sum(file.size for file in chosen))

    def _chosen(self, missing: int) -> list[IndexedFile]:
        """Enough to be deleted to have `missing` bytes more. Raises `QuotaReached`."""
        assert self.quota is not None
        chosen: list[IndexedFile] = []
        for file in self._deletable():
            chosen.append(file)
            missing -= file.size
            if missing <= 0:
                return chosen
        kept = sum(file.size for file in self._index.files()) - sum(file.size for file in chosen)
        raise QuotaReached(self._directory, missing=missing, quota=self.quota, kept=kept)

    def _deletable(self) -> Iterator[IndexedFile]:
        """What may be deleted, in the order in which it should be: what was set aside, then by last use."""
        pinned = self._pins.by_cid()
        for file in self._index.files():
            partly = file.name.startswith(PART_PREFIX)
            if file.name.startswith(PUT_PREFIX) or file.name.removeprefix(PART_PREFIX) in pinned:
                continue
            if not (partly and is_taken(self._directory / file.name)):
                yield file

    def _delete(self, files: Iterable[IndexedFile]) -> None:
        for file in files:
            path = self._directory / file.name
            if file.name.startswith(PART_PREFIX):
                remains = TemporaryFile.take(path)
                if remains is None:
                    continue
                with remains:
                    self._index.forget(file.name)
            else:
                path.unlink(missing_ok=True)
                self._index.forget(file.name)
            log.info("deleted %s, %d bytes, to make room", file.name, file.size)


def _is_remains(name: str) -> bool:
    return name.startswith(PART_PREFIX) or name.endswith(DAMAGED_SUFFIX)
