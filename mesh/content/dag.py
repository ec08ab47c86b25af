"""How the blocks behind a CID make up a file: where each belongs, and what no honest tree would do. Pure.

A tree is checked from the root down. The root says how long the file is, every link how long the part under it is. A
block that says otherwise than the link it came by makes the file corrupt, whoever sent it, for its hash was right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.content.errors import ContentCorrupt
from schemas.errors import InputError
from schemas.unixfs import parse_block

if TYPE_CHECKING:
    from schemas.unixfs import UnixfsNode

MAX_DEPTH: Final = 12
"""Levels of the deepest tree taken. Ours are 3 deep at 7 GiB."""
MAX_BLOCKS: Final = 400_000
"""Blocks of the largest tree taken: 100 GiB at the usual 256 KiB each."""

_SPARE_BLOCKS: Final = 1024
_SMALLEST_CHUNK: Final = 1024
_FRAMING: Final = 256
"""Bytes of a block, besides the file's own, for the node and for each of its links. IPFS writes about 60 for a link."""


@dataclass(frozen=True, slots=True)
class BlockRef:
    """Where a block belongs: the file's bytes from `offset`, `size` of them (None for the root: it says so itself)."""

    cid: str
    offset: int = 0
    size: int | None = None
    depth: int = 0


def most_blocks(size: int) -> int:
    """Blocks of the largest tree taken for a file of `size` bytes: chunks of 1 KiB, unless it is a small file."""
    return min(MAX_BLOCKS, _SPARE_BLOCKS + size // _SMALLEST_CHUNK)


def node_at(place: BlockRef, block: bytes) -> UnixfsNode:
    """What the block at `place` says, checked against the link that led to it. Raises `ContentCorrupt`."""
    try:
        node = parse_block(block)
    except InputError as error:
        raise ContentCorrupt(place.cid, f"it names no file: {error}") from None
    if place.size is not None and node.file_size != place.size:
        raise ContentCorrupt(place.cid, f"it is of {node.file_size} bytes where its parent says {place.size}")
    if any(link.size <= 0 for link in node.links):
        raise ContentCorrupt(place.cid, "a part of it is empty")
    if len(block) > len(node.data) + _FRAMING * (1 + len(node.links)):
        raise ContentCorrupt(place.cid, f"{len(block)} bytes are too many for what it says")
    if node.links and place.depth >= MAX_DEPTH:
        raise ContentCorrupt(place.cid, f"its tree is deeper than {MAX_DEPTH} levels")
    return node


def children_of(place: BlockRef, node: UnixfsNode) -> list[BlockRef]:
    """The places of the blocks that the one at `place` links to, in the order of the file."""
    offset = place.offset + len(node.data)
    places = []
    for link in node.links:
        places.append(BlockRef(link.cid, offset, link.size, place.depth + 1))
        offset += link.size
    return places
