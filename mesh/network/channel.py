"""A lighthouse's channel: the market's messages, published and received verified.

A lighthouse is a market; in keys it is its ENS name. Messages on the wire are gone once sent: the provider's order
book is the market's memory and answers queries with the open orders, so `Subscription.recall` after subscribing
misses nothing.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Self

import zenoh

from mesh.errors import ClosedError, InputError, InvalidKey
from mesh.network.addressing import KINDS, message_key
from mesh.network.subscription import RECALL_LIMIT, RECALL_TIMEOUT, Subscription
from mesh.network.validation import M, MessageValidator
from schemas import (
    Result,
    SignedMessage,
    encode,
    lighthouse_selector,
    market_selector,
    parse_address,
    presence_selector,
)
from schemas.keys import PresenceKey, parse_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType

    from mesh.network.subscription import Resolver

log = logging.getLogger(__name__)


class Channel:
    """The channel of one lighthouse on an open session: `async with Channel(session, lighthouse) as channel`.

    `lighthouse` is the ENS name of the market. `address`, where it is known, is what orders must name as their
    lighthouse; `resolver` looks up ENS names in messages; `head` tells the latest block, for deadlines. Leaving
    `async with` withdraws the presence tokens; the session stays the caller's to close. Raises `InvalidKey` for a name
    that no key may hold.
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
        lighthouse_selector(self.lighthouse)  # raises InvalidKey for a name that no key may hold
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
        """Put bytes on a concrete key of the mesh, dropping rather than blocking when a link is congested.

        Raises `InvalidKey` for a key with a wildcard: it would reach everybody.
        """
        self._check_open()
        if "*" in key:
            raise InvalidKey(key, "it has a wildcard")
        self._session.put(key, payload, encoding="application/json", congestion_control=zenoh.CongestionControl.DROP)

    def subscribe(self, kind: type[M], *, model: str = "*", liability: str = "*") -> Subscription[M]:
        """The verified messages of `kind` (`Demand`, `Offer` or `Result`) from now on.

        With `model` (CIDv0) the network sends that model's orders only, with `liability` (an address) the Results for
        that only.
        """
        self._check_open()
        selector = market_selector(self.lighthouse, KINDS[kind], model)
        if liability != "*":
            selector = self._result_selector(kind, liability)
        door: MessageValidator[M] = MessageValidator(
            kind, lighthouse=self.lighthouse, address=self.address, head=self._head
        )
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
        handler: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(RECALL_LIMIT)
        replies = self._session.liveliness().get(presence_selector(self.lighthouse), handler, timeout=RECALL_TIMEOUT)
        texts = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return list(_presence_keys(sorted(texts)))

    def _result_selector(self, kind: type[Any], liability: str) -> str:
        if kind is not Result:
            raise InputError(f"the keys of a {KINDS[kind]} do not name a liability")
        return market_selector(self.lighthouse, "result").replace("*", parse_address(liability).lower(), 1)

    def _check_open(self) -> None:
        if not self._open:
            raise ClosedError("the channel is not open", hint="use it inside `async with`")


def _presence_keys(texts: list[str]) -> Iterator[PresenceKey]:
    """Those of the keys that are in the keyspace: anybody may declare a token on any."""
    for text in texts:
        try:
            key = parse_key(text)
        except InvalidKey as error:
            log.debug("a presence token is left out: %s", error)
            continue
        if isinstance(key, PresenceKey):
            yield key
