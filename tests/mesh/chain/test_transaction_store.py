"""The table of sent transactions. Locks belong to an open file, so two stores stand for two processes."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from mesh.chain._accounts import SignedTransaction
from mesh.chain._pending import FILE, PendingTransaction, PendingTransactions, TransactionStore
from mesh.errors import ConfigurationError
from tests.support.disks import file_size_limit, synced
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["synced"]


@pytest.fixture
def one(tmp_path: Path) -> Iterator[TransactionStore]:
    with closing(TransactionStore(tmp_path)) as store:
        yield store


@pytest.fixture
def other(tmp_path: Path) -> Iterator[TransactionStore]:
    with closing(TransactionStore(tmp_path)) as store:
        yield store


def _entry(nonce: int) -> PendingTransaction:
    fields = {"to": "0x" + "12" * 20, "data": "0x", "value": 2**255, "gas": 21_000, "gasPrice": 1}
    return PendingTransaction(nonce=nonce, fields=fields, versions=[SignedTransaction(b"\x01", "0x01")])


def test_one_process_at_a_time_waits_for_a_transaction(one: TransactionStore, other: TransactionStore) -> None:
    entry = _entry(7)
    assert one.add(7, entry.as_json)
    assert one.read() == ({}, frozenset())
    assert other.read() == ({}, frozenset({7}))
    assert not other.take(7)
    assert not other.add(7, _entry(7).as_json), "the number is taken"

    one.release(7)
    kept, elsewhere = other.read()
    left = PendingTransaction.of_json(7, kept[7])
    assert elsewhere == frozenset()
    assert (left.nonce, left.fields, left.versions, left.is_watched) == (7, entry.fields, entry.versions, False)
    assert other.take(7)
    assert not one.take(7)
    one.remove(7)
    one.release(7)
    assert one.read() == ({}, frozenset({7})), "it is the other's"


def test_what_a_process_that_ended_has_left_is_taken_by_another(one: TransactionStore, tmp_path: Path) -> None:
    ended = TransactionStore(tmp_path)
    assert ended.add(7, _entry(7).as_json)
    assert not one.take(7)
    ended.close()
    assert list(one.read()[0]) == [7]
    assert one.take(7)
    assert one.read() == ({}, frozenset())


def test_a_killed_process_leaves_its_transactions_and_its_lock_is_cleared(
    one: TransactionStore, tmp_path: Path
) -> None:
    killed = TransactionStore(tmp_path)
    assert killed.add(7, _entry(7).as_json)
    (name,) = {path.name for path in tmp_path.glob("*.lock")} - {f"{one._owner}.lock"}
    assert killed._descriptor is not None
    os.close(killed._descriptor)  # as the system does
    killed._descriptor = None
    killed._database.close()
    assert (tmp_path / name).exists()
    with closing(TransactionStore(tmp_path)) as next_one:
        assert not (tmp_path / name).exists()
        assert next_one.take(7)
        assert one.read() == ({}, frozenset({7}))


def test_a_removed_entry_is_gone_for_all_processes(one: TransactionStore, other: TransactionStore) -> None:
    assert one.add(7, _entry(7).as_json)
    one.remove(7)
    assert other.read() == ({}, frozenset())
    assert other.add(7, _entry(7).as_json)


def test_all_versions_are_read(one: TransactionStore, other: TransactionStore) -> None:
    entry = _entry(7)
    assert one.add(7, entry.as_json)
    entry.fields = entry.fields | {"gasPrice": 2}
    entry.versions.append(SignedTransaction(b"\x02", "0x02"))
    one.update(7, entry.as_json)
    one.release(7)
    left, _ = other.read()
    assert list(left[7]["versions"]) == ["0x01", "0x02"]
    assert left[7]["fields"]["gasPrice"] == 2


def test_closing_leaves_the_table_only(tmp_path: Path) -> None:
    TransactionStore(tmp_path).close()
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


async def test_a_full_disk_is_an_error_and_leaves_nothing_behind(one: TransactionStore, tmp_path: Path) -> None:
    entry = _entry(7)
    entry.fields["data"] = "0x" + "00" * 100_000
    with (
        file_size_limit(1 << 16),
        raises_with(ConfigurationError, code="transactions-not-kept", match=str(tmp_path)) as caught,
    ):
        one.add(7, entry.as_json)
    assert caught.value.hint
    assert one.add(7, _entry(7).as_json)


async def test_a_version_that_does_not_fit_leaves_the_others(one: TransactionStore) -> None:
    entry, pending = _entry(7), PendingTransactions(one)
    assert await pending.add(entry)
    large = {**entry.fields, "data": "0x" + "00" * 100_000}
    with file_size_limit(1 << 16), raises_with(ConfigurationError, code="transactions-not-kept"):
        await pending.add_version(entry, large, SignedTransaction(b"\x02", "0x02"))
    pending.abandon(entry)
    left, _ = one.read()
    assert list(left[7]["versions"]) == ["0x01"]


async def test_a_missing_folder_is_an_error(one: TransactionStore, tmp_path: Path) -> None:
    pending = PendingTransactions(one)
    shutil.rmtree(tmp_path)
    with raises_with(ConfigurationError, code="transactions-not-kept", match=os.strerror(errno.ENOENT)):
        await pending.add(_entry(8))
    assert pending.taken == frozenset()


async def test_what_can_not_be_synced_is_not_sent(one: TransactionStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, "the disk is broken")

    pending = PendingTransactions(one)
    with monkeypatch.context() as broken:
        broken.setattr(os, "fsync", fail)
        with raises_with(ConfigurationError, code="transactions-not-kept"):
            await pending.add(_entry(7))
    assert one.read() == ({}, frozenset())
    assert await pending.add(_entry(7))


async def test_a_full_disk_stops_nobody_who_stops_waiting(one: TransactionStore, other: TransactionStore) -> None:
    """A task that is cancelled must end as cancelled."""
    pending, entry, settled = PendingTransactions(one), _entry(7), _entry(8)
    assert await pending.add(entry)
    assert await pending.add(settled)
    with file_size_limit(1):
        pending.abandon(entry)
        pending.forget(settled)
    await pending.refresh()
    assert pending.abandoned == (entry,)
    assert await pending.take_over(entry)
    pending.abandon(entry)
    assert list(other.read()[0]) == [7]
    later = _entry(9)
    assert await pending.add(later)
    pending.forget(later)
    assert other.read()[1] == frozenset()


async def test_what_another_process_left_behind_is_on_the_disk_before_it_is_sent_again(
    one: TransactionStore, other: TransactionStore, synced: list[str]
) -> None:
    pending = PendingTransactions(other)
    await pending.refresh()
    assert one.add(7, _entry(7).as_json)
    one.release(7)
    assert synced == []
    await pending.refresh()
    assert [entry.nonce for entry in pending.abandoned] == [7]
    await pending.refresh()
    assert synced == [f"{FILE}-wal"]


def test_what_could_not_be_removed_does_not_block_its_nonce(one: TransactionStore, other: TransactionStore) -> None:
    assert one.add(7, {"hash": "0x01"})
    assert one.add(7, {"hash": "0x02"})
    assert not other.add(7, {"hash": "0x03"})
    one.release(7)
    assert other.read() == ({7: {"hash": "0x02"}}, frozenset())


def test_a_damaged_entry_is_an_error(one: TransactionStore, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / FILE) as database:
        database.execute("INSERT INTO transactions VALUES (7, '', 'garbage')")
    database.close()
    with raises_with(ConfigurationError, code="transaction-damaged", match=str(tmp_path / FILE)):
        one.read()


def test_a_damaged_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"not a database, however you look at it" * 100)
    with raises_with(ConfigurationError, code="transaction-damaged", match=str(tmp_path / FILE)):
        TransactionStore(tmp_path)
