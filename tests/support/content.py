"""Content for tests: stores and their files, trees of blocks, and holders that answer as the test says."""

from __future__ import annotations

import asyncio
import io
import os
import random
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import zenoh

from mesh.content import session_address
from schemas.cid import cid_of_digest
from schemas.keys import cid_selector
from schemas.unixfs import UnixfsBlock, blocks_of_stream, write_bytes, write_number
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from mesh.content import Store

ROOT = Path(__file__).parents[2]


class RandomStream(io.RawIOBase):
    """A stream of `size` random bytes. Reading raises `OSError` once only `fail_at` bytes are left."""

    def __init__(self, size: int, fail_at: int | None = None) -> None:
        self.left = size
        self.fail_at = fail_at
        self.random = random.Random(size)

    def read(self, size: int = -1) -> bytes:
        if self.fail_at is not None and self.left <= self.fail_at:
            raise OSError("the source broke")
        data = self.random.randbytes(min(size, self.left, 65_536))
        self.left -= len(data)
        return data


def leftovers(directory: Path) -> list[str]:
    """Files in a store's directory that are neither content nor its own."""
    own = {".lock", ".open", ".pins", ".blocks.sqlite", ".blocks.sqlite-wal", ".blocks.sqlite-shm"}
    return sorted(name for name in os.listdir(directory) if name not in own and not name.startswith("Qm"))


def flip_bit(path: Path, offset: int) -> None:
    path.chmod(0o644)
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)
        file.seek(offset)
        file.write(bytes([byte[0] ^ 1]))


def blocks_by_cid(data: bytes) -> dict[str, bytes]:
    return {block.cid: block.data for block in blocks_of_stream(io.BytesIO(data))}


def requested_cid(query: zenoh.Query) -> str:
    """The CID that a query asks for."""
    return str(query.key_expr).rpartition("/")[2]


def put_tree(store: Store, blocks: list[UnixfsBlock]) -> str:
    """Store the file of a tree, given with the root last."""
    by_cid = {block.cid: block.data for block in blocks}
    with store.assemble(blocks[-1].cid) as assembly:
        waiting = [assembly.root]
        while waiting:
            place = waiting.pop()
            waiting.extend(assembly.put(place, by_cid[place.cid]))
        assembly.finish()
    return blocks[-1].cid


def block_of(data: bytes) -> UnixfsBlock:
    """The block with these bytes."""
    return UnixfsBlock(cid_of_digest(sha256(data).digest()), data)


def leaf(data: bytes) -> UnixfsBlock:
    """A leaf as old versions of IPFS wrote it: of UnixFS type `raw`, and without the size of the file."""
    return block_of(write_bytes(1, write_number(1, 0) + write_bytes(2, data)))


def parent(
    children: Sequence[tuple[UnixfsBlock, int]], *, data: bytes = b"", sizes: Sequence[int] | None = None
) -> UnixfsBlock:
    """A node over these blocks with their sizes; `sizes` are stated instead if given."""
    links = b"".join(write_bytes(2, write_bytes(1, b"\x12\x20" + digest(block))) for block, _ in children)
    claimed = [size for _, size in children] if sizes is None else list(sizes)
    unixfs = write_number(1, 2) + (write_bytes(2, data) if data else b"") + write_number(3, len(data) + sum(claimed))
    unixfs += b"".join(write_number(4, size) for size in claimed)
    return block_of(links + write_bytes(1, unixfs))


def chunked(data: bytes, size: int) -> list[UnixfsBlock]:
    """The blocks of a file in chunks of `size` bytes under one root, the root last."""
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    leaves = [leaf(piece) for piece in pieces]
    return [*leaves, parent([(block, len(piece)) for block, piece in zip(leaves, pieces, strict=True)])]


def digest(block: UnixfsBlock) -> bytes:
    """The sha2-256 digest of a block."""
    return sha256(block.data).digest()


class BlockQuery(NamedTuple):
    """A query for a block, and the key of the reply."""

    query: zenoh.Query
    key_expr: str

    def reply(self, key: str, payload: bytes) -> None:
        self.query.reply(key, payload)


def holder_of(session: zenoh.Session) -> str:
    """How a fetch names the holder behind a session without an account."""
    return f"{session_address(session)}@{session.zid()}"


@contextmanager
def answer_queries(session: zenoh.Session, answer: Callable[[zenoh.Query], None]) -> Iterator[None]:
    """Answer queries for blocks as a foreign holder would; `answer` gets each with a key of that holder."""
    address = session_address(session)

    def reply(query: zenoh.Query) -> None:
        with query:
            answer(cast("zenoh.Query", BlockQuery(query, str(query.key_expr).replace("*", address))))

    queryable = session.declare_queryable(cid_selector(address), reply)
    yield
    queryable.undeclare()  # type: ignore[no-untyped-call]


async def until_held(session: zenoh.Session, cid: str, *, holders: int) -> None:
    """Return once that many holders answer a query of `session` for the block."""

    def answers() -> int:
        replies = session.get(
            cid_selector(cid=cid),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=10.0,
        )
        return sum(reply.ok is not None for reply in replies)

    async def enough() -> bool:
        return await asyncio.to_thread(answers) >= holders

    await until_found(enough, what=f"{holders} holders", seconds=30)


def sample_bytes(size: int) -> bytes:
    """Reproducible random bytes."""
    return random.Random(1).randbytes(size)
