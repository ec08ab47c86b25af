"""Why a file behind a CID can't be had, and why the store can't take one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, ContentError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class ContentUnavailable(ContentError):
    """Nobody who was asked has the file, or a block of it."""

    def __init__(self, cid: str, why: str) -> None:
        super().__init__(
            f"{cid} is not to be had: {why}", hint="check the name, and that whoever has the file is on the network"
        )
        self.cid = cid
        self.why = why


class ContentTooLarge(ContentError):
    """A file is larger than what the caller, or the store, takes. Sizes are in bytes."""

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

    def __init__(self, cid: str, why: str, *, holders: Iterable[str] = ()) -> None:
        self.holders = tuple(holders)
        offered = f" (offered by {', '.join(self.holders)})" if self.holders else ""
        super().__init__(f"{cid} is corrupt: {why}{offered}", hint="fetch it again, from another holder")
        self.cid = cid
        self.why = why


class StoreFull(AiraError):
    """The disk under the store has no room left."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"no room left on the disk of {path}", hint="free some space, or move the store elsewhere")
        self.path = path


__all__ = ["ContentCorrupt", "ContentTooLarge", "ContentUnavailable", "StoreFull"]
