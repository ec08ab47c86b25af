"""The tree of blocks behind a CID: checking it, and reading a stored file through it.

A tree is checked from the root down. The root gives the length of the file, each link that of the part below it. If a
block contradicts the link that led to it, the file is corrupt: the block's hash is right, so no peer has a better one.
"""

from __future__ import annotations

import hashlib
import io
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.content.files import read_or_nothing
from mesh.errors import ContentError
from schemas.cid import parse_cid
from schemas.errors import InputError
from schemas.unixfs import MAX_BLOCK_SIZE, parse_block

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from schemas.unixfs import UnixfsNode

    FindSpan = Callable[[bytes], "BlockSpan | None"]
    """Returns where the block with a digest is in the file that is read, and its framing."""


class TreeLimits(NamedTuple):
    """What trees of blocks are accepted."""

    depth: int = 12
    """Levels. Ours have 3 at 7 GiB."""
    blocks: int = 400_000
    """Blocks: 100 GiB at the usual 256 KiB each."""
    small_blocks: int = 1024
    """Blocks of a small file, whatever its size."""
    chunk: int = 1024
    """Bytes of a file for each further block."""
    framing: int = 256
    """Bytes of a block besides the file's own, for the node and for each link. IPFS writes about 60 a link."""


TREE_LIMITS: Final = TreeLimits()


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


@dataclass(frozen=True, slots=True)
class BlockSpan:
    """One block of a file: `head`, then `length` bytes of the file from `offset`, then `tail`."""

    digest: bytes
    offset: int
    length: int
    head: bytes
    tail: bytes

    @classmethod
    def of(cls, digest: bytes, block: bytes, *, data: bytes, offset: int) -> BlockSpan:
        """The span of `block`, which holds `data`, the bytes of the file from `offset`."""
        start = block.find(data)
        return cls(digest, offset, len(data), block[:start], block[start + len(data) :])

    def block(self, data: bytes) -> bytes:
        """The bytes of the block, given its data."""
        return self.head + data + self.tail


@dataclass(frozen=True, slots=True)
class BlockRef:
    """A reference to a block: its CID, and which bytes of the file it covers.

    `size` is None for the root, which states the size itself. `depth` is the level in the tree.
    """

    cid: str
    offset: int = 0
    size: int | None = None
    depth: int = 0


def is_block(cid: str, data: bytes) -> bool:
    """Whether `data` is the block named by `cid`: it has that hash, and no more bytes than a block may have."""
    return len(data) <= MAX_BLOCK_SIZE and hashlib.sha256(data).digest() == parse_cid(cid)[2:]


def most_blocks(size: int) -> int:
    """The most blocks accepted for a file of `size` bytes: chunks of 1 KiB, and some more for small files."""
    return min(TREE_LIMITS.blocks, TREE_LIMITS.small_blocks + size // TREE_LIMITS.chunk)


def parse_node(ref: BlockRef, block: bytes) -> UnixfsNode:
    """The node in `block`, checked against the link that led to it. Raises `ContentCorrupt`."""
    try:
        node = parse_block(block)
    except InputError as error:
        raise ContentCorrupt(ref.cid, f"it is not a file: {error}", reason="not-a-file") from None
    if ref.size is not None and node.file_size != ref.size:
        raise ContentCorrupt(ref.cid, f"it has {node.file_size} bytes, its parent says {ref.size}", reason="wrong-size")
    if any(link.size <= 0 for link in node.links):
        raise ContentCorrupt(ref.cid, "it links to an empty part", reason="empty-part")
    if len(block) > len(node.data) + TREE_LIMITS.framing * (1 + len(node.links)):
        raise ContentCorrupt(ref.cid, f"it has {len(block)} bytes, too many for its content", reason="oversized-block")
    if node.links and ref.depth >= TREE_LIMITS.depth:
        raise ContentCorrupt(ref.cid, f"its tree has more than {TREE_LIMITS.depth} levels", reason="too-deep")
    return node


def children_of(ref: BlockRef, node: UnixfsNode) -> list[BlockRef]:
    """References to the blocks that `node` links to, in the order of the file."""
    offset = ref.offset + len(node.data)
    refs = []
    for link in node.links:
        refs.append(BlockRef(link.cid, offset, link.size, ref.depth + 1))
        offset += link.size
    return refs


class CheckedFile(io.RawIOBase):
    """The file at `path` for reading and seeking. Each block is checked by its hash when it is read.

    Raises `ContentCorrupt` if a block does not have its hash, after calling `on_damage`. Only what is read is hashed,
    so a file of any size opens at once.
    """

    def __init__(self, path: Path, cid: str, find_span: FindSpan, *, on_damage: Callable[[], None]) -> None:
        self._file: Final = path.open("rb", buffering=0)
        self._cid = cid
        self._find_span = find_span
        self._on_damage = on_damage
        self._position = 0
        self._path: list[tuple[BlockRef, UnixfsNode]] = []
        """The nodes from the root down to the one that was read last."""
        try:
            self._size = self._node(BlockRef(cid), 0).file_size
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        if hasattr(self, "_file"):  # otherwise it could not be opened
            self._file.close()
        super().close()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a position; see `io.IOBase.seek`. Raises `ValueError` before the start."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError(f"position {base + offset} is before the start")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Fill the buffer from the block at the position."""
        if self._position >= self._size or not buffer:
            return 0
        start, data = self._data_at(self._position)
        data = data[self._position - start :][: len(buffer)]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def _data_at(self, position: int) -> tuple[int, bytes]:
        """The bytes of the block that contains `position`, and where they begin."""
        ref, depth = BlockRef(self._cid), 0
        while True:
            node = self._node(ref, depth)
            if position < ref.offset + len(node.data):
                return ref.offset, node.data
            below = [child for child in children_of(ref, node) if child.offset <= position]
            ref, depth = below[-1], depth + 1

    def _node(self, ref: BlockRef, depth: int) -> UnixfsNode:
        if depth < len(self._path) and self._path[depth][0] == ref:
            return self._path[depth][1]
        try:
            node = parse_node(ref, read_block(self._file, ref, self._find_span))
        except ContentCorrupt as error:
            self._on_damage()
            raise ContentCorrupt(self._cid, f"in block {ref.cid}: {error.why}", reason=error.reason) from None
        self._path[depth:] = [(ref, node)]
        return node


def read_block(file: io.FileIO, ref: BlockRef, find_span: FindSpan) -> bytes:
    """The block of `ref`, from the open file. Raises `ContentCorrupt` if the disk has other bytes, or none."""
    digest = parse_cid(ref.cid)[2:]
    span = find_span(digest)
    if span is None:
        raise ContentCorrupt(ref.cid, "it is not in the index", reason="not-indexed")
    block = span.block(read_or_nothing(file.fileno(), span.length, ref.offset))
    if hashlib.sha256(block).digest() != digest:
        raise ContentCorrupt(ref.cid, "the bytes on the disk have another hash")
    return block


def matches_tree(path: Path, cid: str, find_span: FindSpan) -> bool:
    """Whether the file matches its CID by the tree in the index, whatever its chunking settings were."""
    waiting, seen = [BlockRef(cid, size=path.stat().st_size)], 0
    with path.open("rb", buffering=0) as file:
        while waiting and seen < TREE_LIMITS.blocks:
            ref, seen = waiting.pop(), seen + 1
            try:
                waiting.extend(children_of(ref, parse_node(ref, read_block(file, ref, find_span))))
            except ContentCorrupt:
                return False
    return not waiting
