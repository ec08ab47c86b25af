"""Files as trees of blocks. The reference CIDs are those of ipfs-unixfs-importer 17.1.1 for the same contents."""

from __future__ import annotations

import tracemalloc
from contextlib import suppress
from hashlib import sha256
from io import BytesIO, RawIOBase
from typing import TYPE_CHECKING, BinaryIO, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import (
    CHUNK_SIZE,
    MAX_LINKS,
    InputError,
    InvalidCid,
    blocks_of_stream,
    cid_of_bytes,
    cid_of_digest,
    cid_of_file,
    cid_of_stream,
    parse_block,
    unixfs,
)
from schemas.unixfs import read_fields, write_bytes, write_number

if TYPE_CHECKING:
    from pathlib import Path

C = CHUNK_SIZE
PERIOD = 65_521  # a prime, so that no two chunks are alike
UNIT = bytes((i * 31 + 7 + (i >> 8)) & 255 for i in range(PERIOD))

BY_SIZE = {
    0: "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH",
    1: "QmXC9WjuLo7EfydBdbWyvpGif62nrxbDCX2vcz9ZqLTQvV",
    C - 1: "QmYciDHmPjBb6EF5PVUbMD2LP7NF73vprPPMXdEKYzsnFT",
    C: "Qmehww77K6xbDTQSgoBUGcbehvL43E8xd2RXTwbT9VaQTt",
    C + 1: "QmdRhkTiqucq3wrvprU1e46cY4SqS6ZeB9NzkTMa2GAjW2",
    2 * C: "QmRLiv1ZRtynAjn7W91W5Japk3iHE96krQYX6ra1mCq2zC",
    174 * C: "QmXAcHeQDTcAxkhjkNCAXzAVG7sHKjbHbfy2RC9dKEWji8",
    174 * C + 1: "QmdtMNDcWa3Gs41vUGY7wUKe2uJaF2C2CD5nQ7She1yHqa",
    175 * C: "QmPTRSYT3A9r8CsNEvDZtKaC6avCqUmbQrtnaTesk3gSak",
    348 * C + 5: "QmWw1LvUK9kvjU4Ly3Cvd5wzu5CLaFUtvRX4XNmLXo3gyA",
}

# The same contents in chunks of 4 bytes, with 3 links a node: trees of up to six levels.
BY_SIZE_IN_SMALL_CHUNKS = {
    4: "QmdqkavD4Ag8nqvunqUUUr6S38US6MTGbSKK148EpNHv7P",
    5: "Qmbz4c7f4TnpXmtvi2fEFDUK9sznYLBv61AiWWcwjuXrBd",
    12: "Qmb1hbPhDjF44RJKG8epk5GrxFcmFNfU7Db95Eivz8rPXn",
    13: "QmY6DCsibHY4FLaTQ5kbjDv3nkqHRLHAprCCLJej1oiUp6",
    16: "QmYtR6KricDr4Pm9vUKKsvSQRjPGfK3njw7cx45yiDCeoD",
    36: "QmQmcF2aAX22s6E1m2LdkHGEjUf2ZfYCJLPAsdj6BaUKTw",
    37: "Qmej4qM7CrRk623x8U1jHEYEZ8ksDJJk7K5DdUrWWVHc9t",
    40: "QmQK4p7Kg8Mye77iSTR2B6dYnqAdn7wCqWTGVV6UPWhSBE",
    108: "Qmad8R5L1eCPHF2SHHr9K8UHDyAd3eA4ika2QnM5Z6nMf5",
    109: "QmaaA9QE1C7Hhy7c9noy6pK4k7Sv4xSSRAfW6xdXVawmwo",
    112: "QmTdMkSyLyKfuuwNk6CjvHbFX1WhHiW2G5QNHNWFsMfeRg",
    121: "QmdXqooYUMRUnAozJtHuAWa1LDjTzc2yBVDhXKVwFDQMjV",
    324: "QmcazxaoNdjDN7ox6mBd1mgJsayYoDbVcqwzp7iMgPA8f9",
    325: "QmP8Hker4FgXfsUREyFsnqtqpHkRcvaRa9Cd6fynb1FTix",
    1000: "QmQjWn42gVo28461S6DmrZbu14DGwoiGDtynvVrkvSyUZ1",
}


class Pattern(RawIOBase):
    """A stream of `size` bytes, `UNIT` again and again, that never gives more than `at_once` bytes."""

    def __init__(self, size: int, *, at_once: int = 1 << 30) -> None:
        self._left = size
        self._position = 0
        self._at_once = at_once

    def read(self, size: int = -1) -> bytes:
        count = min(size, self._left, self._at_once)
        start = self._position % PERIOD
        self._left -= count
        self._position += count
        return (UNIT * (count // PERIOD + 2))[start : start + count]


def pattern(size: int, *, at_once: int = 1 << 30) -> BinaryIO:
    return cast("BinaryIO", Pattern(size, at_once=at_once))


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unixfs, "CHUNK_SIZE", 4)
    monkeypatch.setattr(unixfs, "MAX_LINKS", 3)


@pytest.mark.parametrize("size", BY_SIZE)
def test_cids_of_edge_sizes(size: int) -> None:
    assert cid_of_stream(pattern(size)) == BY_SIZE[size]


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("size", BY_SIZE_IN_SMALL_CHUNKS)
def test_cids_of_deep_trees(size: int) -> None:
    assert cid_of_stream(pattern(size)) == BY_SIZE_IN_SMALL_CHUNKS[size]


@pytest.mark.parametrize("size", [C - 1, C, C + 1, 2 * C])
def test_short_reads_do_not_change_the_cid(size: int) -> None:
    assert cid_of_stream(pattern(size, at_once=50_021)) == BY_SIZE[size]


def test_bytes_streams_and_files_have_the_same_cid(tmp_path: Path) -> None:
    data = UNIT * 5
    (tmp_path / "file").write_bytes(data)
    name = cid_of_bytes(data)
    assert cid_of_stream(BytesIO(data)) == cid_of_file(tmp_path / "file") == cid_of_file(str(tmp_path / "file")) == name


def test_stream_is_read_from_its_position() -> None:
    stream = BytesIO(b"head" + UNIT)
    stream.seek(4)
    assert cid_of_stream(stream) == cid_of_bytes(UNIT)


def test_missing_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        cid_of_file(tmp_path / "nothing")


def test_blocks_have_the_cids_of_their_bytes() -> None:
    for block in blocks_of_stream(pattern(3 * C + 1)):
        assert block.cid == cid_of_digest(sha256(block.data).digest())


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("size", [*range(30), *BY_SIZE_IN_SMALL_CHUNKS])
def test_children_precede_their_parents_and_form_the_file(size: int) -> None:
    contents: dict[str, bytes] = {}
    sizes: dict[str, int] = {}
    content = b""
    for block in blocks_of_stream(pattern(size)):
        node = parse_block(block.data)
        assert len(node.links) <= 3
        assert [link.size for link in node.links] == [sizes[link.cid] for link in node.links]
        content = b"".join(contents[link.cid] for link in node.links) + node.data
        assert node.file_size == len(content)
        contents[block.cid] = content
        sizes[block.cid] = len(content)
    assert content == (UNIT * 2)[:size]


def test_root_of_two_chunks_links_to_both() -> None:
    *leaves, root = blocks_of_stream(pattern(C + 7))
    node = parse_block(root.data)
    assert [(link.cid, link.size) for link in node.links] == [(leaves[0].cid, C), (leaves[1].cid, 7)]
    assert (node.data, node.file_size) == (b"", C + 7)
    assert parse_block(leaves[1].data).data == (UNIT * 9)[C % PERIOD :][:7]


def test_node_has_at_most_174_links() -> None:
    last = [parse_block(block.data) for block in blocks_of_stream(pattern((MAX_LINKS + 1) * C))]
    assert len(last[-1].links) == 2
    assert max(len(node.links) for node in last) == MAX_LINKS


def test_memory_does_not_grow_with_the_file() -> None:
    tracemalloc.start()
    try:
        for _ in blocks_of_stream(pattern(40 * C)):
            pass
        assert tracemalloc.get_traced_memory()[1] < 8 * C
    finally:
        tracemalloc.stop()


def node_bytes(unixfs_data: bytes, *links: bytes) -> bytes:
    return b"".join(write_bytes(2, link) for link in links) + write_bytes(1, unixfs_data)


ROOT = [*blocks_of_stream(pattern(3 * C))][-1].data
LINK = write_bytes(1, b"\x12\x20" + bytes(32)) + write_bytes(2, b"") + write_number(3, 9)
FILE = write_number(1, 2)


def test_raw_leaves_of_other_writers_are_read() -> None:
    node = parse_block(node_bytes(write_number(1, 0) + write_bytes(2, b"abc") + write_number(3, 3)))
    assert (node.links, node.data, node.file_size) == ((), b"abc", 3)
    assert parse_block(node_bytes(FILE + write_bytes(2, b"abc"))).file_size == 3


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff" * 20,
        b"\x0a",
        b"\x0a\x05\x08",
        b"\x08\x01",
        b"\x80" * 11,
        write_bytes(3, b""),
        write_bytes(1, FILE) * 2,
        node_bytes(b""),
        node_bytes(write_number(1, 1)),
        node_bytes(FILE + FILE),
        node_bytes(FILE + write_number(2, 1)),
        node_bytes(FILE + write_bytes(2, b"abc") + write_number(3, 4)),
        node_bytes(FILE + write_bytes(2, b"abc") + write_bytes(2, b"abc")),
        node_bytes(FILE + write_bytes(4, b"")),
        node_bytes(FILE + write_number(9, 1)),
        node_bytes(FILE + write_number(3, 9), LINK),
        node_bytes(FILE + write_number(3, 0), LINK),
        node_bytes(FILE + write_number(3, 18) + write_number(4, 9) * 2, LINK),
        node_bytes(FILE + write_number(3, 9) + write_number(4, 9), write_bytes(2, b"")),
        node_bytes(FILE + write_number(3, 9) + write_number(4, 9), LINK + LINK),
        node_bytes(FILE + write_number(3, 9) + write_number(4, 9), write_number(1, 5)),
        node_bytes(FILE) + write_number(2, 5),
        node_bytes(FILE + b"\x0d\0\0\0\0"),
        node_bytes(FILE + write_bytes(2, bytes(unixfs.MAX_BLOCK_SIZE))),
    ],
    ids=lambda data: data[:16].hex(),
)
def test_blocks_that_are_not_part_of_a_file_are_refused(data: bytes) -> None:
    with pytest.raises(InputError):
        parse_block(data)


def test_links_with_other_kinds_of_cids_are_refused() -> None:
    cid_version_1 = write_bytes(1, b"\x01\x55\x12\x20" + bytes(32))
    with pytest.raises(InvalidCid):
        parse_block(node_bytes(FILE + write_number(3, 9) + write_number(4, 9), cid_version_1))


@given(st.binary(max_size=200))
def test_any_bytes_parse_or_raise_input_error(data: bytes) -> None:
    with suppress(InputError):
        parse_block(data)


@given(st.integers(0, 400), st.integers(0, 255))
def test_damaged_blocks_parse_or_raise_input_error(position: int, byte: int) -> None:
    position %= len(ROOT)
    for damaged in (ROOT[:position] + bytes([byte]) + ROOT[position + 1 :], ROOT[:position]):
        with suppress(InputError):
            parse_block(damaged)


@given(st.lists(st.tuples(st.integers(1, 1000), st.integers(0, 2**64 - 1) | st.binary(max_size=200))))
def test_protobuf_fields_are_read_as_written(fields: list[tuple[int, int | bytes]]) -> None:
    written = b"".join(
        write_number(number, value) if isinstance(value, int) else write_bytes(number, value)
        for number, value in fields
    )
    assert [*read_fields(written)] == fields


def test_protobuf_numbers_have_64_bits() -> None:
    with pytest.raises(InputError):
        list(read_fields(b"\x08" + b"\xff" * 9 + b"\x02"))
    with pytest.raises(InputError):
        list(read_fields(b"\x08" + b"\x80" * 10 + b"\x01"))
