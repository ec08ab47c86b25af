"""Eviction, pins, and the errors of a full store."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from io import BytesIO
from typing import TYPE_CHECKING

import pytest

from mesh.content import ContentTooLarge, ContentUnavailable, Store, StoreFull
from mesh.errors import AiraError, InputError, InvalidCid
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream, cid_of_bytes
from tests.support.content import ROOT, RandomStream, flip_bit, leftovers
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

KIB = 1024
JOB = "0x" + "ab" * 20


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Store]:
    """A store of 100 KiB in all."""
    with Store(tmp_path / "small", quota=100 * KIB) as opened:
        yield opened


def file_of(kibibytes: int, seed: int = 0) -> bytes:
    return random.Random(1000 * seed + kibibytes).randbytes(kibibytes * KIB)


def bytes_on_disk(store: Store) -> int:
    """The bytes of all files except the store's own."""
    files = (store.directory / name for name in os.listdir(store.directory) if name[0] != "." or name[:2] == ".p")
    return sum(path.stat().st_size for path in files if path.is_file())


def test_the_least_recently_used_files_are_evicted_first(small: Store) -> None:
    first, second, third = (small.put_bytes(file_of(30, seed)) for seed in range(3))
    assert small.get_block(first) is not None
    with small.open(second) as file:
        file.read(1)
    assert small.checked(first) is not None
    assert [entry.cid for entry in small.entries()] == [third, second, first]
    fourth = small.put_bytes(file_of(30, 4))
    assert set(small.list()) == {first, second, fourth}
    small.put_bytes(file_of(60, 5))
    assert set(small.list()) == {fourth, cid_of_bytes(file_of(60, 5))}
    assert small.usage().bytes == bytes_on_disk(small) == 90 * KIB


def test_only_as_much_as_needed_is_evicted(small: Store) -> None:
    cids = [small.put_bytes(file_of(10, seed)) for seed in range(10)]
    small.put_bytes(file_of(1))
    assert set(small.list()) >= set(cids[1:])
    assert not small.has(cids[0])


def test_a_pinned_file_is_never_evicted(small: Store) -> None:
    kept = small.put_bytes(file_of(50), pin=JOB)
    other = small.put_bytes(file_of(40))
    small.put_bytes(file_of(45))
    assert small.has(kept)
    assert not small.has(other)
    assert small.usage().pinned_bytes == 50 * KIB
    small.release(JOB)
    small.put_bytes(file_of(90))
    assert not small.has(kept)


def test_if_eviction_can_not_free_enough_nothing_is_evicted(small: Store) -> None:
    small.put_bytes(file_of(60), pin=JOB)
    other = small.put_bytes(file_of(30))
    with raises_with(StoreFull, code="quota-reached") as caught:
        small.put_bytes(file_of(41))
    error = caught.value
    assert f": {KIB} bytes exceed its quota of {100 * KIB}, of which {60 * KIB} are in use" in str(error)
    assert "\n" not in str(error)
    assert error.hint
    assert small.has(other)
    assert leftovers(small.directory) == []
    assert small.usage().bytes == 90 * KIB


def test_a_stream_of_unknown_size_stops_at_the_quota(small: Store) -> None:
    kept = small.put_bytes(file_of(60), pin=JOB)
    with raises_with(StoreFull, code="quota-reached"):
        small.put_stream(RandomStream(1 << 30))
    assert small.list() == (kept,)
    assert leftovers(small.directory) == []
    assert small.usage().bytes == bytes_on_disk(small) == 60 * KIB


def test_a_stream_of_unknown_size_evicts_as_it_grows(small: Store) -> None:
    small.put_bytes(file_of(60))
    cid = small.put_stream(RandomStream(99 * KIB))
    assert small.list() == (cid,)
    assert small.usage().bytes == 99 * KIB


def test_a_file_larger_than_the_quota_evicts_nothing(small: Store) -> None:
    held = small.put_bytes(file_of(10))
    with raises_with(StoreFull, code="quota-reached"):
        small.put_bytes(file_of(101))
    assert small.has(held)


def test_a_file_over_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with Store(tmp_path / "store", limit=KIB) as store:
        source = tmp_path / "huge"
        with source.open("wb") as file:
            file.truncate(1 << 40)
        with pytest.raises(ContentTooLarge) as caught:
            store.put_file(source)
        assert (caught.value.size, caught.value.limit) == (1 << 40, KIB)


def test_a_fetch_reserves_its_size_when_the_root_arrives(small: Store) -> None:
    small.put_bytes(file_of(60), pin=JOB)
    *_, root = blocks_of_stream(BytesIO(bytes(2 * CHUNK_SIZE)))
    with small.assemble(root.cid) as assembly, raises_with(StoreFull, code="quota-reached"):
        assembly.put(assembly.root, root.data)
    assert leftovers(small.directory) == []
    assert small.usage().bytes == 60 * KIB


def test_an_unfinished_fetch_is_evicted_unless_pinned(small: Store) -> None:
    data = file_of(60)
    for pinned in (True, False):
        (block,) = blocks_of_stream(BytesIO(file_of(60, 9)))
        with small.assemble(block.cid) as assembly:
            assembly.put(assembly.root, block.data)
        assert small.usage().bytes == 60 * KIB
        if pinned:
            small.pin(block.cid)
            with raises_with(StoreFull, code="quota-reached"):
                small.put_bytes(data[: 50 * KIB])
            small.unpin(block.cid)
        else:
            small.put_bytes(data[: 50 * KIB])
            assert leftovers(small.directory) == []


def test_a_damaged_file_is_evicted_first(small: Store) -> None:
    bad = small.put_bytes(file_of(50), pin=JOB)
    good = small.put_bytes(file_of(40))
    flip_bit(small.directory / bad, 10)
    assert small.check().damaged == (bad,)
    small.put_bytes(file_of(20))
    assert small.damaged() == ()
    assert small.has(good)


def test_collect_evicts_down_to_the_given_quota(small: Store) -> None:
    cids = [small.put_bytes(file_of(10, seed)) for seed in range(5)]
    small.pin(cids[0])
    assert small.collect().cids == ()
    collected = small.collect(25 * KIB)
    assert collected.cids == tuple(cids[1:4])
    assert collected.bytes == 30 * KIB
    assert small.collect(0).cids == (cids[4],)
    assert small.list() == (cids[0],)


def test_a_smaller_quota_applies_from_the_next_put(small: Store) -> None:
    for seed in range(9):
        small.put_bytes(file_of(10, seed))
    small.close()
    with Store(small.directory, quota=35 * KIB) as again:
        assert again.usage().files == 9
        again.put_bytes(file_of(20))
        assert again.usage().bytes == 30 * KIB


def test_without_a_quota_nothing_is_evicted(store: Store) -> None:
    cid = store.put_bytes(file_of(10))
    assert store.collect().bytes == 0
    assert store.usage().quota is None
    assert store.collect(0).cids == (cid,)


def test_a_file_is_removed_unless_it_is_pinned(store: Store) -> None:
    cid = store.put_bytes(b"one")
    store.pin(cid)
    store.pin(cid, JOB)
    with raises_with(AiraError, code="content-pinned", match=f"{JOB}, user"):
        store.remove(cid)
    store.unpin(cid)
    store.release(JOB)
    store.remove(cid)
    assert not store.has(cid)
    assert store.get_block(cid) is None
    assert store.usage().bytes == 0
    with pytest.raises(ContentUnavailable):
        store.remove(cid)


def test_pins_survive_the_process_the_file_and_the_index(store: Store) -> None:
    wanted, held = cid_of_bytes(b"not here yet"), store.put_bytes(b"here", pin=JOB)
    store.pin(wanted, JOB)
    store.pin(wanted)
    store.close()
    (store.directory / ".blocks.sqlite").unlink()
    with Store(store.directory) as again:
        assert again.pins() == {held: {JOB}, wanted: {JOB, "user"}}
        assert again.put_bytes(b"not here yet") == wanted
        again.collect(0)
        assert set(again.list()) == {held, wanted}
        again.release(JOB)
        assert again.pins() == {wanted: {"user"}}
        again.unpin(wanted, "nobody")


def test_a_pin_that_exists_is_synced_all_the_same(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that set it may have been killed before it was on the disk."""
    wanted = cid_of_bytes(b"not here yet")
    (store.directory / ".pins" / f"{wanted}.{JOB}").touch()
    synced, fsync = list[str](), os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))

    monkeypatch.setattr(os, "fsync", noted)
    store.pin(wanted, JOB)
    assert str(store.directory / ".pins") in synced


@pytest.mark.parametrize("label", ["", "a/b", "..", "x" * 65, "a b", "a.b", "ä"])
def test_invalid_labels_are_refused(store: Store, label: str) -> None:
    with pytest.raises(InputError):
        store.pin(cid_of_bytes(b""), label)
    with pytest.raises(InputError):
        store.release(label)
    with pytest.raises(InputError):
        store.put_bytes(b"", pin=label)
    assert store.list() == ()
    with pytest.raises(InvalidCid):
        store.pin("../../etc/passwd")


def test_a_file_that_is_put_again_counts_once(small: Store) -> None:
    for _ in range(3):
        small.put_bytes(file_of(40))
    assert small.usage().bytes == 40 * KIB
    assert small.usage().files == 1


GREEDY_WRITER = """
import random, sys
from mesh.content import Store
number, directory, quota = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
with Store(directory, quota=quota) as store:
    mine = store.put_bytes(bytes([number]) * 5000, pin=f"writer-{number}")
    for size in range(1, 60):
        store.put_bytes(random.Random(1000 * number + size).randbytes(size * 400))
        assert store.usage().bytes <= quota
    assert store.has(mine)
"""


def test_processes_together_stay_within_the_quota(tmp_path: Path) -> None:
    quota = 120_000
    writers = [
        subprocess.Popen([sys.executable, "-c", GREEDY_WRITER, str(number), str(tmp_path), str(quota)], cwd=ROOT)
        for number in range(3)
    ]
    assert [writer.wait(300) for writer in writers] == [0, 0, 0]
    with Store(tmp_path, quota=quota) as store:
        assert store.usage().bytes == bytes_on_disk(store) <= quota
        assert store.check().damaged == ()
        assert set(store.pins()) <= set(store.list())
    assert leftovers(tmp_path) == []


def test_damaged_files_are_evicted_first_even_after_the_index_was_rebuilt(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        files = [store.put_bytes(bytes([number]) * 1_000) for number in range(20)]
        damaged, sound = files[::4], [cid for number, cid in enumerate(files) if number % 4]
        for cid in damaged:
            flip_bit(tmp_path / cid, 0)
        store.check()
        assert len(store.damaged()) == 5
    for index in tmp_path.glob(".blocks.sqlite*"):
        index.unlink()
    with Store(tmp_path) as store:
        assert store.collect(15_000).bytes == 5_000
        assert store.damaged() == ()
        assert all(map(store.has, sound))
