"""A file that comes block by block, in any order and from anybody, and is believed only by its hashes.

The source of the blocks does not matter: `Exchange` takes them from Zenoh, a bridge may take them from IPFS.
"""

from __future__ import annotations

import hashlib
import io
import threading
from typing import TYPE_CHECKING, Final, Self

from mesh.content.dag import MAX_BLOCKS, Place, children_of, node_at
from mesh.content.errors import ContentCorrupt, ContentTooLarge
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile
from mesh.content.index import Span
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, MAX_BLOCK_SIZE, blocks_of_stream

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from mesh.content.store import Store


class Assembly:
    """The file of one CID on its way into a store: `with store.assemble(cid) as assembly`.

    Start at `root`; for each place have its block (`local` first, then whoever has it), give it to `put`, and go on
    with the places it returns; when none is left, `finish`. May be used from several threads at once.

    Leaving the `with` block unfinished keeps what came; the next assembly of that CID finds it again with `local`.
    """

    def __init__(self, store: Store, cid: str, *, size_limit: int) -> None:
        parse_cid(cid)
        self.cid: Final = cid
        self.root: Final = Place(cid)
        self._store = store
        self._limit = size_limit
        self._lock = threading.Lock()
        self._spans: dict[bytes, Span] = {}
        self._placed = 0
        self._size = 0
        self._file = _part_file(store, cid)
        self._remains = self._file.size

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.__exit__(kind, error, trace)

    def local(self, place: Place) -> bytes | None:
        """The block of a place, if it is on this disk: in this file, in another one, or left by an earlier attempt."""
        digest = parse_cid(place.cid)[2:]
        with self._lock:
            span = self._spans.get(digest)
        if span is not None:
            return span.block(self._file.read(span.length, offset=span.offset))
        return self._store.get_block(place.cid) or self._left_over(place)

    def put(self, place: Place, block: bytes) -> list[Place]:
        """Take the block of a place, and return the places of the blocks that it links to.

        Raises `ContentCorrupt` if these bytes do not hash to its name (see `is_block`: somebody else may have others)
        or if they do and the tree is no file's, and `ContentTooLarge`.
        """
        digest = parse_cid(place.cid)[2:]
        if not is_block(place.cid, block):
            raise ContentCorrupt(self.cid, f"the bytes of block {place.cid} hash to another name")
        try:
            node = node_at(place, block)
        except ContentCorrupt as error:
            raise ContentCorrupt(self.cid, f"in block {place.cid}: {error.why}") from None
        if place.size is None and node.file_size > self._limit:
            raise ContentTooLarge(self.cid, size=node.file_size, limit=self._limit)
        span = Span.of(digest, block, data=node.data, offset=place.offset)
        self._file.write(node.data, offset=place.offset)
        with self._lock:
            self._spans.setdefault(digest, span)
            self._placed += 1
            self._size = node.file_size if place.size is None else self._size
            if self._placed + len(node.links) > MAX_BLOCKS:
                raise ContentCorrupt(self.cid, f"its tree has more than {MAX_BLOCKS} blocks")
        return children_of(place, node)

    def finish(self) -> Path:
        """Put the whole file under its CID, atomically, and return where it is. Every place must have been put."""
        return self._store.settle(self._file, self.cid, size=self._size, spans=self._spans.values())

    def _left_over(self, place: Place) -> bytes | None:
        """A leaf of our own chunking that an earlier attempt wrote where it belongs."""
        if place.size is None or place.size > CHUNK_SIZE or place.offset + place.size > self._remains:
            return None
        data = self._file.read(place.size, offset=place.offset)
        block = next(iter(blocks_of_stream(io.BytesIO(data))))
        return block.data if block.cid == place.cid else None


def is_block(cid: str, data: bytes) -> bool:
    """Whether `data` is the block that `cid` names: it hashes to it, and is no larger than any block may be."""
    return len(data) <= MAX_BLOCK_SIZE and hashlib.sha256(data).digest() == parse_cid(cid)[2:]


def _part_file(store: Store, cid: str) -> TemporaryFile:
    """The remains of the last attempt at this CID or, when somebody else is at it, a file of our own."""
    part = TemporaryFile.take(store.directory / f"{PART_PREFIX}{cid}")
    if part is None:
        return TemporaryFile.create(store.directory, PUT_PREFIX)
    part.keep()
    return part
