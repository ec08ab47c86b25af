"""A provider's transactions one after the other, and no more of them than can wait."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING

import pytest

from mesh.background import Background
from mesh.market import sending
from mesh.market.sending import Sending
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.mesh.market.floor import Floor


@pytest.fixture
async def sender(floor: Floor) -> AsyncIterator[Sending]:
    """The transactions of the market's provider."""
    async with floor.chain_of("provider") as chain:
        yield Sending(chain, floor.lighthouse, provider=floor.address("provider"), head=lambda: 0)


async def test_work_is_done_in_its_order_one_at_a_time(sender: Sending) -> None:
    told: list[str] = []

    async def work(name: str) -> None:
        told.append(f"{name} begins")
        await asyncio.sleep(0)
        told.append(f"{name} ends")

    for name in "abc":
        sender.put(partial(work, name))
    async with Background() as tasks:
        tasks.start(sender.run(), "sending")
        await until(lambda: len(told) == 6)

    assert told == ["a begins", "a ends", "b begins", "b ends", "c begins", "c ends"]


async def test_who_brings_work_waits_while_too_much_waits(sender: Sending, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "WAITING", 2)
    done: list[int] = []

    async def work(number: int) -> None:
        done.append(number)

    async with asyncio.timeout(5):
        await sender.room()
        sender.put(partial(work, 1))
        await sender.room()
    sender.put(partial(work, 2))
    waiting = asyncio.create_task(sender.room())
    await asyncio.sleep(0)
    assert not waiting.done()

    async with Background() as tasks:
        tasks.start(sender.run(), "sending")
        async with asyncio.timeout(5):
            await waiting

    assert done


async def test_what_a_piece_of_work_raises_ends_the_sending(sender: Sending) -> None:
    async def work() -> None:
        raise ZeroDivisionError

    sender.put(work)
    with pytest.raises(ZeroDivisionError):
        await sender.run()


async def test_what_waits_when_it_all_ends_is_never_begun(sender: Sending) -> None:
    begun: list[int] = []

    async def work(number: int) -> None:
        begun.append(number)
        await asyncio.Event().wait()

    for number in range(3):
        sender.put(partial(work, number))
    async with Background() as tasks:
        tasks.start(sender.run(), "sending")
        await until(lambda: begun)

    assert begun == [0]
