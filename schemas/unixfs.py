"""Files as trees of blocks, and their CIDs, as `ipfs add` has always made them by default.

Chunks of 262,144 bytes, each a UnixFS file leaf in dag-pb; a balanced tree with at most 174 links per node. A block's
name is its sha2-256 digest; the CIDv0 of the root is the file's. Sources: the dag-pb and UnixFS specifications of IPFS,
and the CIDs of the legacy network.
"""

from __future__ import annotations

from hashlib import sha256
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO, Final

from msgspec import Struct

from schemas.cid import MULTIHASH_PREFIX, cid_of_digest, format_cid
from schemas.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from os import PathLike

CHUNK_SIZE: Final = 262_144
MAX_LINKS: Final = 174
MAX_BLOCK_SIZE: Final = 2 * 1024 * 1024
"""The longest block, in bytes, that is looked at: the limit of IPFS itself. Ours have at most a chunk and 14 bytes."""

_RAW, _FILE = 0, 2
_NODE_DATA, _NODE_LINK = 1, 2
_LINK_HASH, _LINK_NAME, _LINK_TREE_SIZE = 1, 2, 3
_UNIXFS_TYPE, _UNIXFS_DATA, _UNIXFS_FILE_SIZE, _UNIXFS_BLOCK_SIZE = 1, 2, 3, 4

_VARINT, _BYTES = 0, 2


class UnixfsBlock(Struct, frozen=True, gc=False):
    """The bytes of one node of the tree, and the CIDv0 that names them."""

    cid: str
    data: bytes


class UnixfsLink(Struct, frozen=True, gc=False):
    """A link to a part of a file: the CIDv0 of its root block, and how many bytes of the file are below it."""

    cid: str
    size: int


class UnixfsNode(Struct, frozen=True, gc=False):
    """What a block holds: links to the parts of a file in their order, or the bytes of a part, `file_size` in all."""

    links: tuple[UnixfsLink, ...]
    data: bytes
    file_size: int


class _Child(Struct, frozen=True, gc=False):
    """A finished subtree: the digest of its root, its bytes of the file, and those of all its blocks."""

    digest: bytes
    file_size: int
    tree_size: int


def blocks_of_stream(stream: BinaryIO) -> Iterator[UnixfsBlock]:
    """The blocks of the file that `stream` holds, children before their parents, the root last.

    Memory does not grow with the file: it holds one chunk and the open nodes. Errors of the stream pass through.
    """
    return _blocks(stream, with_data=True)


def cid_of_stream(stream: BinaryIO) -> str:
    """The CIDv0 of the file that `stream` holds, from its current position to its end."""
    cid = ""
    for block in _blocks(stream, with_data=False):
        cid = block.cid
    return cid


def cid_of_bytes(data: bytes) -> str:
    """The CIDv0 of a file with this content."""
    return cid_of_stream(BytesIO(data))


def cid_of_file(path: str | PathLike[str]) -> str:
    """The CIDv0 of the file at `path`. Raises `OSError` as `open()` does."""
    with open(path, "rb") as stream:
        return cid_of_stream(stream)


def parse_block(data: bytes) -> UnixfsNode:
    """What a block of a file holds. The caller checks first that the bytes match the block's CID.

    Raises `InputError` if the bytes are no dag-pb node with a part of a UnixFS file whose sizes agree, and `InvalidCid`
    if a link's name is no CIDv0.
    """
    if len(data) > MAX_BLOCK_SIZE:
        raise InputError(f"a block of {len(data)} bytes is longer than {MAX_BLOCK_SIZE}")
    names = []
    unixfs = None
    for number, value in read_fields(data):
        if number == _NODE_LINK:
            names.append(_link_cid(_expect_bytes(value)))
        elif number == _NODE_DATA and unixfs is None:
            unixfs = _expect_bytes(value)
        else:
            raise InputError(f"field {number} is unknown or repeated in a dag-pb node")
    if unixfs is None:
        raise InputError("a dag-pb node without data is no part of a file")
    return _node(names, unixfs)


def _blocks(stream: BinaryIO, *, with_data: bool) -> Iterator[UnixfsBlock]:
    levels: list[list[_Child]] = [[]]
    chunk = _read_chunk(stream)
    while True:
        yield from _make_room(levels)
        block, child = _leaf(chunk, with_data=with_data)
        levels[0].append(child)
        yield block
        if len(chunk) < CHUNK_SIZE or not (chunk := _read_chunk(stream)):
            break
    yield from _close_tree(levels)


def _read_chunk(stream: BinaryIO) -> bytes:
    parts, missing = [], CHUNK_SIZE
    while missing and (part := stream.read(missing)):
        parts.append(part)
        missing -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _leaf(chunk: bytes, *, with_data: bool) -> tuple[UnixfsBlock, _Child]:
    """A leaf; without its block's bytes where only names are wanted, as copying them takes half as long as hashing."""
    head, tail = _leaf_framing(len(chunk))
    hashed = sha256(head)
    hashed.update(chunk)
    hashed.update(tail)
    digest = hashed.digest()
    data = b"".join((head, chunk, tail)) if with_data else b""
    return UnixfsBlock(cid_of_digest(digest), data), _Child(digest, len(chunk), len(head) + len(chunk) + len(tail))


def _leaf_framing(size: int) -> tuple[bytes, bytes]:
    """What a leaf has before and after its `size` bytes of the file."""
    head = write_number(_UNIXFS_TYPE, _FILE) + (write_length(_UNIXFS_DATA, size) if size else b"")
    tail = write_number(_UNIXFS_FILE_SIZE, size)
    return write_length(_NODE_DATA, len(head) + size + len(tail)) + head, tail


def _parent(children: list[_Child]) -> tuple[UnixfsBlock, _Child]:
    file_size = sum(child.file_size for child in children)
    links = b"".join(
        write_bytes(
            _NODE_LINK,
            write_bytes(_LINK_HASH, MULTIHASH_PREFIX + child.digest)
            + write_bytes(_LINK_NAME, b"")
            + write_number(_LINK_TREE_SIZE, child.tree_size),
        )
        for child in children
    )
    unixfs = (
        write_number(_UNIXFS_TYPE, _FILE)
        + write_number(_UNIXFS_FILE_SIZE, file_size)
        + b"".join(write_number(_UNIXFS_BLOCK_SIZE, child.file_size) for child in children)
    )
    data = links + write_bytes(_NODE_DATA, unixfs)
    digest = sha256(data).digest()
    tree_size = len(data) + sum(child.tree_size for child in children)
    return UnixfsBlock(cid_of_digest(digest), data), _Child(digest, file_size, tree_size)


def _make_room(levels: list[list[_Child]]) -> Iterator[UnixfsBlock]:
    """Close the nodes that are full, from the lowest level up, to make room for one more leaf."""
    height = 0
    while len(levels[height]) == MAX_LINKS:
        yield _close_node(levels, height)
        height += 1


def _close_tree(levels: list[list[_Child]]) -> Iterator[UnixfsBlock]:
    """Close all open nodes, after the last leaf; the last block is the root."""
    height = 0
    while height + 1 < len(levels) or len(levels[height]) > 1:
        yield _close_node(levels, height)
        height += 1


def _close_node(levels: list[list[_Child]], height: int) -> UnixfsBlock:
    if height + 1 == len(levels):
        levels.append([])
    block, parent = _parent(levels[height])
    levels[height] = []
    levels[height + 1].append(parent)
    return block


def _node(names: list[str], unixfs: bytes) -> UnixfsNode:
    kind, file_size, data = None, None, b""
    sizes: list[int] = []
    for number, value in read_fields(unixfs):
        match number, value:
            case 1, int() if kind is None:
                kind = value
            case 2, bytes() if not data:
                data = value
            case 3, int() if file_size is None:
                file_size = value
            case 4, int():
                sizes.append(value)
            case _:
                raise InputError(f"field {number} of UnixFS data is unknown, repeated or of the wrong type")
    if kind not in (_RAW, _FILE):
        raise InputError(f"UnixFS type {kind} is no part of a file")
    if len(sizes) != len(names):
        raise InputError(f"{len(names)} links, but {len(sizes)} sizes")
    total = len(data) + sum(sizes)
    if file_size not in (None, total):
        raise InputError(f"{total} bytes in the parts, but {file_size} in all")
    links = tuple(UnixfsLink(cid, size) for cid, size in zip(names, sizes, strict=True))
    return UnixfsNode(links, data, total)


def _link_cid(link: bytes) -> str:
    hashes = [value for number, value in read_fields(link) if number == _LINK_HASH]
    if len(hashes) != 1:
        raise InputError("a dag-pb link has one hash")
    return format_cid(_expect_bytes(hashes[0]))


def _expect_bytes(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise InputError("a dag-pb field holds a number where bytes belong")
    return value


def write_number(field: int, value: int) -> bytes:
    """A field that holds an unsigned integer of at most 64 bits."""
    return _varint(field << 3 | _VARINT) + _varint(value)


def write_bytes(field: int, value: bytes) -> bytes:
    """A field that holds a byte string."""
    return write_length(field, len(value)) + value


def write_length(field: int, length: int) -> bytes:
    """What comes before a byte string of that length."""
    return _varint(field << 3 | _BYTES) + _varint(length)


def read_fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """The fields of a message in their order, as number and value.

    Raises `InputError` for anything but whole numbers and byte strings.
    """
    position = 0
    while position < len(data):
        key, position = _read_varint(data, position)
        number, position = _read_varint(data, position)
        if key & 7 == _VARINT:
            yield key >> 3, number
        elif key & 7 == _BYTES:
            if number > len(data) - position:
                raise InputError("a protobuf field is longer than what holds it")
            yield key >> 3, data[position : position + number]
            position += number
        else:
            raise InputError(f"protobuf wire type {key & 7} is not used here")


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _read_varint(data: bytes, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position == len(data):
            raise InputError("a protobuf field is cut off")
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            break
    if byte >= 0x80 or value >= 2**64:
        raise InputError("a protobuf number has more than 64 bits")
    return value, position
