"""Every read is checked: damaged files are detected, reported, set aside and fetched again."""

from __future__ import annotations

import asyncio
import os
import random
import sqlite3
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.content import ContentCorrupt, ContentUnavailable, Exchange, Store
from mesh.errors import AiraError, ClosedError
from schemas.unixfs import CHUNK_SIZE, cid_of_bytes
from tests.support.content import ROOT, chunked, flip_bit, leaf, leftovers, parent, put_tree, sample_bytes
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh


@pytest.mark.parametrize("size", [0, 1, CHUNK_SIZE, CHUNK_SIZE + 1, 175 * CHUNK_SIZE + 3])
def test_a_file_is_read_from_any_position(store: Store, size: int) -> None:
    data = sample_bytes(size)
    cid = store.put_bytes(data)
    chance = random.Random(size)
    with store.open(cid) as file:
        assert file.seek(0, os.SEEK_END) == size
        for _ in range(20):
            start, length = chance.randint(0, size + 10), chance.randint(0, 2 * CHUNK_SIZE)
            file.seek(start)
            assert file.read(length) == data[start : start + length]
            assert file.tell() == max(start, min(start + length, size))
        file.seek(0)
        assert file.read() == data


def test_a_file_of_other_chunking_is_read_and_copied(store: Store, tmp_path: Path) -> None:
    data = sample_bytes(50_000)
    cid = put_tree(store, chunked(data, 997))
    with store.open(cid) as file:
        file.seek(12_345)
        assert file.read(3000) == data[12_345:15_345]
    assert store.copy(cid, tmp_path / "copy").read_bytes() == data


def test_a_file_whose_inner_node_contains_bytes_is_read(store: Store) -> None:
    tail = leaf(b"and these")
    cid = put_tree(store, [tail, parent([(tail, 9)], data=b"these ")])
    with store.open(cid) as file:
        assert file.read() == b"these and these"
        file.seek(8)
        assert file.read(3) == b"d t"


def test_reading_a_damaged_block_raises_content_corrupt(store: Store) -> None:
    data = sample_bytes(3 * CHUNK_SIZE)
    cid = store.put_bytes(data)
    flip_bit(store.directory / cid, 2 * CHUNK_SIZE + 9)
    with store.open(cid) as file:
        assert file.read(2 * CHUNK_SIZE) == data[: 2 * CHUNK_SIZE]
        with pytest.raises(ContentCorrupt) as caught:
            file.read(1)
    assert caught.value.cid == cid
    assert store.damaged() == (cid,)
    with pytest.raises(ContentUnavailable):
        store.open(cid)


def test_a_file_that_was_cut_short_is_damaged(store: Store) -> None:
    cid = store.put_bytes(sample_bytes(2 * CHUNK_SIZE))
    path = store.directory / cid
    path.chmod(0o644)
    os.truncate(path, CHUNK_SIZE)
    with store.open(cid) as file, pytest.raises(ContentCorrupt):
        file.read()
    assert store.damaged() == (cid,)


def test_a_copy_is_complete_or_leaves_the_target_unchanged(store: Store, tmp_path: Path) -> None:
    data = sample_bytes(2 * CHUNK_SIZE + 1)
    cid = store.put_bytes(data)
    target = tmp_path / "out" / "copy.bin"
    target.parent.mkdir()
    target.write_bytes(b"what was there")
    reported: list[tuple[int, int | None]] = []
    assert store.copy(cid, target, progress=lambda done, total: reported.append((done, total))) == target
    assert target.read_bytes() == data
    assert reported[-1] == (len(data), len(data))
    assert os.access(target, os.W_OK)
    flip_bit(store.directory / cid, CHUNK_SIZE)
    with pytest.raises(ContentCorrupt):
        store.copy(cid, target)
    assert target.read_bytes() == data
    assert os.listdir(target.parent) == ["copy.bin"]
    with pytest.raises(ContentUnavailable):
        store.copy(cid, target)


def test_checking_the_store_reports_exactly_the_damaged_files(store: Store) -> None:
    cids = [store.put_bytes(sample_bytes(size)) for size in (0, 5, 1000, CHUNK_SIZE + 1, 700_000)]
    other = put_tree(store, chunked(sample_bytes(9000), 1000))
    bad = sorted([cids[2], cids[4]])
    flip_bit(store.directory / cids[2], 999)
    flip_bit(store.directory / cids[4], 0)
    reported: list[tuple[int, int | None]] = []
    found = store.check(progress=lambda done, total: reported.append((done, total)))
    assert list(found.damaged) == bad
    assert (found.files, found.bytes) == (6, 0 + 5 + 1000 + CHUNK_SIZE + 1 + 700_000 + 9000)
    assert reported == sorted(reported)
    assert reported[-1][1] == found.bytes
    assert store.damaged() == tuple(bad)
    assert set(store.list()) == {*cids, other} - set(bad)
    assert store.check().damaged == ()


def test_putting_a_damaged_file_again_repairs_it(store: Store) -> None:
    cid = store.put_bytes(sample_bytes(1000))
    flip_bit(store.directory / cid, 1)
    assert store.checked(cid) is None
    assert store.put_bytes(sample_bytes(1000)) == cid
    assert store.damaged() == ()
    assert store.check().damaged == ()
    assert store.usage().bytes == 1000


def test_a_put_reports_progress(store: Store, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(sample_bytes(3 * CHUNK_SIZE + 1))
    reported: list[tuple[int, int | None]] = []
    store.put_file(source, progress=lambda done, total: reported.append((done, total)))
    assert reported == sorted(reported)
    assert reported.pop() == (3 * CHUNK_SIZE + 1, 3 * CHUNK_SIZE + 1)
    with source.open("rb") as stream:
        store.put_stream(stream, progress=lambda done, total: reported.append((done, total)))
    assert reported.pop() == (3 * CHUNK_SIZE + 1, None)


async def test_only_the_damaged_block_of_a_file_is_fetched_again(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    data = sample_bytes(20 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    store.put_bytes(data)
    flip_bit(store.directory / cid, 7 * CHUNK_SIZE)
    assert store.check().damaged == (cid,)
    async with Exchange(other_session, holder_store) as holder, Exchange(session, store) as exchange:
        assert (await exchange.fetch(cid)).read_bytes() == data
        assert holder.statistics().served == 2, "the root and one leaf"
    assert store.damaged() == ()
    assert leftovers(store.directory) == []


async def test_a_holder_sets_its_damaged_file_aside_and_another_holder_serves_it(
    tmp_path: Path,
    store: Store,
    holder_store: Store,
    session: zenoh.Session,
    other_session: zenoh.Session,
    third_session: zenoh.Session,
) -> None:
    data = sample_bytes(12 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    flip_bit(holder_store.directory / cid, 5 * CHUNK_SIZE + 1)
    with Store(tmp_path / "good") as good_store:
        good_store.put_bytes(data)
        async with Exchange(other_session, holder_store) as damaged, Exchange(session, store) as exchange:
            fetching = asyncio.create_task(exchange.fetch(cid, timeout=60))
            await until(lambda: holder_store.damaged() == (cid,), what="the damage found", seconds=60)
            async with Exchange(third_session, good_store):
                assert (await fetching).read_bytes() == data
                assert exchange.statistics().corrupt_blocks == {}, "a holder with a damaged file sends nothing corrupt"
                assert (await damaged.fetch(cid)).read_bytes() == data
    assert holder_store.check().damaged == ()
    assert holder_store.list() == (cid,)


def test_an_index_in_use_is_not_rebuilt(store: Store) -> None:
    store.put_bytes(b"held")
    store.close()
    with Store(store.directory) as user:
        index = store.directory / ".blocks.sqlite"
        subprocess.run(
            [sys.executable, "-c", f"open({str(index)!r}, 'r+b').write(b'no index' * 100)"], cwd=ROOT, check=True
        )
        for rest in ("-wal", "-shm"):
            index.with_name(index.name + rest).unlink(missing_ok=True)
        with raises_with(AiraError, code="store-damaged") as caught:
            Store(store.directory)
        assert str(store.directory) in str(caught.value)
        assert caught.value.hint
        user.close()
    with Store(store.directory) as again:
        assert again.list() == (cid_of_bytes(b"held"),)
        assert again.get_block(cid_of_bytes(b"held")) is not None


def test_a_broken_index_raises_store_damaged(store: Store) -> None:
    store.put_bytes(b"held")
    with sqlite3.connect(store.directory / ".blocks.sqlite") as other:
        other.execute("DROP TABLE block")
    other.close()
    with raises_with(AiraError, code="store-damaged"):
        store.get_block(cid_of_bytes(b"held"))
    with raises_with(AiraError, code="store-damaged"):
        store.put_bytes(b"more")


def test_a_closed_store_raises_closed_error(store: Store) -> None:
    store.close()
    store.close()
    with pytest.raises(ClosedError):
        store.put_bytes(b"late")
    assert leftovers(store.directory) == []
