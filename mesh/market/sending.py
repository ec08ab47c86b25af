"""A provider's transactions: one after the other, each in its turn, and again after failures that pass."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.chain import FeeTooHigh, InsufficientFunds, NodeUnreachable, RequestRefused, Reverted, TransactionTimeout
from mesh.market.turns import NoStake, Turns
from mesh.trouble import Trouble

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain import Chain

    Work = Callable[[], Awaitable[None]]

log = logging.getLogger(__name__)

T = TypeVar("T")

RETRY: Final = 1.0
"""Seconds before a transaction is tried again that failed for a passing reason."""
WAITING: Final = 1024
"""Pieces of work that wait before `room` lets nobody in."""
OUT_OF_TURN: Final = frozenset({"NotYourTurn", "NotAProvider"})
"""What the lighthouse says to a provider, whatever the transaction is."""
DOUBTS: Final = 3
"""How often that, or the node's silence, is believed though the node says that it is the provider's turn.

A token can revert with the same words, or keep the node busy for longer than anybody waits.
"""


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
        self._room = asyncio.Event()
        self._room.set()
        self._trouble = Trouble(log)
        self._silence = Trouble(log)

    def put(self, work: Work) -> None:
        """Do `work`, a coroutine function that uses `send`, after what waits already."""
        self._put(work, self._head())

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
                self._trouble.met(error, "a transaction waits")
                asyncio.get_running_loop().call_later(RETRY, self._put, work, self._since)

    async def send(self, transaction: Callable[[], Awaitable[T]]) -> T:
        """What `transaction` returns, sent in the provider's turn; again and again while the node is away, while gas
        is too dear, and while it is not our turn after all.

        Raises `Reverted` for what the contracts refuse for another reason, and what else `transaction` raises;
        `NodeUnreachable` when the node is there for everything but this.
        """
        doubts = 0
        while True:
            await self._our_turn()
            try:
                done = await transaction()
            except (FeeTooHigh, TransactionTimeout) as error:
                self._trouble.met(error, "a transaction waits")
            except (NodeUnreachable, Reverted) as error:
                if isinstance(error, Reverted) and error.reason not in OUT_OF_TURN:
                    raise
                doubts += await self._is_our_turn()
                if doubts == DOUBTS:
                    raise
                self._trouble.met(error, "a transaction waits")
            else:
                self._turns.took_one()
                self._trouble.over("transactions go through again")
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
                self._silence.met(error, "a question waits")
            else:
                self._silence.over("the node answers again")
                return answer
            await asyncio.sleep(RETRY)

    def _put(self, work: Work, since: int) -> None:
        self._work.put_nowait((work, since))
        if self._work.qsize() >= WAITING:
            self._room.clear()

    async def _our_turn(self) -> None:
        """Return when the next transaction is ours to send."""
        while True:
            try:
                if await self._turns.has_come(since=self._since):
                    return
            except (NodeUnreachable, RequestRefused, NoStake) as error:
                self._trouble.met(error, "a transaction waits")
            await asyncio.sleep(min(RETRY, self._chain.node.timing.poll_interval))

    async def _is_our_turn(self) -> bool:
        try:
            return await self._chain.is_turn(self._lighthouse)
        except (NodeUnreachable, RequestRefused):
            return False
