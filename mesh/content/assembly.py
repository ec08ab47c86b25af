"""A file that comes block by block, in any order and from anybody, and is believed only by its hashes.

The source of the blocks does not matter: `Exchange` takes them from Zenoh, a bridge may take them from IPFS.
"""

from __future__ import annotations

import hashlib
import io
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Final, Self

from mesh.content.dag import BlockRef, children_of, most_blocks, node_at
from mesh.content.errors import ContentCorrupt, ContentTooLarge, StoreFull
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile
from mesh.content.index import BlockSpan
from mesh.content.reading import read_or_nothing
from mesh.content.recovery import DAMAGED_SUFFIX
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, MAX_BLOCK_SIZE, blocks_of_stream

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from mesh.content.index import BlockIndex
    from mesh.content.quota import Room
    from mesh.content.store import Store

_BATCH: Final = 128
"""Blocks entered in the index at once."""


class Assembly:
    """The file of one CID on its way into a store: `with store.assemble(cid) as assembly`.

    Start at `root`; for each place have its block (`local` first, then whoever has it), give it to `put`, and go on
    with the places it returns; when none is left, `finish`. May be used from several threads at once.

    Leaving the `with` block unfinished keeps what came, unless that can never become the file; so does a crash. The
    next assembly of that CID finds it again with `local`, and so does whoever asks this store for its blocks.
    """

    def __init__(self, store: Store, cid: str, *, index: BlockIndex, room: Room, size_limit: int) -> None:
        parse_cid(cid)
        self.cid: Final = cid
        self.root: Final = BlockRef(cid)
        self._store = store
        self._index = index
        self._room = room
        self._limit = size_limit
        self._lock = threading.Lock()
        self._spans: dict[bytes, BlockSpan] = {}
        self._placed = 0
        self._size = 0
        self._have = 0
        self._settled = False
        self._file = _part_file(store, cid)
        self._remains = self._file.size
        self._damaged = _damaged_file(store, cid)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._damaged is not None:
            self._damaged.close()
        with self._file:
            if self._settled:
                return
            if isinstance(error, ContentCorrupt | ContentTooLarge | StoreFull) or not self._file.size:
                self._file.discard()
            if self._file.is_kept:
                with suppress(StoreFull):
                    self._enter()
            else:
                self._index.forget(self._file.path.name)

    def local(self, place: BlockRef) -> bytes | None:
        """The block of a place, if it is on this disk: in this file, in another one, or left by an earlier attempt.

        Its hash was checked.
        """
        digest = parse_cid(place.cid)[2:]
        with self._lock:
            span = self._spans.get(digest)
        if span is not None:
            return span.block(self._file.read(span.length, offset=span.offset))
        return self._store.get_block(place.cid) or self._left_over(place)

    def put(self, place: BlockRef, block: bytes) -> list[BlockRef]:
        """Take the block of a place, and return the places of the blocks that it links to.

        Raises `ContentCorrupt` if these bytes do not hash to its name (see `is_block`: somebody else may have others)
        or if they do and the tree is no file's, `ContentTooLarge` and `QuotaReached`.
        """
        if not is_block(place.cid, block):
            raise ContentCorrupt(self.cid, f"the bytes of block {place.cid} hash to another name")
        return self.put_checked(place, block)

    def put_checked(self, place: BlockRef, block: bytes) -> list[BlockRef]:
        """The same for a block that was checked: one that `local` gave, or that `is_block` was asked about."""
        try:
            node = node_at(place, block)
        except ContentCorrupt as error:
            raise ContentCorrupt(self.cid, f"in block {place.cid}: {error.why}") from None
        if place.size is None:
            self._begin(node.file_size)
        span = BlockSpan.of(parse_cid(place.cid)[2:], block, data=node.data, offset=place.offset)
        self._file.write(node.data, offset=place.offset)
        with self._lock:
            self._spans.setdefault(span.digest, span)
            self._placed += 1
            self._have += len(node.data)
            if self._placed + len(node.links) > most_blocks(self._size):
                raise ContentCorrupt(self.cid, f"its tree has more than {most_blocks(self._size)} blocks")
        if node.links or len(self._spans) >= _BATCH:  # where the parts belong is worth the most after a crash
            self._enter()
        return children_of(place, node)

    def progress(self) -> tuple[int, int]:
        """Bytes of the file that were put, and its size (0 before the root is there)."""
        with self._lock:
            return self._have, self._size

    def finish(self) -> Path:
        """Put the whole file under its CID, atomically, and return where it is. Every place must have been put."""
        path = self._store.settle(self._file, self.cid, size=self._size, spans=self._spans.values())
        self._settled = True
        return path

    def _begin(self, size: int) -> None:
        """The root has come: the file will have `size` bytes, says it."""
        if size > self._limit:
            raise ContentTooLarge(self.cid, size=size, limit=self._limit)
        self._room.reserve(self._file.path.name, size)
        with self._lock:
            self._size = size

    def _enter(self) -> None:
        """Have the index know the blocks that came."""
        with self._lock:
            spans, self._spans = self._spans, {}
        self._index.add(self._file.path.name, spans.values())

    def _left_over(self, place: BlockRef) -> bytes | None:
        """A leaf of our own chunking, where it belongs: from an earlier attempt, or from a file found damaged."""
        if place.size is None or place.size > CHUNK_SIZE:
            return None
        data = b""
        if place.offset + place.size <= self._remains:
            data = self._file.read(place.size, offset=place.offset)
        block = _leaf_of(data, place)
        if block is None and self._damaged is not None:
            block = _leaf_of(read_or_nothing(self._damaged.fileno(), place.size, place.offset), place)
        return block


def is_block(cid: str, data: bytes) -> bool:
    """Whether `data` is the block that `cid` names: it hashes to it, and is no larger than any block may be."""
    return len(data) <= MAX_BLOCK_SIZE and hashlib.sha256(data).digest() == parse_cid(cid)[2:]


def _leaf_of(data: bytes, place: BlockRef) -> bytes | None:
    """The leaf around these bytes of a file, if it is the block of that place."""
    if len(data) != place.size:
        return None
    block = next(iter(blocks_of_stream(io.BytesIO(data))))
    return block.data if block.cid == place.cid else None


def _part_file(store: Store, cid: str) -> TemporaryFile:
    """The remains of the last attempt at this CID or, when somebody else is at it, a file of our own."""
    part = TemporaryFile.take(store.directory / f"{PART_PREFIX}{cid}")
    if part is None:
        return TemporaryFile.create(store.directory, PUT_PREFIX)
    part.keep()
    return part


def _damaged_file(store: Store, cid: str) -> BinaryIO | None:
    """The file that was set aside under this CID, if one was: most of its blocks may be good."""
    try:
        return (store.directory / f"{cid}{DAMAGED_SUFFIX}").open("rb", buffering=0)
    except FileNotFoundError:
        return None
