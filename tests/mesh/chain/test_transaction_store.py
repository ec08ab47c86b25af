"""The transaction store. Locks belong to an open file, so two stores stand for two processes."""

from __future__ import annotations

import errno
import os
import shutil
from typing import TYPE_CHECKING

import pytest

from mesh.chain.accounts import SignedTransaction
from mesh.chain.errors import TransactionDamaged, TransactionsNotKept
from mesh.chain.pending import PendingTransaction, PendingTransactions
from mesh.chain.transaction_store import TransactionStore
from tests.mesh.chain.conftest import raises_with
from tests.support.disks import file_size_limit

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def one(tmp_path: Path) -> TransactionStore:
    return TransactionStore(tmp_path)


@pytest.fixture
def other(tmp_path: Path) -> TransactionStore:
    return TransactionStore(tmp_path)


def _entry(nonce: int) -> PendingTransaction:
    fields = {"to": "0x" + "12" * 20, "data": "0x", "value": 2**255, "gas": 21_000, "gasPrice": 1}
    return PendingTransaction(nonce=nonce, fields=fields, versions=[SignedTransaction(b"\x01", "0x01")])


def test_an_entry_can_be_locked_by_one_process_at_a_time(one: TransactionStore, other: TransactionStore) -> None:
    entry = _entry(7)
    hold = one.add(7, entry.version)
    assert hold is not None
    assert other.read(()) == ({}, frozenset({7}))
    assert other.lock(7) is None
    assert other.add(7, _entry(7).version) is None, "the number is taken"

    hold.release()
    versions, elsewhere = other.read(())
    left = PendingTransaction.stored(7, versions[7])
    assert elsewhere == frozenset()
    assert (left.nonce, left.fields, left.versions, left.is_watched) == (7, entry.fields, entry.versions, False)
    assert other.lock(7) is not None
    assert one.lock(7) is None


def test_a_removed_entry_is_gone_for_all_processes(
    one: TransactionStore, other: TransactionStore, tmp_path: Path
) -> None:
    hold = one.add(7, _entry(7).version)
    assert hold is not None
    hold.remove()
    assert other.read(()) == ({}, frozenset())
    assert list(tmp_path.iterdir()) == []


def test_all_versions_are_read_except_an_incomplete_last_line(one: TransactionStore, tmp_path: Path) -> None:
    entry = _entry(7)
    hold = one.add(7, entry.version)
    assert hold is not None
    entry.fields = entry.fields | {"gasPrice": 2}
    entry.versions.append(SignedTransaction(b"\x02", "0x02"))
    hold.append(entry.version)
    hold.release()
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes() + b'{"hash": "0x0')
    left, _ = one.read(())
    assert [version["hash"] for version in left[7]] == ["0x01", "0x02"]
    assert left[7][-1]["fields"]["gasPrice"] == 2


def test_reading_leaves_out_ones_own_entries(one: TransactionStore) -> None:
    assert one.add(7, _entry(7).version) is not None
    assert one.read({7}) == ({}, frozenset())


def test_a_version_after_an_incomplete_line_is_read(
    one: TransactionStore, other: TransactionStore, tmp_path: Path
) -> None:
    entry = _entry(7)
    hold = one.add(7, entry.version)
    assert hold is not None
    hold.release()
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes() + b'{"hash": "0x0')
    taken_up = other.lock(7)
    assert taken_up is not None
    entry.versions.append(SignedTransaction(b"\x02", "0x02"))
    taken_up.append(entry.version)
    taken_up.release()
    left, _ = one.read(())
    assert [version["hash"] for version in left[7]] == ["0x01", "0x02"]


def test_a_full_disk_is_an_error_and_leaves_nothing_behind(one: TransactionStore, tmp_path: Path) -> None:
    with (
        file_size_limit(16),
        raises_with(TransactionsNotKept, code="transactions-not-kept", folder=tmp_path) as caught,
    ):
        one.add(7, _entry(7).version)
    assert caught.value.why
    assert caught.value.hint
    assert list(tmp_path.iterdir()) == []
    assert one.add(7, _entry(7).version) is not None


def test_a_version_that_does_not_fit_leaves_the_others(one: TransactionStore, tmp_path: Path) -> None:
    entry = _entry(7)
    hold = one.add(7, entry.version)
    assert hold is not None
    (path,) = tmp_path.iterdir()
    entry.versions.append(SignedTransaction(b"\x02", "0x02"))
    with file_size_limit(path.stat().st_size + 16), pytest.raises(TransactionsNotKept):
        hold.append(entry.version)
    hold.append(entry.version)
    hold.release()
    left, _ = one.read(())
    assert [version["hash"] for version in left[7]] == ["0x01", "0x02"]


async def test_a_missing_folder_is_an_error(one: TransactionStore, tmp_path: Path) -> None:
    outbox = PendingTransactions(one)
    entry = _entry(7)
    assert await outbox.add(entry)
    shutil.rmtree(tmp_path)
    with raises_with(TransactionsNotKept, folder=tmp_path, why=os.strerror(errno.ENOENT)):
        await outbox.add(_entry(8))
    outbox.abandon(entry)


def test_a_damaged_entry_is_an_error(one: TransactionStore, tmp_path: Path) -> None:
    (tmp_path / "000000000007.jsonl").write_text("garbage")
    with raises_with(TransactionDamaged, path=tmp_path / "000000000007.jsonl"):
        one.read(())
