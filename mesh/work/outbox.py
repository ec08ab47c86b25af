"""What was said and must arrive: signed messages, sent again until their effect is seen on the chain."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.work.ledger import Outgoing
from schemas import Demand, Offer, Result, decode, encode, message_hash

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.network import Channel, Network
    from mesh.work.ledger import Ledger

log = logging.getLogger(__name__)

RESEND: Final = 3.0
"""Seconds between two sendings of what has had no effect yet."""


def outgoing_identity(message: Demand | Offer | Result) -> str:
    """Under what a message waits: an order by its hash, a Result by its liability."""
    if isinstance(message, Result):
        return result_identity(message.liability)
    return message_hash(message).hex()


def result_identity(liability: str) -> str:
    """Under what the Result of the liability at that address waits; there is one only."""
    return f"result {liability}"


def outgoing(message: Demand | Offer | Result) -> Outgoing:
    """The outbox's entry for a signed message."""
    deadline = None if isinstance(message, Result) else message.deadline
    return Outgoing(
        identity=outgoing_identity(message),
        kind=type(message).__name__.lower(),
        payload=encode(message),
        deadline=deadline,
    )


class Outbox:
    """Sends what the ledger holds to the channel; `run` sends it again and again, and at once when the network is back.

    Receivers drop what they know, so a message sent twice costs little and one lost costs a moment.
    """

    def __init__(self, ledger: Ledger, channel: Channel, network: Network, *, head: Callable[[], int]) -> None:
        self._ledger = ledger
        self._channel = channel
        self._network = network
        self._head = head

    async def post(self, message: Demand | Offer | Result) -> None:
        """Keep a signed message until `settle`, and send it now."""
        await self._ledger.post(outgoing(message))
        self._channel.publish(message)

    async def settle(self, identity: str) -> bool:
        """The message had its effect; False when it was not waiting."""
        return await self._ledger.settle(identity)

    async def spend(self, identity: str, liability: str) -> None:
        """The order became the contract at the address `liability`, as far as the chain says now."""
        await self._ledger.spend(identity, liability)

    async def unspend(self, liability: str) -> int | None:
        """The chain has no such contract after all: its orders are sent again, now and until they have their effect.

        Returns the block that ends that, None for a contract of none of our orders.
        """
        deadline = await self._ledger.spent_until(liability)
        if await self._ledger.unspend(liability):
            await self.send()
        return deadline

    async def send(self) -> None:
        """Send everything that waits, once."""
        for waiting in await self._ledger.outbox(head=self._head()):
            message = decode(waiting.payload)
            assert isinstance(message, Demand | Offer | Result)
            self._channel.publish(message)

    async def run(self) -> None:
        """Send what waits every `RESEND` seconds and whenever the network returns. Ends by cancellation."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._on_return(), name="outbox after network loss")
            while True:
                await self.send()
                await asyncio.sleep(RESEND)

    async def _on_return(self) -> None:
        async for _ in self._network.changes():
            if self._network.connected:
                await self.send()
