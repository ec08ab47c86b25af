"""A provider's transactions: one after the other, each in its turn, and again after failures that pass."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.chain import FeeTooHigh, InsufficientFunds, NodeUnreachable, RequestRefused, Reverted, TransactionTimeout
from mesh.market.patience import may_pass
from mesh.market.turns import NoStake, Turns
from mesh.outage_log import OutageLog

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain import Chain
    from mesh.errors import AiraError

    Work = Callable[[], Awaitable[None]]

log = logging.getLogger(__name__)

T = TypeVar("T")

RETRY: Final = 1.0
"""Seconds before a transaction is tried again that failed for a passing reason."""
WAITING: Final = 1024
"""Pieces of work that wait before `room` lets nobody in."""
LATER: Final = 4096
"""Pieces of work that wait aside at most, to be tried again."""


class Sending:
    """The transactions of a provider of `lighthouse` (address): `put` work, and `run` does it, one at a time.

    Turn and nonce are the provider's alone, so what can't be sent now makes all others wait. `head` tells the latest
    block that the provider knows of. What stands in the way is logged once, and once when it is over.
    """

    def __init__(self, chain: Chain, lighthouse: str, *, provider: str, head: Callable[[], int]) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._head = head
        self._turns = Turns(chain, lighthouse, provider)
        self._work: asyncio.Queue[tuple[Work, int]] = asyncio.Queue()
        self._since = 0
        self._later = 0
        self._room = asyncio.Event()
        self._room.set()
        self._trouble = OutageLog(log, "transactions")
        self._silence = OutageLog(log, "chain")

    def put(self, work: Work) -> None:
        """Do `work`, a coroutine function that uses `send`, after what waits already."""
        self._put(work, self._head())

    @property
    def waits_for(self) -> str:
        """In a few words what transactions wait for that is not a turn or a block; empty when they go through."""
        return "wait for the node" if self._silence.is_down else "wait" if self._trouble.is_down else ""

    @property
    def waiting(self) -> int:
        """Pieces of work that wait for their turn, or to be tried again."""
        return self._work.qsize() + self._later

    def put_later(self, work: Work, *, after: float, because: AiraError) -> bool:
        """Do the piece of work that runs now again, as `work`, in `after` seconds; others go through meanwhile.

        False, and nothing is done, where too much waits so already.
        """
        if self._later >= LATER:
            return False
        self._trouble.failed(because, "a transaction waits")
        self._later += 1
        asyncio.get_running_loop().call_later(after, self._put_again, work, self._since)
        return True

    async def room(self) -> None:
        """Wait until less than `WAITING` pieces of work wait: for those who bring new ones."""
        await self._room.wait()

    async def run(self) -> None:
        """Work until cancelled."""
        while True:
            work, self._since = await self._work.get()
            if self._work.qsize() < WAITING:
                self._room.set()
            try:
                await work()
            except InsufficientFunds as error:
                # Perhaps for this transaction only: a token may ask for any amount of gas.
                self._trouble.failed(error, "a transaction waits")
                asyncio.get_running_loop().call_later(RETRY, self._put, work, self._since)

    async def send(self, transaction: Callable[[], Awaitable[T]]) -> T:
        """What `transaction` returns, sent in the provider's turn; again and again while the node is away, while gas
        is too dear, and while it is not our turn after all.

        Raises what `transaction` raises: `Reverted` for what the contracts refuse; and that it is not our turn, or that
        the node does not answer or refuses, where the same node says that it is there and our turn has come. Then
        others may go through (see `put_later`).
        """
        while True:
            await self._our_turn()
            try:
                done = await transaction()
            except (FeeTooHigh, TransactionTimeout) as error:
                self._trouble.failed(error, "a transaction waits")
            except (NodeUnreachable, RequestRefused, Reverted) as error:
                if not may_pass(error):
                    raise
                if await self._is_our_turn():
                    self._turns.forget()
                    raise
                self._trouble.failed(error, "a transaction waits")
            else:
                self._turns.took_one()
                self._trouble.recovered("transactions go through again")
                return done
            # Time has passed, and with it perhaps the turn.
            self._turns.forget()
            await asyncio.sleep(RETRY)

    async def ask(self, question: Callable[[], Awaitable[T]]) -> T:
        """What `question`, which only reads, returns; again and again while the node is away."""
        while True:
            try:
                answer = await question()
            except NodeUnreachable as error:
                self._silence.failed(error, "a question waits")
            else:
                self._silence.recovered("the node answers again")
                return answer
            await asyncio.sleep(RETRY)

    def _put(self, work: Work, since: int) -> None:
        self._work.put_nowait((work, since))
        if self._work.qsize() >= WAITING:
            self._room.clear()

    def _put_again(self, work: Work, since: int) -> None:
        self._later -= 1
        self._put(work, since)

    async def _our_turn(self) -> None:
        """Return when the next transaction is ours to send."""
        while True:
            try:
                if await self._turns.has_come(since=self._since):
                    return
            except (NodeUnreachable, RequestRefused, NoStake) as error:
                self._trouble.failed(error, "a transaction waits")
            await asyncio.sleep(min(RETRY, self._chain.node.timing.poll_interval))

    async def _is_our_turn(self) -> bool:
        try:
            return await self._chain.lighthouses.is_turn(self._lighthouse)
        except (NodeUnreachable, RequestRefused):
            return False
