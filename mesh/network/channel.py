"""A lighthouse's channel: the market's messages, published and received verified.

A lighthouse is a market; in keys it is its ENS name. Messages on the wire are gone once sent: the provider's order
book is the market's memory and answers queries with the open orders, so `Subscription.recall` after subscribing
misses nothing.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, Generic, Self

import zenoh

from mesh.errors import AiraError, ClosedError, InputError
from mesh.network.pump import Pump
from mesh.network.verification import Door, M, Statistics, Unresolved
from schemas import Demand, Offer, Result, SignedMessage, Verified, encode, market_selector, message_hash, names_in
from schemas.keys import DemandKey, MarketKind, OfferKey, PresenceKey, ResultKey, parse_key

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType

    Resolver = Callable[[str], Awaitable[str]]

log = logging.getLogger(__name__)

RECALL_TIMEOUT: Final = 5.0
"""Seconds given to the providers to answer with their open orders."""
RECALL_LIMIT: Final = 65_536
"""Open orders taken from one recall at most."""
KINDS: Final[dict[type[Any], MarketKind]] = {Demand: "demand", Offer: "offer", Result: "result"}
"""What each message is called in keys."""


def message_key(lighthouse: str, message: SignedMessage) -> str:
    """The key on which `message` belongs at `lighthouse` (ENS name)."""
    digest = message_hash(message).hex()
    match message:
        case Demand():
            return str(DemandKey(lighthouse, message.model, digest))
        case Offer():
            return str(OfferKey(lighthouse, message.model, digest))
        case Result():
            return str(ResultKey(lighthouse, message.liability, digest))


class Subscription(Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    Ends by leaving `async with`; nothing arrives after that. One consumer. A message that names addresses by ENS
    waits here until they are looked up.
    """

    def __init__(self, session: zenoh.Session, selector: str, door: Door[M], resolver: Resolver | None) -> None:
        self._session = session
        self._selector = selector
        self._door: Door[M] = door
        self._resolver = resolver
        self._pump: Pump[Verified[M] | Unresolved[M]] = Pump(session, selector, door)

    async def __aenter__(self) -> Self:
        await self._pump.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._pump.__aexit__(kind, error, trace)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Verified[M]:
        while True:
            item = await anext(self._pump)
            verified = await self._resolve(item) if isinstance(item, Unresolved) else item
            if verified is not None:
                return verified

    async def _resolve(self, unresolved: Unresolved[M]) -> Verified[M] | None:
        if self._resolver is None:
            self._door.invalid["name"] += 1
            return None
        try:
            addresses = {name: await self._resolver(name) for name in names_in(unresolved.message)}
        except AiraError as error:
            log.info("a message names what can't be resolved: %s", error)
            self._door.invalid["name"] += 1
            return None
        return self._door.resolved(unresolved, addresses)

    async def recall(self) -> None:
        """Ask the market's memory for what is open; the answers come out of the iterator, once each.

        Returns when all providers have answered or `RECALL_TIMEOUT` has passed; nobody there is no error.
        """
        await asyncio.to_thread(self._recall)

    def _recall(self) -> None:
        replies = self._session.get(
            self._selector,
            zenoh.handlers.RingChannel(RECALL_LIMIT),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=RECALL_TIMEOUT,
        )
        for reply in replies:
            if reply.ok is not None:
                self._pump.feed(reply.ok)

    def statistics(self) -> Statistics:
        """What came in so far, what of it was refused and why, what was lost to a slow consumer."""
        return Statistics(
            received=self._pump.received,
            invalid=dict(self._door.invalid),
            duplicate=self._door.duplicate,
            dropped=self._pump.dropped,
        )


class Channel:
    """The channel of one lighthouse on an open session: `async with Channel(session, lighthouse) as channel`.

    `lighthouse` is the ENS name of the market. `address`, where it is known, is what orders must name as their
    lighthouse; `resolver` looks up ENS names in messages; `head` tells the latest block, for deadlines. Leaving
    `async with` withdraws the presence tokens; the session stays the caller's to close.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        *,
        address: str | None = None,
        resolver: Resolver | None = None,
        head: Callable[[], int] = lambda: 0,
    ) -> None:
        self._session = session
        self.lighthouse = lighthouse.lower()
        self.address = address
        self._resolver = resolver
        self._head = head
        self._tokens: list[Any] = []
        self._open = False

    async def __aenter__(self) -> Self:
        if self._open:
            raise ClosedError("this channel is open already")
        self._open = True
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        tokens, self._tokens = self._tokens, []
        if not self._session.is_closed():
            for token in tokens:
                token.undeclare()

    def publish(self, message: SignedMessage) -> str:
        """Put a signed message on its key, at most once and without waiting; returns the key.

        Nothing tells whether anybody heard it: what must arrive is sent again until its effect is seen. Raises
        `InputError` for a message without signature.
        """
        self._check_open()
        if not message.signature:
            raise InputError("an unsigned message can't be published", hint="sign it first")
        key = message_key(self.lighthouse, message)
        self.put(key, encode(message))
        return key

    def put(self, key: str, payload: bytes) -> None:
        """Put bytes on a concrete key of the mesh, dropping rather than blocking when a link is congested."""
        self._check_open()
        self._session.put(
            key, payload, encoding="application/json", congestion_control=zenoh.CongestionControl.DROP, express=True
        )

    def subscribe(self, kind: type[M], *, model: str = "*") -> Subscription[M]:
        """The verified messages of `kind` (`Demand`, `Offer` or `Result`) from now on.

        `model` (CIDv0) lets the network send only that model's orders; for Results it is the liability's address.
        """
        self._check_open()
        door: Door[M] = Door(kind, lighthouse=self.lighthouse, address=self.address, head=self._head)
        selector = market_selector(self.lighthouse, KINDS[kind], model)
        return Subscription(self._session, selector, door, self._resolver)

    def announce(self, role: str, address: str) -> None:
        """Show that the agent at `address` is here as `role`, for as long as the channel is open."""
        self._check_open()
        key = str(PresenceKey(self.lighthouse, role, address))
        self._tokens.append(self._session.liveliness().declare_token(key))

    async def present(self) -> list[PresenceKey]:
        """Who is on the channel now: each announced role and address, in the order of their keys."""
        self._check_open()
        return await asyncio.to_thread(self._present)

    def _present(self) -> list[PresenceKey]:
        selector = f"aira/{self.lighthouse}/@agent/*/*"
        handler: zenoh.handlers.RingChannel[zenoh.Reply] = zenoh.handlers.RingChannel(RECALL_LIMIT)
        replies = self._session.liveliness().get(selector, handler, timeout=RECALL_TIMEOUT)
        texts = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        keys = [parse_key(text) for text in sorted(texts)]
        return [key for key in keys if isinstance(key, PresenceKey)]

    def _check_open(self) -> None:
        if not self._open:
            raise ClosedError("the channel is not open", hint="use it inside `async with`")
