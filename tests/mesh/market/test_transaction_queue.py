"""A provider's transactions: several under way, in their order, and again after failures that may pass."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.retry import RetryPolicy
from mesh.chain import InsufficientFunds, NodeUnreachable, RequestRefused, Reverted
from mesh.chain._lighthouses import Lighthouses
from mesh.market._earnings import EarningsLedger
from mesh.market.transactions import QUEUE_LIMITS, QueueLimits, TransactionQueue
from tests.support.provider.local_market import QUICK, QUICK_RETRY
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import LighthouseState
    from tests.support.provider.local_market import LocalMarket

NEVER = RetryPolicy(initial=3600, ceiling=3600)


@asynccontextmanager
async def queue_of(local: LocalMarket, **options: Any) -> AsyncIterator[TransactionQueue]:
    """The transactions of the market's provider."""
    limits = QueueLimits(**{name: options.pop(name) for name in QueueLimits._fields if name in options})
    parts: dict[str, Any] = {"earnings": EarningsLedger(), "retry": QUICK_RETRY, "limits": limits} | options
    async with local.chain_of("provider") as chain:
        yield TransactionQueue(chain, local.lighthouse, head=lambda: 0, **parts)


async def test_the_turn_of_another_is_asked_for_once_in_each_block(
    local: LocalMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with local.chain_of("rival") as chain:
        asked: list[str] = []
        get = Lighthouses.get

        async def count(lighthouses: Lighthouses, lighthouse: str) -> LighthouseState:
            asked.append(lighthouse)
            return await get(lighthouses, lighthouse)

        monkeypatch.setattr(Lighthouses, "get", count)
        queue = TransactionQueue(chain, local.lighthouse, head=lambda: 0, earnings=EarningsLedger())
        sending = asyncio.ensure_future(queue.send(Transaction()))
        try:
            for blocks in (1, 2):
                await until(lambda blocks=blocks: len(asked) >= blocks)  # type: ignore[misc]
                await asyncio.sleep(20 * QUICK.poll_interval)
                assert len(asked) == blocks
                await local.mine(1)
        finally:
            sending.cancel()


class Transaction:
    """A transaction whose first attempts fail with these errors; afterwards it returns how often it was sent."""

    def __init__(self, *errors: Exception) -> None:
        self._errors = list(errors)
        self.sent = 0

    async def __call__(self) -> int:
        self.sent += 1
        if self._errors:
            raise self._errors.pop(0)
        return self.sent


async def test_transactions_are_sent_in_their_order_one_at_a_time(local: LocalMarket) -> None:
    events: list[str] = []

    async def transaction(name: str) -> str:
        events.append(f"{name} begins")
        await asyncio.sleep(0)
        events.append(f"{name} ends")
        return name

    async with queue_of(local, under_way=1) as queue:
        assert await asyncio.gather(*(queue.send(partial(transaction, name)) for name in "abc")) == ["a", "b", "c"]

    assert events == ["a begins", "a ends", "b begins", "b ends", "c begins", "c ends"]


async def test_several_transactions_are_under_way_and_a_failure_does_not_hold_up_the_others(local: LocalMarket) -> None:
    begun: list[int] = []
    failing, lasting = asyncio.Event(), asyncio.Event()

    async def transaction(number: int) -> int:
        begun.append(number)
        if number == 1:
            await failing.wait()
            raise Reverted("OrderUsed", gas_used=1)
        await lasting.wait()
        return number

    async with queue_of(local, under_way=3) as queue:
        tasks = [asyncio.create_task(queue.send(partial(transaction, number))) for number in range(5)]
        await until(lambda: len(begun) == 3)
        await asyncio.sleep(0.05)
        assert (begun, queue.waiting) == ([0, 1, 2], 2)
        failing.set()
        await until(lambda: begun == [0, 1, 2, 3])
        assert isinstance(tasks[1].exception(), Reverted)
        lasting.set()
        assert await asyncio.gather(*tasks[:1], *tasks[2:]) == [0, 2, 3, 4]


async def test_the_highest_priority_goes_first_also_after_others_were_cancelled(local: LocalMarket) -> None:
    sent: list[str] = []
    free = asyncio.Event()

    async def transaction(name: str) -> None:
        await free.wait()
        sent.append(name)

    async with queue_of(local, under_way=1) as queue, asyncio.TaskGroup() as tasks:
        for name, priority in (("first", 0), ("free", 0), ("cancelled", 9), ("low", 1), ("high", 5), ("high too", 5)):
            task = tasks.create_task(queue.send(partial(transaction, name), priority=priority), name=name)
            await asyncio.sleep(0)
            if name == "cancelled":
                task.cancel()
        free.set()

    assert sent == ["first", "high", "high too", "low", "free"]


async def test_a_place_that_becomes_free_goes_to_the_highest_priority_then(local: LocalMarket) -> None:
    sent: list[str] = []
    free = {name: asyncio.Event() for name in ("first", "low", "high")}

    async def transaction(name: str) -> None:
        sent.append(name)
        await free[name].wait()

    async with queue_of(local, under_way=1) as queue, asyncio.TaskGroup() as tasks:
        for name, priority in (("first", 0), ("low", 1), ("high", 5)):
            tasks.create_task(queue.send(partial(transaction, name), priority=priority))
            await until(lambda: sent)
        for name in ("first", "high", "low"):
            free[name].set()

    assert sent == ["first", "high", "low"]


async def test_a_place_is_kept_for_what_is_worth_something(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=10, provider=QUEUE_LIMITS.reserved)
    sent: list[int] = []
    done = asyncio.Event()

    async def transaction(worth: int) -> None:
        sent.append(worth)
        await done.wait()

    async with queue_of(local, under_way=QUEUE_LIMITS.reserved) as queue, asyncio.TaskGroup() as tasks:
        for _ in range(QUEUE_LIMITS.reserved):
            tasks.create_task(queue.send(partial(transaction, 0)))
        await until(lambda: len(sent) == QUEUE_LIMITS.reserved - 1)
        tasks.create_task(queue.send(partial(transaction, 1), priority=1))
        await until(lambda: len(sent) == QUEUE_LIMITS.reserved)
        assert sent[-1] == 1
        done.set()
    assert len(sent) == QUEUE_LIMITS.reserved + 1


async def test_new_work_waits_while_the_queue_is_full(local: LocalMarket) -> None:
    free = asyncio.Event()

    async def transaction() -> None:
        await free.wait()

    async with queue_of(local, queued=2, under_way=1) as queue, asyncio.TaskGroup() as tasks:
        for _ in range(2):  # the first is being sent, the second waits
            async with asyncio.timeout(60):
                await queue.has_room()
            tasks.create_task(queue.send(transaction))
        async with asyncio.timeout(60):
            await queue.has_room()
        tasks.create_task(queue.send(transaction))
        waiting = asyncio.create_task(queue.has_room())
        await asyncio.sleep(0.01)
        assert not waiting.done()
        assert queue.waiting == 2

        free.set()
        async with asyncio.timeout(60):
            await waiting


async def test_tasks_created_just_before_count_as_queued(local: LocalMarket) -> None:
    async def transaction() -> None:
        await asyncio.Event().wait()

    async with queue_of(local, queued=2, under_way=1) as queue:
        tasks = [asyncio.create_task(queue.send(transaction)) for _ in range(3)]
        waiting = asyncio.create_task(queue.has_room())
        await asyncio.sleep(0.01)
        assert not waiting.done()
        for task in (waiting, *tasks):
            task.cancel()


async def test_an_unexpected_error_is_raised_and_the_next_transaction_goes_on(local: LocalMarket) -> None:
    async with queue_of(local) as queue:
        with pytest.raises(ZeroDivisionError):
            await queue.send(Transaction(ZeroDivisionError()))
        assert await queue.send(Transaction()) == 1


async def test_transactions_that_wait_when_all_is_cancelled_are_never_sent(local: LocalMarket) -> None:
    begun: list[int] = []

    async def transaction(number: int) -> None:
        begun.append(number)
        await asyncio.Event().wait()

    async with queue_of(local, under_way=1) as queue:
        tasks = [asyncio.create_task(queue.send(partial(transaction, number))) for number in range(3)]
        await until(lambda: begun)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)

    assert begun == [0]


@pytest.mark.parametrize("reason", ["NotYourTurn", "NotAProvider"])
async def test_a_failure_that_may_pass_is_tried_again_until_the_last_attempt(local: LocalMarket, reason: str) -> None:
    ledger, transaction = EarningsLedger(), Transaction(*(Reverted(reason, gas_used=1000, wei=7) for _ in range(99)))
    async with queue_of(local, earnings=ledger) as queue:
        with pytest.raises(Reverted) as caught:
            await queue.send(transaction)

    assert caught.value.reason == reason
    assert transaction.sent == QUICK_RETRY.attempts == 8
    assert (ledger.earnings().gas_used, ledger.earnings().spent) == (8000, 56)


async def test_a_revert_is_raised_at_once(local: LocalMarket) -> None:
    transaction = Transaction(Reverted("OrderUsed"))
    async with queue_of(local) as queue:
        with pytest.raises(Reverted):
            await queue.send(transaction)
        assert not queue.is_down
    assert transaction.sent == 1


async def test_a_transaction_with_too_little_eth_is_tried_again_without_limit(local: LocalMarket) -> None:
    short = InsufficientFunds(local.address("provider"), balance=0, needed=1)
    async with queue_of(local) as queue:
        assert await queue.send(Transaction(*[short] * 10)) == 11
        assert not queue.is_down


async def test_others_are_sent_while_a_transaction_waits_for_its_next_attempt(local: LocalMarket) -> None:
    async with queue_of(local, retry=NEVER) as queue:
        task = asyncio.create_task(queue.send(Transaction(NodeUnreachable("http://node", "silence"))))
        await until(lambda: queue.is_down)
        assert queue.waiting == 1
        async with asyncio.timeout(60):
            assert await queue.send(Transaction()) == 1
        task.cancel()


async def test_no_more_than_a_limit_waits_for_the_next_attempt(local: LocalMarket) -> None:
    async with queue_of(local, retry=NEVER, set_aside=1) as queue:
        task = asyncio.create_task(queue.send(Transaction(RequestRefused("eth_call", -32005, "too many requests"))))
        await until(lambda: queue.waiting == 1 and queue.is_down)
        with pytest.raises(RequestRefused):
            await queue.send(Transaction(RequestRefused("eth_call", -32005, "too many requests")))
        task.cancel()
