"""The directory of a store: which files it holds, their pins and sizes, and how a finished file gets into it."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from mesh.content.errors import ContentPinned, ContentUnavailable
from mesh.content.files import directory_lock, stamp, sync_directory
from mesh.content.quota import EvictionReport, Pins, Quota
from mesh.content.recovery import DAMAGED_SUFFIX, is_cid, open_directory
from mesh.errors import ConfigurationError
from mesh.private_files import make_private_folder
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mesh.content.files import TemporaryFile
    from mesh.content.index import BlockSpan

USER: Final = "user"
"""Label of the pins that people set."""


@dataclass(frozen=True, kw_only=True)
class StoreEntry:
    """A file of a store. `used` is when it was last read, served or put (Unix time, seconds)."""

    cid: str
    size: int
    used: float
    pins: frozenset[str]
    """The labels of its pins."""


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How much a store holds. `bytes` includes what is being written or fetched, or was set aside as damaged."""

    files: int
    bytes: int
    pinned_bytes: int
    quota: int | None
    """None if there is no limit."""


class StoreDirectory:
    """What a store does without reading the files themselves: `Store` adds that."""

    def __init__(self, path: str | Path, *, quota: int | None) -> None:
        self.directory: Final = Path(path)
        try:
            make_private_folder(self.directory)
            self._pins = Pins(self.directory)
            self._index, self._in_use = open_directory(self.directory)
        except OSError as error:
            raise ConfigurationError(
                f"can't keep files in {self.directory}: {error.strerror}", hint="choose a writable directory"
            ) from error
        self._quota = Quota(self.directory, self._index, self._pins, limit=quota)
        self._open = True
        self._lock = threading.Lock()
        self._checked: dict[str, tuple[int, ...]] = {}
        """The stamps of files whose bytes were hashed, or written, by this process."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the index. Safe to call twice; paths and open files stay valid."""
        self._index.close()
        if self._open:
            self._open = False
            os.close(self._in_use)

    def has(self, cid: str) -> bool:
        """Whether the file is held (unchecked). Raises `InvalidCid`."""
        return self.path(cid) is not None

    def path(self, cid: str) -> Path | None:
        """Where the file is, if it is held. Its bytes are not checked: see `Store.checked`. Raises `InvalidCid`."""
        path = self._path(cid)
        return path if path.is_file() else None

    def list(self) -> tuple[str, ...]:
        """The CIDs of all files held, sorted."""
        return tuple(sorted(name for name in os.listdir(self.directory) if is_cid(name)))

    def entries(self) -> tuple[StoreEntry, ...]:
        """All files held, in the order of eviction: the least recently used first."""
        held, pins = frozenset(self.list()), self._pins.by_cid()
        return tuple(
            StoreEntry(cid=file.name, size=file.size, used=file.used_ns / 1e9, pins=pins.get(file.name, frozenset()))
            for file in self._index.files()
            if file.name in held
        )

    def usage(self) -> Usage:
        """How much is held, and the quota."""
        pins, files = self._pins.by_cid(), self._index.files()
        return Usage(
            files=sum(is_cid(file.name) for file in files),
            bytes=sum(file.size for file in files),
            pinned_bytes=sum(file.size for file in files if file.name in pins),
            quota=self._quota.limit,
        )

    def damaged(self) -> tuple[str, ...]:
        """The CIDs of files that were set aside as damaged and have not been replaced yet, sorted."""
        names = os.listdir(self.directory)
        cids = (name.removesuffix(DAMAGED_SUFFIX) for name in names if name.endswith(DAMAGED_SUFFIX))
        return tuple(sorted(cid for cid in cids if is_cid(cid)))

    def pin(self, cid: str, label: str = USER, *, sync: bool = True) -> None:
        """Protect the file from eviction, now or once it is held, until the pin of that label is removed.

        Without `sync`, a power loss may remove the pin.

        Raises `InvalidCid`, and `InputError` unless the label is 1 to 64 letters, digits, `_` and `-`.
        """
        with directory_lock(self.directory):
            self._pins.add(cid, label, sync=sync)

    def unpin(self, cid: str, label: str = USER) -> None:
        """Remove the pin of one label, if there is one; a power loss may bring it back. Raises as `pin` does."""
        self._pins.drop(cid, label)

    def release(self, label: str) -> None:
        """Remove all pins of a label, whatever file they protect; a power loss may bring them back.

        Raises `InputError` if it is not a valid label.
        """
        self._pins.release(label)

    def pins(self) -> Mapping[str, frozenset[str]]:
        """All pinned CIDs, held or not, each with the labels of its pins."""
        return self._pins.by_cid()

    def remove(self, cid: str) -> None:
        """Delete a file, and any damaged one that was set aside under its name.

        Raises `InvalidCid`, `ContentUnavailable` if it is not held, and `ContentPinned`.
        """
        path = self._path(cid)
        aside = path.with_name(f"{cid}{DAMAGED_SUFFIX}")
        with directory_lock(self.directory):
            labels = self._pins.by_cid().get(cid)
            if labels:
                raise ContentPinned(cid, labels)
            found = [name for name in (path, aside) if name.exists()]
            for name in found:
                name.unlink()
                self._index.forget(name.name)
        if not found:
            raise ContentUnavailable(cid, "it is not in this store")

    def collect(self, quota: int | None = None) -> EvictionReport:
        """Evict until all files together are within `quota` bytes; without one, the store's own.

        Damaged files go first, then the least recently used; pinned ones stay. With neither quota, nothing is evicted.
        """
        limit = self._quota.limit if quota is None else quota
        return EvictionReport(cids=(), bytes=0) if limit is None else self._quota.collect(limit)

    def settle(
        self,
        temporary: TemporaryFile,
        cid: str,
        *,
        size: int,
        spans: Iterable[BlockSpan] = (),
        pin: str | None = None,
        sync: bool = True,
    ) -> Path:
        """Rename a complete file to its CID, and index the blocks that are not yet indexed. It counts as checked."""
        path, name = self._path(cid), temporary.path.name
        aside = path.with_name(f"{cid}{DAMAGED_SUFFIX}")
        self._index.add(name, spans, size=size)
        temporary.finish(size, sync=sync)
        with directory_lock(self.directory):
            if pin is not None:
                self._pins.add(cid, pin)
            self._index.rename(name, cid)
            temporary.rename(path)
            aside.unlink(missing_ok=True)
            self._index.forget(aside.name)
            seen = stamp(path)
        if sync:
            sync_directory(self.directory)
        with self._lock:
            self._checked[cid] = seen
        return path

    def _path(self, cid: str) -> Path:
        parse_cid(cid)
        return self.directory / cid
