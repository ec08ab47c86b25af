"""Files named in messages: in what order they are transferred, and which are not."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from bridges.ipfs._content import TRANSFER_LIMITS, URGENT, TransferQueue
from mesh.base.flood import Drops
from mesh.base.retry import RetryPolicy
from mesh.content import ContentUnavailable
from tests.support.clocks import SECOND, SetClock
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

ONCE = RetryPolicy(initial=0.0, ceiling=0.0, attempts=1)
SECONDS = 30.0


class Transfers:
    """Transfers that wait at a gate, and fail for what is not `held`."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.gate = asyncio.Event()
        self.held: Callable[[str], bool] = lambda cid: not cid.startswith("dead")

    async def transfer(self, cid: str) -> None:
        self.begun.append(cid)
        await self.gate.wait()
        if not self.held(cid):
            raise ContentUnavailable(cid, "nobody has it")


def queue_of(
    transfer: Callable[[str], Awaitable[None]],
    *,
    retry: RetryPolicy = ONCE,
    drops: Drops | None = None,
    clock: SetClock | None = None,
) -> TransferQueue:
    return TransferQueue(transfer, kind="add", retry=retry, drops=drops or Drops(), clock=clock or SetClock())


async def test_results_go_before_what_orders_name_and_signers_take_turns() -> None:
    transfers = Transfers()
    async with queue_of(transfers.transfer) as queue:
        for number in range(TRANSFER_LIMITS.at_once):
            queue.add(f"first {number}", "flooder")
        await until(lambda: len(transfers.begun) == TRANSFER_LIMITS.at_once, what="busy workers", seconds=SECONDS)
        for number in range(5):
            queue.add(f"more {number}", "flooder")
        queue.add("honest order", "person")
        queue.add("honest result", "robot", priority=URGENT)

        transfers.gate.set()
        await until(lambda: queue.queued == 0, seconds=SECONDS)

    assert transfers.begun[TRANSFER_LIMITS.at_once :][:3] == ["honest result", "more 0", "honest order"]


async def test_a_file_that_many_messages_name_is_transferred_once() -> None:
    transfers, clock = Transfers(), SetClock()
    async with queue_of(transfers.transfer, clock=clock) as queue:
        for number in range(20):
            queue.add("file", f"signer {number % 4}")
        await until(lambda: transfers.begun, what="the transfer", seconds=SECONDS)
        queue.add("file", "late")
        transfers.gate.set()
        await until(lambda: queue.joined == 20 and not queue._running, what="the end", seconds=SECONDS)
        assert transfers.begun == ["file"]

        clock.pass_by(61 * SECOND)
        queue.add("file", "late")
        await until(lambda: transfers.begun == ["file", "file"], what="a new transfer", seconds=SECONDS)


async def test_a_dead_file_is_not_tried_again_for_a_while() -> None:
    transfers, drops, clock = Transfers(), Drops(), SetClock()
    transfers.gate.set()
    async with queue_of(transfers.transfer, drops=drops, clock=clock) as queue:
        queue.add("dead", "flooder")
        await until(lambda: queue.failed == 1, seconds=SECONDS)
        queue.add("dead", "flooder")
        assert (queue.failed, queue.queued, transfers.begun) == (2, 0, ["dead"])
        assert drops.heaviest("content-unavailable") == [("flooder", 1)]

        clock.pass_by(61 * SECOND)
        queue.add("dead", "flooder")
        await until(lambda: transfers.begun == ["dead", "dead"], what="another attempt", seconds=SECONDS)


async def test_what_failed_is_tried_again_after_what_was_not_tried_yet() -> None:
    transfers = Transfers()
    retry = RetryPolicy(initial=0.01, factor=1.0, ceiling=0.01, attempts=2)
    async with queue_of(transfers.transfer, retry=retry) as queue:
        transfers.gate.set()
        queue.add("dead", "somebody")
        await until(lambda: transfers.begun == ["dead"], what="the first attempt", seconds=SECONDS)
        transfers.gate.clear()
        for number in range(TRANSFER_LIMITS.at_once + 4):
            queue.add(f"file {number}", f"signer {number}")
        await until(lambda: not queue._delayed, what="the failed one in the queue", seconds=SECONDS)
        transfers.gate.set()
        await until(lambda: queue.failed == 1, seconds=SECONDS)
    assert transfers.begun[-1] == "dead"


async def test_signers_and_the_queue_are_bounded() -> None:
    transfers, drops = Transfers(), Drops()
    async with queue_of(transfers.transfer, drops=drops) as queue:
        for number in range(TRANSFER_LIMITS.at_once):
            queue.add(f"first {number}", f"{number}")
        await until(lambda: len(transfers.begun) == TRANSFER_LIMITS.at_once, what="busy workers", seconds=SECONDS)
        for number in range(TRANSFER_LIMITS.per_signer + 10):
            queue.add(f"file {number}", "flooder")
        assert (queue.queued, queue.failed) == (TRANSFER_LIMITS.per_signer, 10)
        assert drops.heaviest("content-queue-full") == [("flooder", 10)]
        for number in range(2 * TRANSFER_LIMITS.waiting):
            queue.add(f"other {number}", f"fresh {number}")
        assert queue.queued == TRANSFER_LIMITS.waiting
