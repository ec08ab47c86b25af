"""The file of the orders whose transactions may still be mined."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import pytest

from mesh.chain.errors import TransactionsNotKept
from mesh.market.sent_orders import SentOrder, SentOrders
from tests.support.disks import file_size_limit

if TYPE_CHECKING:
    from pathlib import Path

FIRST = SentOrder(b"1" * 52, "aa" * 32, "0xA", 9)
SECOND = SentOrder(b"2" * 52, "", "", 9)


async def test_orders_are_there_after_a_restart_until_they_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "sent.sqlite"
    async with SentOrders(path) as sent:
        assert sent.left == ()
        await sent.add([FIRST, SECOND])
        await sent.add([FIRST])
    async with SentOrders(path) as sent:
        assert set(sent.left) == {FIRST, SECOND}
        await sent.remove([FIRST.identity])
        await sent.add([SECOND])
    async with SentOrders(path) as sent:
        assert sent.left == (SECOND,)
        await sent.remove([SECOND.identity])
        await sent.add([SECOND])
    async with SentOrders(path) as sent:
        assert sent.left == (SECOND,)
    assert path.stat().st_mode & 0o777 == 0o600


async def test_contracts_are_known_until_their_deadline(tmp_path: Path) -> None:
    path, late = tmp_path / "sent.sqlite", SentOrder(b"3" * 52, "bb" * 32, "0xB", 2**256 - 1)
    async with SentOrders(path) as sent:
        await sent.add([FIRST, SECOND, late])
        await sent.remove([FIRST.identity, SECOND.identity], contracts={FIRST.identity}, head=FIRST.deadline - 1)
    async with SentOrders(path) as sent:
        assert sent.contracts == (FIRST,)
        assert sent.left == (late._replace(deadline=2**63 - 1),)
        await sent.remove([late.identity], contracts={late.identity}, head=FIRST.deadline)
    async with SentOrders(path) as sent:
        assert [one.identity for one in sent.contracts] == [late.identity]
        assert sent.left == ()


async def test_without_a_path_nothing_is_kept() -> None:
    async with SentOrders() as sent:
        await sent.add([FIRST])
        await sent.remove([FIRST.identity])
        assert sent.left == ()


async def test_many_writes_at_once(tmp_path: Path) -> None:
    orders = [SentOrder(os.urandom(52), "", "", 9) for _ in range(64)]
    async with SentOrders(tmp_path / "sent.sqlite") as sent:
        await asyncio.gather(*(sent.add([order]) for order in orders))
        await asyncio.gather(*(sent.remove([order.identity]) for order in orders[1:]))
    async with SentOrders(tmp_path / "sent.sqlite") as sent:
        assert sent.left == (orders[0],)


async def test_a_damaged_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "sent.sqlite"
    path.write_bytes(b"not a database, however you look at it" * 100)
    with pytest.raises(TransactionsNotKept) as caught:
        await SentOrders(path).__aenter__()
    assert str(path) in str(caught.value)
    assert caught.value.hint


async def test_a_full_disk_is_reported_and_what_was_kept_stays(tmp_path: Path) -> None:
    path = tmp_path / "sent.sqlite"
    async with SentOrders(path) as sent:
        await sent.add([FIRST])
        with file_size_limit(1 << 16), pytest.raises(TransactionsNotKept):
            await sent.add([SentOrder(os.urandom(52), "", "", 9) for _ in range(4000)])
        await sent.add([SECOND])
    async with SentOrders(path) as sent:
        assert set(sent.left) == {FIRST, SECOND}
