"""Why a file behind a CID can't be had, and why the store can't take one, or let go of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, ContentError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class ContentUnavailable(ContentError):
    """Nobody who was asked has the file, or a block of it."""

    code = "content-unavailable"

    def __init__(self, cid: str, why: str) -> None:
        super().__init__(
            f"{cid} is not to be had: {why}", hint="check the name, and that whoever has the file is on the network"
        )
        self.cid = cid
        self.why = why


class ContentTooLarge(ContentError):
    """A file is larger than what the caller, or the store, takes. Sizes are in bytes."""

    code = "content-too-large"

    def __init__(self, cid: str, *, size: int, limit: int) -> None:
        super().__init__(
            f"{cid or 'the file'} is of {size} bytes at least, more than the {limit} allowed",
            hint="raise the limit, or have the file made smaller",
        )
        self.cid = cid
        self.size = size
        self.limit = limit


class ContentCorrupt(ContentError):
    """Bytes were offered, or kept, under a CID that they do not hash to, or that name no file.

    `holders` are the Zenoh ids of those who offered them (empty when the bytes were our own, or came from elsewhere).
    """

    code = "content-corrupt"

    def __init__(self, cid: str, why: str, *, holders: Iterable[str] = ()) -> None:
        self.holders = tuple(holders)
        offered = f" (offered by {', '.join(self.holders)})" if self.holders else ""
        super().__init__(f"{cid} is corrupt: {why}{offered}", hint="fetch it again, from another holder")
        self.cid = cid
        self.why = why


class ContentPinned(AiraError):
    """A file was to be removed that is pinned; `labels` say what for."""

    code = "content-pinned"

    def __init__(self, cid: str, labels: Iterable[str]) -> None:
        self.labels = tuple(sorted(labels))
        super().__init__(f"{cid} is pinned ({', '.join(self.labels)})", hint="unpin it first")
        self.cid = cid


class StoreFull(AiraError):
    """The store has no room for a file: the disk under it is full, or its own quota is reached."""

    code = "store-full"

    def __init__(self, path: Path, *, why: str = "", hint: str = "") -> None:
        super().__init__(
            why or f"no room left on the disk of {path}", hint=hint or "free some space, or move the store elsewhere"
        )
        self.path = path


class QuotaReached(StoreFull):
    """All files together would be over the store's quota, `missing` bytes even if all that may be deleted were.

    `kept` bytes may not be: they are pinned, or being written.
    """

    code = "quota-reached"

    def __init__(self, path: Path, *, missing: int, quota: int, kept: int) -> None:
        super().__init__(
            path,
            why=f"no room in the store {path}: {missing} bytes too many for its {quota}, of which {kept} are in use",
            hint="raise content_limit, or unpin or remove files",
        )
        self.missing = missing
        self.quota = quota
        self.kept = kept


class StoreDamaged(AiraError):
    """The store's own books can't be read or written. The files themselves may be whole."""

    code = "store-damaged"

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(
            f"the store {path} is damaged: {why}",
            hint="stop all that use it, then open it again: what it knows of its files is found out anew",
        )
        self.path = path
        self.why = why


__all__ = [
    "ContentCorrupt",
    "ContentPinned",
    "ContentTooLarge",
    "ContentUnavailable",
    "QuotaReached",
    "StoreDamaged",
    "StoreFull",
]
