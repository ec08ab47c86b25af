from __future__ import annotations

import io
import random
import resource
import signal
import subprocess
import sys
import tracemalloc
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from mesh.content import ContentCorrupt, ContentTooLarge, ContentUnavailable, Store, StoreFull
from mesh.content.store import BlockIndex
from mesh.errors import ConfigurationError, InvalidCid
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream, cid_of_bytes
from tests.support.content import ROOT, RandomStream, chunked, flip_bit, leftovers

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

EMPTY_FILE = "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH"


@pytest.mark.parametrize(
    "size", [0, 1, CHUNK_SIZE - 1, CHUNK_SIZE, CHUNK_SIZE + 1, 2 * CHUNK_SIZE, 174 * CHUNK_SIZE + 1]
)
def test_a_file_is_stored_under_its_cid_with_all_its_blocks(store: Store, size: int) -> None:
    data = random.Random(size).randbytes(size)
    cid = store.put_bytes(data)
    assert cid == cid_of_bytes(data)
    assert store.has(cid)
    assert store.list() == (cid,)
    with store.open(cid) as file:
        assert file.read() == data
    for block in blocks_of_stream(io.BytesIO(data)):
        assert store.get_block(block.cid) == block.data


def test_the_empty_file_has_its_documented_cid(store: Store) -> None:
    assert store.put_bytes(b"") == EMPTY_FILE


def test_storing_a_stream_takes_constant_memory(store: Store) -> None:
    store.put_bytes(b"what is loaded once is not counted")
    tracemalloc.start()
    try:
        store.put_stream(RandomStream(64 << 20))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 4 << 20


def test_a_file_that_is_not_held_is_unavailable(store: Store) -> None:
    assert not store.has(EMPTY_FILE)
    assert store.path(EMPTY_FILE) is None
    assert store.checked(EMPTY_FILE) is None
    assert store.get_block(EMPTY_FILE) is None
    with pytest.raises(ContentUnavailable):
        store.open(EMPTY_FILE)
    with pytest.raises(ContentUnavailable):
        store.verify(EMPTY_FILE)


@pytest.mark.parametrize("name", ["", "../secret", "Qm", EMPTY_FILE + "/x", ".lock"])
def test_only_cids_reach_the_disk(store: Store, name: str) -> None:
    for call in (store.path, store.has, store.checked, store.verify, store.open, store.get_block, store.assemble):
        with pytest.raises(InvalidCid):
            call(name)


def test_a_failing_source_leaves_no_files(store: Store) -> None:
    with pytest.raises(OSError, match="the source broke"):
        store.put_stream(RandomStream(3 << 20, fail_at=1 << 20))
    assert store.list() == ()
    assert leftovers(store.directory) == []


def test_a_source_that_fails_late_leaves_nothing_in_the_index(store: Store) -> None:
    with pytest.raises(OSError, match="the source broke"):
        store.put_stream(RandomStream(40 << 20, fail_at=1 << 20))
    with closing(BlockIndex(store.directory / ".blocks.sqlite")) as index:
        assert index.files() == []


def test_over_the_limit_nothing_is_kept(tmp_path: Path) -> None:
    with Store(tmp_path, limit=1000) as store:
        store.put_bytes(bytes(1000))
        with pytest.raises(ContentTooLarge) as caught:
            store.put_bytes(bytes(1001))
        assert (caught.value.size, caught.value.limit) == (1001, 1000)
        assert len(store.list()) == 1
        assert leftovers(tmp_path) == []


@pytest.fixture
def files_of_a_mebibyte() -> Iterator[None]:
    """The operating system refuses to write beyond 1 MiB of a file, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.usefixtures("files_of_a_mebibyte")
def test_a_full_disk_raises_store_full_and_leaves_no_files(store: Store) -> None:
    with pytest.raises(StoreFull):
        store.put_bytes(bytes(3 << 20))
    assert store.list() == ()
    assert leftovers(store.directory) == []


def test_a_damaged_file_is_detected_and_set_aside(store: Store) -> None:
    data = random.Random(1).randbytes(600_000)
    cid = store.put_bytes(data)
    flip_bit(store.directory / cid, 300_000)
    with pytest.raises(ContentCorrupt):
        store.verify(cid)
    assert not store.has(cid)
    assert leftovers(store.directory) == []
    assert (store.directory / f"{cid}.corrupt").exists()
    assert store.put_bytes(data) == cid
    assert store.verify(cid).read_bytes() == data


def test_a_file_that_changed_after_it_was_checked_is_hashed_again(store: Store) -> None:
    cid = store.put_bytes(bytes(1000))
    assert store.checked(cid) is not None
    flip_bit(store.directory / cid, 10)
    assert store.checked(cid) is None


def test_damaged_bytes_are_never_served_as_a_block(store: Store) -> None:
    data = random.Random(2).randbytes(2 * CHUNK_SIZE)
    cid = store.put_bytes(data)
    first, second, root = blocks_of_stream(io.BytesIO(data))
    flip_bit(store.directory / cid, CHUNK_SIZE + 5)
    assert store.get_block(first.cid) == first.data
    assert store.damaged() == ()
    assert store.get_block(second.cid) is None
    assert store.damaged() == (cid,)
    assert not store.has(cid)
    assert store.get_block(root.cid) is None


def test_a_block_of_two_files_is_found_after_one_is_deleted(store: Store) -> None:
    shared = random.Random(3).randbytes(CHUNK_SIZE)
    cids = [store.put_bytes(shared + tail) for tail in (b"one", b"two")]
    block = next(iter(blocks_of_stream(io.BytesIO(shared))))
    for cid in cids:
        assert store.get_block(block.cid) == block.data
        (store.directory / cid).unlink()
    assert store.get_block(block.cid) is None


@pytest.mark.parametrize("damage", ["gone", "garbage"])
def test_a_lost_or_broken_index_is_rebuilt(tmp_path: Path, damage: str) -> None:
    data = random.Random(4).randbytes(CHUNK_SIZE + 1)
    with Store(tmp_path) as store:
        cid = store.put_bytes(data)
    index = tmp_path / ".blocks.sqlite"
    if damage == "gone":
        index.unlink()
    else:
        index.write_bytes(b"this is no index" * 1000)
    with Store(tmp_path) as store:
        for block in blocks_of_stream(io.BytesIO(data)):
            assert store.get_block(block.cid) == block.data
        assert store.list() == (cid,)


def test_a_file_with_the_wrong_cid_is_set_aside(tmp_path: Path) -> None:
    (tmp_path / EMPTY_FILE).write_bytes(b"not empty")
    with Store(tmp_path) as store:
        assert store.list() == ()
    assert (tmp_path / f"{EMPTY_FILE}.corrupt").read_bytes() == b"not empty"


def test_a_file_of_other_chunking_is_checked_by_its_tree(store: Store) -> None:
    data = random.Random(5).randbytes(10_000)
    *leaves, root = chunked(data, 1000)
    with store.assemble(root.cid) as assembly:
        places = assembly.put(assembly.root, root.data)
        for place, leaf in zip(places, leaves, strict=True):
            assert assembly.put(place, leaf.data) == []
        path = assembly.finish()
    assert path.read_bytes() == data
    assert store.verify(root.cid) == path
    assert [store.get_block(block.cid) for block in leaves] == [block.data for block in leaves]
    flip_bit(path, 5000)
    with pytest.raises(ContentCorrupt):
        store.verify(root.cid)


def test_an_unusable_directory_raises_configuration_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError) as caught:
        Store(tmp_path / "file" / "store")
    assert caught.value.hint


WRITER = """
import sys
from mesh.content import Store
number, directory = int(sys.argv[1]), sys.argv[2]
with Store(directory) as store:
    for size in range(1, 40):
        store.put_bytes(bytes([7]) * size * 9000)
        store.put_bytes(bytes([number]) * size * 9000)
"""

STUCK_WRITER = """
import sys, io
from mesh.content import Store
class Stuck(io.RawIOBase):
    count = 0
    def read(self, size=-1):
        self.count += 1
        if self.count == 20:
            print("writing", flush=True)
            sys.stdin.read()
        return bytes(size)
Store(sys.argv[1]).put_stream(Stuck())
"""


def test_processes_may_share_a_directory(tmp_path: Path) -> None:
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(number), str(tmp_path)], cwd=ROOT) for number in range(3)
    ]
    assert [writer.wait(300) for writer in writers] == [0, 0, 0]
    with Store(tmp_path) as store:
        held = store.list()
        assert len(held) == 4 * 39
        assert all(store.verify(cid) for cid in held)
    assert leftovers(tmp_path) == []


def test_files_of_killed_writers_are_deleted_and_those_of_live_ones_kept(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", STUCK_WRITER, str(tmp_path)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"writing\n"
        with Store(tmp_path) as store:
            assert store.list() == ()
        assert len(leftovers(tmp_path)) == 1
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    with Store(tmp_path) as store:
        assert store.list() == ()
    assert leftovers(tmp_path) == []
