"""Errors of the content store and of fetching files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import AiraError, ContentError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class ContentUnavailable(ContentError, code="content-unavailable"):
    """None of the sources asked has the file, or one of its blocks."""

    def __init__(self, cid: str, why: str) -> None:
        super().__init__(
            f"{cid} is not available: {why}", hint="check the CID, and that a machine with the file is on the network"
        )
        self.cid = cid
        self.why = why


class ContentTooLarge(ContentError, code="content-too-large"):
    """A file is larger than the caller, or the store, allows. Sizes are in bytes."""

    def __init__(self, cid: str, *, size: int, limit: int) -> None:
        super().__init__(
            f"{cid or 'the file'} is at least {size} bytes, more than the {limit} allowed",
            hint="raise the limit, or use a smaller file",
        )
        self.cid = cid
        self.size = size
        self.limit = limit


class ContentCorrupt(ContentError, code="content-corrupt"):
    """Bytes do not have the hash that their CID says, or are not a file.

    `reason` is machine-readable: `wrong-hash` or, for blocks with the right hash, `not-a-file`, `wrong-size`,
    `empty-part`, `oversized-block`, `too-deep`, `too-many-blocks`, `not-indexed`. `holders` are the Zenoh ids of the
    sessions that sent them (empty if they came from our disk, or from elsewhere).
    """

    def __init__(self, cid: str, why: str, *, reason: str = "wrong-hash", holders: Iterable[str] = ()) -> None:
        self.holders = tuple(holders)
        senders = f" (sent by {', '.join(self.holders)})" if self.holders else ""
        super().__init__(f"{cid} is corrupt: {why}{senders}", hint="fetch it again from another holder")
        self.cid = cid
        self.why = why
        self.reason = reason


class StoreFull(AiraError, code="store-full"):
    """The store has no space for a file: its disk is full.

    Or its quota is reached (`quota-reached`), even after evicting all that may be evicted.
    """

    def __init__(self, path: Path, *, why: str = "", hint: str = "", code: str = "") -> None:
        hint = hint or "free some space, or move the store to another disk"
        super().__init__(why or f"the disk of {path} is full", hint=hint, code=code)
        self.path = path
