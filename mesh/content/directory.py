"""What one directory holds, for whose sake, and how much of it there may be."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from mesh.content.errors import ContentPinned, ContentUnavailable
from mesh.content.files import directory_lock
from mesh.content.holdings import EvictionReport, StoreEntry, Usage
from mesh.content.pins import Pins
from mesh.content.quota import Room
from mesh.content.recovery import DAMAGED_SUFFIX, damaged_in, held_in, is_cid, open_directory
from mesh.errors import ConfigurationError
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

USER: Final = "user"
"""Label of the pins that people set."""


class Shelf:
    """The directory of a store: a list of files with their pins and a quota. See `Store`, which also fills it."""

    def __init__(self, path: str | Path, *, quota: int | None) -> None:
        self.directory: Final = Path(path)
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._pins = Pins(self.directory)
            self._index, self._in_use = open_directory(self.directory)
        except OSError as error:
            raise ConfigurationError(
                f"can't keep files in {self.directory}: {error.strerror}", hint="name a directory that can be written"
            ) from error
        self._room = Room(self.directory, self._index, self._pins, quota=quota)
        self._open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the index. Safe to call twice; paths and open files stay good."""
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
        return held_in(self.directory)

    def entries(self) -> tuple[StoreEntry, ...]:
        """All files held, the least recently used first: the order in which they are deleted to make room."""
        held, pins = frozenset(self.list()), self._pins.by_cid()
        return tuple(
            StoreEntry(cid=file.name, size=file.size, used=file.used_ns / 1e9, pins=pins.get(file.name, frozenset()))
            for file in self._index.files()
            if file.name in held
        )

    def usage(self) -> Usage:
        """How much is held, and how much may be."""
        pins, files = self._pins.by_cid(), self._index.files()
        return Usage(
            files=sum(is_cid(file.name) for file in files),
            bytes=sum(file.size for file in files),
            pinned_bytes=sum(file.size for file in files if file.name in pins),
            quota=self._room.quota,
        )

    def damaged(self) -> tuple[str, ...]:
        """The CIDs of files that were found damaged and set aside, and that are not held again yet; sorted."""
        return damaged_in(self.directory)

    def pin(self, cid: str, label: str = USER) -> None:
        """Keep the file from being deleted, from now on or from when it comes, until that label's pin is dropped.

        Raises `InvalidCid`, and `InputError` for a label with other characters than letters, digits, `_` and `-`.
        """
        with directory_lock(self.directory):
            self._pins.add(cid, label)

    def unpin(self, cid: str, label: str = USER) -> None:
        """Drop one label's pin; nothing happens when there is none. Raises as `pin` does."""
        self._pins.drop(cid, label)

    def release(self, label: str) -> None:
        """Drop all pins of a label, whatever they are on. Raises `InputError` if it can't be one."""
        self._pins.release(label)

    def pins(self) -> Mapping[str, frozenset[str]]:
        """All CIDs that are pinned, held or not, each with the labels of its pins."""
        return self._pins.by_cid()

    def remove(self, cid: str) -> None:
        """Delete a file, and what was set aside under its name.

        Raises `InvalidCid`, `ContentUnavailable` when it is not held, and `ContentPinned`.
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
        """Delete what was set aside and then the least recently used files, never a pinned one, until all together
        are within `quota` bytes (the store's own if not given; without either, nothing)."""
        allowed = self._room.quota if quota is None else quota
        return EvictionReport(cids=(), bytes=0) if allowed is None else self._room.collect(allowed)

    def _path(self, cid: str) -> Path:
        parse_cid(cid)
        return self.directory / cid
