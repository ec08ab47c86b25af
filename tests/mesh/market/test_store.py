"""The file of what a provider must not forget."""

from __future__ import annotations

import asyncio
import os
import sqlite3
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError
from mesh.market._orders import SentOrder, SettledOrders
from mesh.market.store import MarketStore
from tests.support.disks import file_size_limit
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

FIRST = SentOrder(b"1" * 52, "aa" * 32, "0xA", 9)
SECOND = SentOrder(b"2" * 52, "", "", 9)


async def test_orders_are_there_after_a_restart_until_they_are_settled(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "store.sqlite"
    with MarketStore(path) as store:
        assert store.sent_orders() == []
        await store.keep_sent([FIRST, SECOND])
        await store.keep_sent([FIRST])
    with MarketStore(path) as store:
        assert store.sent_orders() == [FIRST, SECOND]
        store.settle_sent(SettledOrders([FIRST.identity], []), head=0)
        await store.keep_sent([SECOND])
    with MarketStore(path) as store:
        assert store.sent_orders() == [SECOND]
        store.settle_sent(SettledOrders([SECOND.identity], []), head=0)
        await store.keep_sent([SECOND])
    with MarketStore(path) as store:
        assert store.sent_orders() == [SECOND]
    assert path.stat().st_mode & 0o777 == 0o600


async def test_contracts_are_known_until_their_deadline(tmp_path: Path) -> None:
    path, late = tmp_path / "store.sqlite", SentOrder(b"3" * 52, "bb" * 32, "0xB", 2**256 - 1)
    with MarketStore(path) as store:
        await store.keep_sent([FIRST, SECOND, late])
        store.settle_sent(SettledOrders([SECOND.identity], [FIRST.identity]), head=FIRST.deadline - 1)
    with MarketStore(path) as store:
        assert store.sent_orders(contracts=True) == [FIRST]
        assert store.sent_orders() == [late._replace(deadline=2**63 - 1)]
        store.settle_sent(SettledOrders([], [late.identity]), head=FIRST.deadline)
    with MarketStore(path) as store:
        assert [one.identity for one in store.sent_orders(contracts=True)] == [late.identity]
        assert store.sent_orders() == []


async def test_without_a_path_nothing_is_kept() -> None:
    with MarketStore() as store:
        await store.keep_sent([FIRST])
        store.settle_sent(SettledOrders([FIRST.identity], []), head=0)
        assert store.sent_orders() == []


async def test_many_writes_wait_for_few_syncs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    orders = [SentOrder(os.urandom(52), "", "", 9) for _ in range(64)]
    path, fsync, synced = tmp_path / "store.sqlite", os.fsync, list[int]()

    def noted(descriptor: int) -> None:
        synced.append(descriptor)
        fsync(descriptor)

    with MarketStore(path) as store:
        monkeypatch.setattr(os, "fsync", noted)
        await asyncio.gather(*(store.keep_sent([order]) for order in orders))
        assert 1 < len(synced) <= 4, "the first one's, and all others' together"
        for order in orders[1:]:
            store.settle_sent(SettledOrders([order.identity], []), head=0)
    with MarketStore(path) as store:
        assert store.sent_orders() == [orders[0]]


async def test_what_can_not_be_synced_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failed(descriptor: int) -> None:
        raise OSError(5, "the disk is broken")

    with MarketStore(tmp_path / "store.sqlite") as store:
        monkeypatch.setattr(os, "fsync", failed)
        with raises_with(ConfigurationError, code="transactions-not-kept"):
            await store.keep_sent([FIRST])
        with raises_with(ConfigurationError, code="transactions-not-kept"):
            await store.keep_sent([FIRST])
        monkeypatch.undo()
        await store.keep_sent([FIRST])
        assert store.synced == store.written


async def test_a_damaged_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    path.write_bytes(b"not a database, however you look at it" * 100)
    with raises_with(ConfigurationError, code="transactions-not-kept") as caught:
        MarketStore(path).__enter__()
    assert str(path) in str(caught.value)
    assert caught.value.hint


async def test_a_full_disk_is_reported_and_what_was_kept_stays(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    with MarketStore(path) as store:
        await store.keep_sent([FIRST])
        with file_size_limit(1 << 16), raises_with(ConfigurationError, code="transactions-not-kept"):
            await store.keep_sent([SentOrder(os.urandom(52), "", "", 9) for _ in range(4000)])
        await store.keep_sent([SECOND])
    with MarketStore(path) as store:
        assert store.sent_orders() == [FIRST, SECOND]


async def test_another_reader_does_not_get_in_the_way(tmp_path: Path) -> None:
    with MarketStore(tmp_path / "store.sqlite") as store:
        await store.keep_sent([FIRST])
        with sqlite3.connect(tmp_path / "store.sqlite") as other:
            other.execute("BEGIN")
            assert other.execute("SELECT COUNT(*) FROM sent_orders").fetchone() == (1,)
            await store.keep_sent([SECOND])
        other.close()
