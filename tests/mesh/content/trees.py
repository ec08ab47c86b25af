"""Trees of dag-pb blocks with any chunking, and ones that no honest writer makes."""

from __future__ import annotations

from hashlib import sha256
from typing import TYPE_CHECKING

from schemas.cid import cid_of_digest
from schemas.unixfs import UnixfsBlock, write_bytes, write_number

if TYPE_CHECKING:
    from collections.abc import Sequence


def named(data: bytes) -> UnixfsBlock:
    """A block under its true name."""
    return UnixfsBlock(cid_of_digest(sha256(data).digest()), data)


def leaf(data: bytes) -> UnixfsBlock:
    """A leaf as old versions of IPFS wrote it: of UnixFS type `raw`, and without the size of the file."""
    return named(write_bytes(1, write_number(1, 0) + write_bytes(2, data)))


def parent(
    children: Sequence[tuple[UnixfsBlock, int]], *, data: bytes = b"", sizes: Sequence[int] | None = None
) -> UnixfsBlock:
    """A node over these blocks, each with its bytes of the file; `sizes` are those it claims instead."""
    links = b"".join(write_bytes(2, write_bytes(1, b"\x12\x20" + digest(block))) for block, _ in children)
    claimed = [size for _, size in children] if sizes is None else list(sizes)
    unixfs = write_number(1, 2) + (write_bytes(2, data) if data else b"") + write_number(3, len(data) + sum(claimed))
    unixfs += b"".join(write_number(4, size) for size in claimed)
    return named(links + write_bytes(1, unixfs))


def chunked(data: bytes, size: int) -> list[UnixfsBlock]:
    """The blocks of a file in chunks of `size` bytes under one root, the root last."""
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    leaves = [leaf(piece) for piece in pieces]
    return [*leaves, parent([(block, len(piece)) for block, piece in zip(leaves, pieces, strict=True)])]


def digest(block: UnixfsBlock) -> bytes:
    """The sha2-256 digest of a block."""
    return sha256(block.data).digest()
