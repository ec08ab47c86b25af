"""A lighthouse's channel: publishes the market's messages, and receives them verified.

Zenoh keeps no messages; the providers' order books answer queries with the open orders. To miss nothing, subscribe
first, then call `Subscription.recall`.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.background import call_in_loop
from mesh.errors import ClosedError, InputError, InvalidKey
from mesh.flood import Drops
from mesh.network import sending
from mesh.network.subscription import Subscription
from mesh.network.validation import MessageValidator, message_key
from schemas import SignedMessage, encode
from schemas.keys import PresenceKey, parse_key
from schemas.selectors import lighthouse_selector, market_selector, presence_selector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mesh.blocklist import BlockedSigners
    from mesh.network.lookups import M, Resolver, ValidatorCheck

PRESENT_LIMIT: Final = 1024
"""Agents that a question for presence returns, at most."""
ANSWER_TIMEOUT: Final = 5.0
"""Seconds that others have to answer a query."""


class Channel:
    """The channel of one lighthouse on an open session: `async with Channel(session, lighthouse) as channel`.

    `lighthouse` is the ENS name of the market. `address`, if given, is the lighthouse that orders must name;
    `resolver` resolves ENS names in messages; `validators` knows which validators orders may name (None: any); `head`
    returns the latest block number, for deadlines; messages of `blocked` signers are rejected; `drops` counts what is
    dropped; a query ends after `answer_timeout` seconds. Leaving `async with` withdraws the tokens and ends the
    watches, but does not close the session. Raises `InvalidKey` for a name that no key may contain.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        *,
        address: str | None = None,
        resolver: Resolver | None = None,
        validators: ValidatorCheck | None = None,
        head: Callable[[], int] = lambda: 0,
        blocked: BlockedSigners = frozenset(),
        drops: Drops | None = None,
        answer_timeout: float = ANSWER_TIMEOUT,
    ) -> None:
        self._session = session
        self.answer_timeout: Final = answer_timeout
        self.lighthouse = lighthouse.lower()
        lighthouse_selector(self.lighthouse)  # raises InvalidKey
        self.address = address
        self._validator_of = partial(
            MessageValidator,
            lighthouse=self.lighthouse,
            address=address,
            head=head,
            resolver=resolver,
            validators=validators,
            blocked=blocked,
        )
        self._drops = Drops() if drops is None else drops
        self._declarations: list[Any] = []
        self._open = False

    async def __aenter__(self) -> Self:
        if self._open:
            raise ClosedError("this channel is already open")
        self._open = True
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        if not self._session.is_closed():
            for declaration in self._declarations:
                declaration.undeclare()
        self._declarations.clear()

    def publish(self, message: SignedMessage) -> str:
        """Put a signed message on its key, at most once and without waiting; return the key.

        Delivery is not confirmed: send a message that must arrive again until its effect is seen. Raises `InputError`
        for a message without a signature.
        """
        self._check_open()
        if not message.signature:
            raise InputError("an unsigned message can't be published", hint="sign it first")
        key = message_key(self.lighthouse, message)
        self.put(key, encode(message))
        return key

    def put(self, key: str, payload: bytes) -> None:
        """Put bytes on a key; a congested link drops them. Raises `InvalidKey` for a wildcard: it would reach all."""
        self._check_open()
        if "*" in key:
            raise InvalidKey(key, "it contains a wildcard")
        sending.put(self._session, key, payload)

    def subscribe(self, kind: type[M], *, model: str = "*") -> Subscription[M]:
        """Subscribe to the verified messages of `kind` (`Demand`, `Offer`, `Withdrawal` or `Result`).

        `model` (CIDv0) limits orders to that model; the network filters at the source.
        """
        self._check_open()
        selector = market_selector(self.lighthouse, kind.kind, model)
        return Subscription(self._session, selector, self._validator_of(kind), self._drops, self.answer_timeout)

    def announce(self, role: str, address: str) -> None:
        """Announce the agent at `address` as present in `role`, for as long as the channel is open."""
        self._check_open()
        key = str(PresenceKey(self.lighthouse, role, address))
        self._declarations.append(self._session.liveliness().declare_token(key))

    def watch_presence(
        self,
        appeared: Callable[[PresenceKey], object],
        *,
        gone: Callable[[PresenceKey], object] = lambda key: None,
        role: str = "*",
    ) -> None:
        """Call `appeared` for each announced agent, those of now included, and `gone` when one leaves.

        `role` limits this to agents in that role, such as `provider`. The callbacks run in the event loop, in the
        caller's context, until the channel closes. An agent whose link to its router broke is gone, too, and appears
        again when the link is restored.
        """
        self._check_open()
        loop, context = asyncio.get_running_loop(), copy_context()

        def changed(sample: zenoh.Sample) -> None:
            for key in _presence_keys([str(sample.key_expr)]):
                notify = appeared if sample.kind == zenoh.SampleKind.PUT else gone
                call_in_loop(loop, notify, key, context=context)

        selector = presence_selector(self.lighthouse, role)
        self._declarations.append(self._session.liveliness().declare_subscriber(selector, changed, history=True))

    async def present(self, role: str = "*", agent: str = "*") -> list[PresenceKey]:
        """The agents that are announced on the channel now, or those in a `role`, or an `agent` (address).

        At most `PRESENT_LIMIT`, in the order of their keys; more are counted in `drops`. Anybody may announce any
        number of agents: ask for the role, or the agent, that matters.
        """
        self._check_open()
        ask, selector = self._session.liveliness().get, presence_selector(self.lighthouse, role, agent)
        handler: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(PRESENT_LIMIT)

        def collect() -> list[PresenceKey]:
            found = {str(reply.ok.key_expr) for reply in islice(replies, PRESENT_LIMIT) if reply.ok is not None}
            if more := sum(1 for _ in replies):
                self._drops.count("presence", number=more)
            return list(_presence_keys(sorted(found)))

        replies = iter(ask(selector, handler, timeout=self.answer_timeout))
        return await asyncio.to_thread(collect)

    def _check_open(self) -> None:
        if not self._open:
            raise ClosedError("the channel is not open", hint="use it inside `async with`")


def _presence_keys(texts: list[str]) -> Iterator[PresenceKey]:
    """The valid keys among `texts`: anybody may declare a token on any key."""
    for text in texts:
        with suppress(InvalidKey):
            key = parse_key(text)
            if isinstance(key, PresenceKey):
                yield key
