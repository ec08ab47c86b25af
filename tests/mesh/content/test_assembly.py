from __future__ import annotations

import io
import random
from typing import TYPE_CHECKING

import pytest

from mesh.content import Assembly, BlockRef, ContentCorrupt, ContentTooLarge, Store
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream
from tests.support.content import block_of, leaf, parent

if TYPE_CHECKING:
    from schemas.unixfs import UnixfsBlock


def put_all(assembly: Assembly, blocks: dict[str, bytes], *, at_most: int = 10_000) -> int:
    """Put the blocks from the root down. Returns how many were not on the disk yet."""
    waiting, given = [assembly.root], 0
    while waiting and given < at_most:
        place = waiting.pop(0)
        block = assembly.local(place)
        if block is None:
            block = blocks[place.cid]
            given += 1
        waiting.extend(assembly.put(place, block))
    return given


def blocks_of(data: bytes) -> tuple[str, dict[str, bytes]]:
    blocks = {block.cid: block.data for block in blocks_of_stream(io.BytesIO(data))}
    return list(blocks)[-1], blocks


def refused(store: Store, blocks: list[UnixfsBlock]) -> ContentCorrupt:
    """The error of assembling a tree, the root last."""
    with store.assemble(blocks[-1].cid) as assembly, pytest.raises(ContentCorrupt) as caught:
        put_all(assembly, {block.cid: block.data for block in blocks})
    assert caught.value.cid == blocks[-1].cid
    assert store.list() == ()
    return caught.value


def test_a_file_is_assembled_from_blocks_in_any_order(store: Store) -> None:
    data = random.Random(1).randbytes(200 * CHUNK_SIZE)
    cid, blocks = blocks_of(data)
    with store.assemble(cid) as assembly:
        waiting = assembly.put(assembly.root, blocks[cid])
        while waiting:
            place = waiting.pop(random.Random(len(waiting)).randrange(len(waiting)))
            waiting.extend(assembly.put(place, blocks[place.cid]))
        assert assembly.finish() == store.path(cid)
    with store.open(cid) as file:
        assert file.read() == data
    assert all(store.get_block(name) == block for name, block in blocks.items())


def test_a_block_with_another_hash_is_refused_and_the_right_one_still_accepted(store: Store) -> None:
    cid, blocks = blocks_of(b"the truth")
    with store.assemble(cid) as assembly:
        with pytest.raises(ContentCorrupt):
            assembly.put(assembly.root, leaf(b"a lie").data)
        assert assembly.put(assembly.root, blocks[cid]) == []
        assert assembly.finish().read_bytes() == b"the truth"


def test_a_file_that_is_too_large_is_refused_by_its_root(store: Store) -> None:
    cid, blocks = blocks_of(bytes(CHUNK_SIZE + 1))
    with store.assemble(cid, size_limit=CHUNK_SIZE) as assembly, pytest.raises(ContentTooLarge) as caught:
        assembly.put(assembly.root, blocks[cid])
    assert (caught.value.cid, caught.value.size, caught.value.limit) == (cid, CHUNK_SIZE + 1, CHUNK_SIZE)


def test_a_caller_can_not_raise_the_limit_of_the_store(store: Store) -> None:
    huge = parent([(leaf(b"x"), 1)], sizes=[store.limit + 1])
    with store.assemble(huge.cid, size_limit=1 << 60) as assembly, pytest.raises(ContentTooLarge):
        assembly.put(assembly.root, huge.data)


def test_a_part_longer_than_its_link_says_is_refused(store: Store) -> None:
    part = leaf(bytes(1000))
    assert refused(store, [part, parent([(part, 1000)], sizes=[1])]).reason == "wrong-size"


def test_a_block_that_is_not_a_file_is_refused(store: Store) -> None:
    assert refused(store, [block_of(b"\x0a\x02\x08\x01")]).reason == "not-a-file"


def test_links_to_empty_parts_are_refused(store: Store) -> None:
    empty = leaf(b"")
    assert refused(store, [empty, parent([(empty, 0), (empty, 0)])]).reason == "empty-part"


def test_an_inner_node_may_contain_bytes_of_the_file(store: Store) -> None:
    tail = leaf(b"and these")
    root = parent([(tail, 9)], data=b"these ")
    with store.assemble(root.cid) as assembly:
        put_all(assembly, {root.cid: root.data, tail.cid: tail.data})
        assert assembly.finish().read_bytes() == b"these and these"


def test_a_repeated_block_is_needed_once(store: Store) -> None:
    cid, blocks = blocks_of(bytes(50 * CHUNK_SIZE))
    with store.assemble(cid) as assembly:
        assert put_all(assembly, blocks) == 2
        assert assembly.finish().read_bytes() == bytes(50 * CHUNK_SIZE)


def test_blocks_of_files_already_held_are_not_needed(store: Store) -> None:
    data = random.Random(2).randbytes(4 * CHUNK_SIZE)
    store.put_bytes(data)
    cid, blocks = blocks_of(data + b"more")
    with store.assemble(cid) as assembly:
        assert put_all(assembly, blocks) == 2
        assembly.finish()
    assert store.has(cid)


def test_an_interrupted_assembly_is_continued(store: Store) -> None:
    cid, blocks = blocks_of(random.Random(3).randbytes(10 * CHUNK_SIZE))
    with store.assemble(cid) as assembly:
        put_all(assembly, blocks, at_most=7)
    assert not store.has(cid)
    with Store(store.directory) as again, again.assemble(cid) as assembly:
        assert put_all(assembly, blocks) == 4
        assembly.finish()
    assert store.verify(cid) == store.path(cid)


def test_damaged_blocks_of_an_earlier_attempt_are_not_used(store: Store) -> None:
    data = random.Random(4).randbytes(3 * CHUNK_SIZE)
    cid, blocks = blocks_of(data)
    with store.assemble(cid) as assembly:
        put_all(assembly, blocks, at_most=3)
    part = next(store.directory.glob(".part-*"))
    part.write_bytes(b"\0" + part.read_bytes()[1:] + b"longer than the file will be" * 100_000)
    with store.assemble(cid) as assembly:
        assert put_all(assembly, blocks) == 2, "the damaged leaf and the missing one"
        assert assembly.finish().read_bytes() == data


def test_two_assemblies_of_one_file_do_not_interfere(store: Store) -> None:
    data = random.Random(5).randbytes(3 * CHUNK_SIZE)
    cid, blocks = blocks_of(data)
    with store.assemble(cid) as first, store.assemble(cid) as second:
        put_all(first, blocks)
        put_all(second, blocks, at_most=2)
        first.finish()
        put_all(second, blocks)
        second.finish()
    assert store.verify(cid).read_bytes() == data
    assert list(store.directory.glob(".p*-*")) == []


def test_references_have_offset_size_and_depth(store: Store) -> None:
    cid, blocks = blocks_of(random.Random(6).randbytes(2 * CHUNK_SIZE + 7))
    with store.assemble(cid) as assembly:
        places = assembly.put(assembly.root, blocks[cid])
    assert [(place.offset, place.size, place.depth) for place in places] == [
        (0, CHUNK_SIZE, 1),
        (CHUNK_SIZE, CHUNK_SIZE, 1),
        (2 * CHUNK_SIZE, 7, 1),
    ]
    assert assembly.root == BlockRef(cid)
