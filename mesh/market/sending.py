"""A provider's transactions: one after the other, and again after failures that pass."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.chain import InsufficientFunds, NodeUnreachable, Reverted, TransactionTimeout

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain import Chain

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

    Turn and nonce are the provider's alone, so what can't be sent now makes all others wait.
    """

    def __init__(self, chain: Chain, lighthouse: str) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._work: asyncio.Queue[Callable[[], Awaitable[None]]] = asyncio.Queue()
        self._room = asyncio.Event()
        self._room.set()

    def put(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do `work`, a coroutine function that uses `send`, after what waits already."""
        self._work.put_nowait(work)
        if self._work.qsize() >= WAITING:
            self._room.clear()

    async def room(self) -> None:
        """Wait until less than `WAITING` pieces of work wait: for those who bring new ones."""
        await self._room.wait()

    async def run(self) -> None:
        """Work until cancelled."""
        while True:
            work = await self._work.get()
            if self._work.qsize() < WAITING:
                self._room.set()
            try:
                await work()
            except InsufficientFunds as error:
                # Perhaps for this transaction only: a token may ask for any amount of gas.
                log.warning("a transaction waits: %s; %s", error, error.hint)
                asyncio.get_running_loop().call_later(RETRY, self.put, work)

    async def send(self, transaction: Callable[[], Awaitable[T]]) -> T:
        """What `transaction` returns; again and again while the node is away and while it is not our turn.

        Raises `Reverted` for what the contracts refuse for another reason, and what else `transaction` raises;
        `NodeUnreachable` when the node is there for everything but this.
        """
        doubts = 0
        while True:
            try:
                return await transaction()
            except TransactionTimeout as error:
                log.warning("a transaction waits: %s", error)
            except (NodeUnreachable, Reverted) as error:
                if isinstance(error, Reverted) and error.reason not in OUT_OF_TURN:
                    raise
                doubts += await self._is_our_turn()
                if doubts == DOUBTS:
                    raise
                log.warning("a transaction waits: %s", error)
            await asyncio.sleep(RETRY)

    async def ask(self, question: Callable[[], Awaitable[T]]) -> T:
        """What `question`, which only reads, returns; again and again while the node is away."""
        while True:
            try:
                return await question()
            except NodeUnreachable as error:
                log.warning("a question waits: %s", error)
            await asyncio.sleep(RETRY)

    async def _is_our_turn(self) -> bool:
        try:
            return await self._chain.is_turn(self._lighthouse)
        except NodeUnreachable:
            return False
