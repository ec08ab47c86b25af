"""A file that arrives block by block, in any order and from untrusted sources, each block checked by its hash.

Where the blocks come from does not matter: `Exchange` gets them over Zenoh, the IPFS bridge from IPFS nodes.
"""

from __future__ import annotations

import io
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Final, Self

from mesh.content.dag import BlockRef, children_of, is_block, most_blocks, parse_node
from mesh.content.errors import ContentCorrupt, ContentTooLarge, StoreFull
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, read_or_nothing
from mesh.content.index import BlockSpan
from mesh.content.recovery import DAMAGED_SUFFIX
from schemas.cid import parse_cid
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import TracebackType

    from mesh.content.directory import StoreDirectory
    from mesh.content.index import BlockIndex
    from mesh.content.quota import Quota

_BATCH: Final = 128
"""Blocks added to the index in one transaction."""


class Assembly:
    """A file on its way into a store: `with store.assemble(cid) as assembly`.

    Start with `root`. For each reference, get the block (first try `local`), pass it to `put`, and continue with the
    references it returns. When none is left, call `finish`. May be used from several threads at once.

    Leaving the `with` block unfinished keeps the blocks received so far, unless they can never become the file; so
    does a crash. The next assembly of the same CID finds them with `local`, and the store serves them to others.
    """

    def __init__(
        self,
        directory: StoreDirectory,
        cid: str,
        *,
        index: BlockIndex,
        quota: Quota,
        get_stored_block: Callable[[str], bytes | None],
        size_limit: int,
    ) -> None:
        parse_cid(cid)
        self.cid: Final = cid
        self.root: Final = BlockRef(cid)
        self._store = directory
        self._get_stored_block = get_stored_block
        self._index = index
        self._quota = quota
        self._limit = size_limit
        self._lock = threading.Lock()
        self._spans: dict[bytes, BlockSpan] = {}
        self._placed = 0
        self._size = 0
        self._have = 0
        self._settled = False
        self._file = _part_file(directory.directory, cid)
        self._left_size = self._file.size
        """Bytes that an earlier attempt left in the file."""
        self._damaged = _damaged_file(directory.directory, cid)

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
                    self._index_blocks()
            else:
                self._index.forget(self._file.path.name)

    def local(self, ref: BlockRef) -> bytes | None:
        """The block, if it is on this disk: in this file, in another one, or left by an earlier attempt.

        Its hash is checked.
        """
        digest = parse_cid(ref.cid)[2:]
        with self._lock:
            span = self._spans.get(digest)
        if span is not None:
            return span.block(self._file.read(span.length, offset=span.offset))
        return self._get_stored_block(ref.cid) or self._left_over(ref)

    def put(self, ref: BlockRef, block: bytes) -> list[BlockRef]:
        """Add a block, and return references to the blocks that it links to.

        Raises `ContentCorrupt` if the bytes do not have the hash (`is_block` checks that alone), or if they have it
        but the tree can't be a file's; `ContentTooLarge`, `QuotaReached` and `StoreFull`.
        """
        if not is_block(ref.cid, block):
            raise ContentCorrupt(self.cid, f"the bytes of block {ref.cid} have another hash")
        return self.put_checked(ref, block)

    def put_checked(self, ref: BlockRef, block: bytes) -> list[BlockRef]:
        """The same for a block whose hash is known to be right, by `local` or `is_block`."""
        try:
            node = parse_node(ref, block)
        except ContentCorrupt as error:
            raise ContentCorrupt(self.cid, f"in block {ref.cid}: {error.why}", reason=error.reason) from None
        if ref.size is None:
            self._reserve(node.file_size)
        span = BlockSpan.of(parse_cid(ref.cid)[2:], block, data=node.data, offset=ref.offset)
        self._file.write(node.data, offset=ref.offset)
        with self._lock:
            self._spans.setdefault(span.digest, span)
            self._placed += 1
            self._have += len(node.data)
            if self._placed + len(node.links) > most_blocks(self._size):
                raise ContentCorrupt(
                    self.cid, f"its tree has more than {most_blocks(self._size)} blocks", reason="too-many-blocks"
                )
        if node.links or len(self._spans) >= _BATCH:  # after a crash, the positions of the parts are worth most
            self._index_blocks()
        return children_of(ref, node)

    def progress(self) -> tuple[int, int]:
        """Bytes of the file that were added, and its size (0 before the root was added)."""
        with self._lock:
            return self._have, self._size

    def finish(self, *, sync: bool = True) -> Path:
        """Move the complete file to its CID, atomically, and return its path. Call it once every block was added.

        Without `sync`, a power loss may damage the file; then it counts as not held.
        """
        path = self._store.settle(self._file, self.cid, size=self._size, spans=self._spans.values(), sync=sync)
        self._settled = True
        return path

    def _reserve(self, size: int) -> None:
        """Reserve the size that the root states."""
        if size > self._limit:
            raise ContentTooLarge(self.cid, size=size, limit=self._limit)
        self._quota.reserve(self._file.path.name, size)
        with self._lock:
            self._size = size

    def _index_blocks(self) -> None:
        """Add the new blocks to the index."""
        with self._lock:
            spans, self._spans = self._spans, {}
        self._index.add(self._file.path.name, spans.values())

    def _left_over(self, ref: BlockRef) -> bytes | None:
        """A leaf of our own chunking, at its offset: from an earlier attempt, or from a damaged file."""
        if ref.size is None or ref.size > CHUNK_SIZE:
            return None
        data = b""
        if ref.offset + ref.size <= self._left_size:
            data = self._file.read(ref.size, offset=ref.offset)
        block = _leaf_of(data, ref)
        if block is None and self._damaged is not None:
            block = _leaf_of(read_or_nothing(self._damaged.fileno(), ref.size, ref.offset), ref)
        return block


def _leaf_of(data: bytes, ref: BlockRef) -> bytes | None:
    """The leaf with these bytes of the file, if its hash is that of `ref`."""
    if len(data) != ref.size:
        return None
    block = next(iter(blocks_of_stream(io.BytesIO(data))))
    return block.data if block.cid == ref.cid else None


def _part_file(directory: Path, cid: str) -> TemporaryFile:
    """The file of an earlier attempt at this CID or, if it is locked by another attempt, a new one."""
    part = TemporaryFile.take(directory / f"{PART_PREFIX}{cid}")
    if part is None:
        return TemporaryFile.create(directory, PUT_PREFIX)
    part.keep()
    return part


def _damaged_file(directory: Path, cid: str) -> BinaryIO | None:
    """The file that was set aside as damaged under this CID, if any: most of its blocks may be good."""
    try:
        return (directory / f"{cid}{DAMAGED_SUFFIX}").open("rb", buffering=0)
    except FileNotFoundError:
        return None
