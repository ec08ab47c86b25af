"""The outbox: sends signed messages again, with backoff, until their effect is seen on the chain."""

from __future__ import annotations

import asyncio
import logging
import random
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.agent.ledger import Outgoing
from mesh.base.flood import Rate, RateLimiter
from mesh.base.log_context import log_event
from mesh.base.retry import Backoff
from mesh.role.program import RESEND
from schemas import Demand, Offer, Permit, Result, SignedMessage, Withdrawal, decode, encode, message_hash

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from mesh.agent.ledger import Ledger
    from mesh.base.retry import RetryPolicy
    from mesh.network import Channel, Network


log = logging.getLogger(__name__)

T = TypeVar("T")

RESEND_RATE: Final = Rate(per_second=50.0, burst=250)
"""Messages that are sent again, in all: strangers can make a robot offer, and tell it that a provider appeared."""


def outgoing_identity(message: SignedMessage) -> str:
    """The key of a message in the outbox: an order's hash, a Withdrawal's order, a Result's liability."""
    if isinstance(message, Result):
        return result_identity(message.liability)
    if isinstance(message, Withdrawal):
        return f"withdrawal {message.order}"
    return message_hash(message).hex()


def result_identity(liability: str) -> str:
    """The key of the Result of the liability at that address, of which there is only one."""
    return f"result {liability}"


def outgoing(message: SignedMessage, *, robot: str = "") -> Outgoing:
    """The outbox's entry for a signed message; with a `robot` (address) for an order that is for that one alone."""
    deadline = None if isinstance(message, Result) else message.deadline
    return Outgoing(
        identity=outgoing_identity(message),
        kind=type(message).__name__.lower(),
        payload=encode(message),
        deadline=deadline,
        robot=robot,
    )


@dataclass
class _Attempts:
    """A message, and when it is sent next (in seconds of the clock; 0: at once)."""

    message: SignedMessage
    backoff: Backoff
    robot: str = ""
    next_at: float = 0.0

    def is_open(self, head: int) -> bool:
        """Whether block `head` has not reached the deadline of its order."""
        return isinstance(self.message, Result) or self.message.deadline > head


class Outbox:
    """Sends the messages that the ledger holds to the channel. Receivers drop duplicates.

    A message is sent when it is posted, and then again after growing delays (`policy`). All are sent at once, and their
    delays start over, when `run` starts, when the network returns and when a provider or a validator appears on the
    market: it starts with an empty order book, or has missed a Result. Beyond `rate` messages wait: the oldest longest,
    and offers behind all others.
    `clock` (seconds) and `chance` (0 to 1, for jitter) are injected by tests.

    An order that is for one robot alone is not put on the channel: `send_alone` is called with a demand and its robot,
    and an offer stays here.
    """

    def __init__(
        self,
        ledger: Ledger,
        channel: Channel,
        network: Network,
        *,
        head: Callable[[], int],
        policy: RetryPolicy = RESEND,
        rate: Rate = RESEND_RATE,
        clock: Callable[[], float] = time.monotonic,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._ledger = ledger
        self._channel = channel
        self._network = network
        self._head = head
        self._policy = policy
        self._clock = clock
        self._chance = chance
        self._attempts: dict[str, _Attempts] = {}
        """What the ledger held when it was read, without what was settled since; the oldest first."""
        self._lock = asyncio.Lock()
        """Held while the ledger is read, or loses a message: what is settled must not come back."""
        self._held: set[str] = set()
        self._fresh: set[str] = set()
        """Messages that were never sent, in this run or an earlier one."""
        self._limiter = RateLimiter(per_sender=rate)
        self.send_alone: Callable[[Demand, str], object] = lambda _demand, _robot: None
        self.permit_for: Callable[[Demand], Permit | None] = lambda _demand: None
        """Returns the permit that travels before a demand."""
        self._changed = asyncio.Event()

    async def post(self, message: SignedMessage, *, robot: str = "") -> None:
        """Keep a signed message until `settle`, and send it now; with a `robot`, an order for that one alone."""
        self._fresh.add(outgoing_identity(message))
        await self._ledger.post(outgoing(message, robot=robot))
        await self.send_new()

    async def settle(self, identity: str) -> bool:
        """Stop sending a message: its effect was seen. False if it was not in the outbox."""
        return await self._without(identity, partial(self._ledger.settle, identity))

    async def spend(self, identity: str, liability: str) -> None:
        """Stop sending an order: it became the contract at the address `liability`, unless that is reverted."""
        await self._without(identity, partial(self._ledger.spend, identity, liability))

    async def unspend(self, liability: str) -> list[Outgoing]:
        """Take back the orders of a reverted contract; they are sent again after `release`. Returns them."""
        orders = await self._ledger.spent(liability)
        self.hold(order.identity for order in orders)
        await self._ledger.unspend(liability)
        return orders

    async def withdraw(self, *withdrawals: Withdrawal) -> None:
        """Stop sending orders, and send their signed withdrawals until the orders' deadlines."""
        self._fresh.update(map(outgoing_identity, withdrawals))
        async with self._lock:
            for withdrawal in withdrawals:
                self._attempts.pop(withdrawal.order, None)
            await self._ledger.withdraw({withdrawal.order: outgoing(withdrawal) for withdrawal in withdrawals})
        await self.send_new()

    async def replace(self, identity: str, message: SignedMessage, *, robot: str = "") -> None:
        """Send a signed message instead of the one called `identity`."""
        await self._without(identity, partial(self._ledger.replace, identity, outgoing(message, robot=robot)))
        await self.send_new()

    def hold(self, identities: Iterable[str]) -> None:
        """Don't send these messages before `release`."""
        self._held.update(identities)

    async def release(self, identities: Iterable[str]) -> None:
        """Send messages that were held."""
        self._held.difference_update(identities)
        await self.send_new()

    async def send_new(self) -> None:
        """Send the messages of the ledger that were not sent yet, and those whose time has come."""
        async with self._lock:
            known, unsent = self._attempts, await self._ledger.outbox(head=self._head())
            self._attempts = {one.identity: known.get(one.identity) or self._first_attempt(one) for one in unsent}
        self.send_due()

    async def send_all(self) -> None:
        """Send all messages, and start their delays over."""
        self._attempts.clear()
        await self.send_new()

    def send_due(self) -> None:
        """Send the messages whose time has come."""
        now = self._clock()
        due = [(identity, one) for identity, one in self._sendable() if one.next_at <= now]
        offers = [(identity, one) for identity, one in due if isinstance(one.message, Offer)]
        others = [(identity, one) for identity, one in due if not isinstance(one.message, Offer)]
        for identity, one in (*others, *reversed(offers)):
            wait = 0.5  # it exceeded the rate
            if identity in self._fresh or self._limiter.allow(""):
                self._fresh.discard(identity)
                if not one.robot:
                    if isinstance(one.message, Demand) and (permit := self.permit_for(one.message)) is not None:
                        self._channel.publish(permit)
                    self._channel.publish(one.message)
                elif isinstance(one.message, Demand):
                    self.send_alone(one.message, one.robot)
                wait = one.backoff.next_delay() or 0.0
            one.next_at = now + wait
        self._changed.set()

    async def expire(self, head: int) -> None:
        """Drop the orders whose deadline block `head` has reached."""
        if not all(one.is_open(head) for one in self._attempts.values()):
            async with self._lock:
                await self._ledger.outbox(head=head)
                self._attempts = {identity: one for identity, one in self._attempts.items() if one.is_open(head)}

    async def run(self) -> None:
        """Send messages when they are due, until cancelled."""
        appeared = asyncio.Event()
        for role in ("provider", "validator"):
            self._channel.watch_presence(lambda _key: appeared.set(), role=role)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._send_on_return(), name="outbox after network loss")
            tasks.create_task(self._send_to_newcomers(appeared), name="outbox to newcomers")
            await self.send_all()
            while True:
                await self._wait()
                self.send_due()

    def _sendable(self) -> Iterator[tuple[str, _Attempts]]:
        """The messages that are neither held nor expired, the oldest first."""
        head = self._head()
        return (
            (key, one)
            for key, one in self._attempts.items()
            if key not in self._held and one.is_open(head) and not (one.robot and isinstance(one.message, Offer))
        )

    async def _without(self, identity: str, remove: Callable[[], Awaitable[T]]) -> T:
        """Call what removes a message from the ledger."""
        async with self._lock:
            self._attempts.pop(identity, None)
            return await remove()

    def _first_attempt(self, one: Outgoing) -> _Attempts:
        message = decode(one.payload)
        assert isinstance(message, Demand | Offer | Withdrawal | Result)
        return _Attempts(message, Backoff(self._policy, chance=self._chance), one.robot)

    async def _wait(self) -> None:
        """Wait until the next attempt is due."""
        while True:
            self._changed.clear()
            first = min((one.next_at for _, one in self._sendable()), default=None)
            remaining = None if first is None else first - self._clock()
            if remaining is not None and remaining <= 0:
                return
            with suppress(TimeoutError):
                async with asyncio.timeout(remaining):
                    await self._changed.wait()

    async def _send_on_return(self) -> None:
        async for _ in self._network.changes():
            if self._network.connected:
                await self.send_all()

    async def _send_to_newcomers(self, appeared: asyncio.Event) -> None:
        while True:
            await appeared.wait()
            appeared.clear()
            log.debug(
                "a provider or validator appeared: all unsent messages are sent again",
                extra=log_event("provider-appeared"),
            )
            await self.send_all()
