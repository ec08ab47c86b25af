"""A lighthouse's channel: publishes the market's messages, and receives them verified.

Zenoh keeps no messages; the providers' order books answer queries with the open orders. To miss nothing, subscribe
first, then call `Subscription.recall`. Which agents are present is asked at a limited rate, about those whose
statements arrive.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from contextvars import copy_context
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self

import zenoh

from mesh.base.background import call_in_loop
from mesh.base.flood import Drops, FairQueue, KnownSenders, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.errors import InputError, InvalidKey
from mesh.network import sending
from mesh.network._validation import M, MarketRules, MessageValidator, Unresolved, message_key
from mesh.network.presence import PresenceWatch, present_keys
from mesh.network.pump import PUMP_LIMITS, PUMP_PACE, Pump, ResentConversion
from mesh.network.services import declared
from mesh.telemetry.metrics import MetricFamily, MetricSample
from schemas import MAX_MESSAGE_SIZE, SignedMessage, Verified, encode
from schemas.keys import PresenceKey, lighthouse_selector, market_selector, parse_key, presence_selector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from contextlib import AsyncExitStack

    from mesh.network._validation import ValidationStatistics


QUESTIONS: Final = Rate(per_second=50, burst=500)
"""Questions whether agents with unknown addresses are present."""


class PresentAgents:
    """The agents that were found present on `channel`, in any role. They are remembered."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._known = KnownSenders(65_536)
        self._questions = RateLimiter(per_sender=Rate(per_second=0.5, burst=4), total=QUESTIONS)

    async def is_present(self, agent: str) -> bool:
        """Whether an agent (address) was found present. Who is unknown is asked after, at a limited rate."""
        if agent in self._known:
            return True
        is_present = self._questions.allow(agent) and bool(await self._channel.present(agent=agent))
        if is_present:
            self._known.add(agent)
        return is_present


class RecallLimits(NamedTuple):
    """What is accepted of the answers to one recall."""

    orders: int = 65_536
    """Open orders."""
    size: int = 64 << 20
    """Bytes of them."""


class LookupLimits(NamedTuple):
    """About how many messages a subscription asks the chain."""

    waiting: int = 256
    """Messages that may wait for an answer, half of them from one signer; more are rejected. Messages with names, whose
    signer is not known yet, share one signer's part."""
    rate: Rate = Rate(40, 256)
    """Messages that are asked about."""
    rate_of_signer: Rate = Rate(10, 64)
    """Those of one signer."""


RECALL_LIMITS: Final = RecallLimits()
LOOKUP_LIMITS: Final = LookupLimits()


class Subscription(Pump[Verified[M] | Unresolved[M]], Generic[M]):
    """The verified messages of one kind, as an async iterator: `async with channel.subscribe(Demand) as demands`.

    A message about which the chain must be asked (ENS names, unknown validators) may be overtaken by later ones.
    """

    def __init__(
        self, session: zenoh.Session, selector: str, validator: MessageValidator[M], drops: Drops, answer_timeout: float
    ) -> None:
        super().__init__(
            session,
            selector,
            ResentConversion(self._copy, validator.check_all),
            limits=PUMP_LIMITS._replace(payload=MAX_MESSAGE_SIZE),
            drops=drops,
        )
        self._validator: MessageValidator[M] = validator
        self._answer_timeout = answer_timeout
        self.kind: Final = validator.message_type.kind
        """The kind of message, as in its key: `demand`, `result`, …"""
        self._unresolved: FairQueue[Unresolved[M]] = FairQueue(
            per_sender=LOOKUP_LIMITS.waiting // 2, total=LOOKUP_LIMITS.waiting
        )
        self._lookup_rate = RateLimiter(per_sender=LOOKUP_LIMITS.rate_of_signer, total=LOOKUP_LIMITS.rate)
        self._queries: set[zenoh.CancellationToken] = set()

    async def __aenter__(self) -> Self:
        await super().__aenter__()
        self._lookups = asyncio.create_task(self._ask_chain(), name=f"ask the chain about {self.selector}")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._lookups.cancel()
        for query in tuple(self._queries):
            query.cancel()  # type: ignore[no-untyped-call]
        await super().__aexit__(*exc_info)

    async def __anext__(self) -> Verified[M]:
        while True:
            if (item := self.take_ready()) is None:
                item = await super().__anext__()
            if not isinstance(item, Unresolved):
                return item
            for dropped in self._unresolved.put(item.signer, item):
                self._drop_lookup(dropped)

    def _drop_lookup(self, unresolved: Unresolved[M]) -> None:
        self._validator.reject(unresolved.question)
        self._drops.count("lookup", unresolved.signer)

    def _copy(self, samples: list[zenoh.Sample]) -> list[tuple[str, bytes] | None]:
        """What is checked of samples; None for a copy of an accepted message: it needs no place in the ring."""
        keys = [str(sample.key_expr) for sample in samples]
        payloads = [sample.payload.to_bytes() for sample in samples]
        return self._validator.without_copies(zip(keys, payloads, strict=True))

    async def recall(self) -> None:
        """Ask the providers for the open orders; the iterator yields each new one once.

        Returns when all providers have answered, or after `answer_timeout`, also without a provider. Cancelling this
        call or leaving `async with` ends the query.
        """
        self.check_entered()
        query = zenoh.CancellationToken()
        self._queries.add(query)
        try:
            await asyncio.to_thread(self._recall, query)
        finally:
            self._queries.discard(query)
            query.cancel()  # type: ignore[no-untyped-call]

    def _recall(self, query: zenoh.CancellationToken) -> None:
        """Empty Zenoh's queue before verifying signatures: a full queue would stall the session."""
        # Not a RingChannel, which loses what it still holds when the last reply arrives.
        replies = self._session.get(
            self.selector,
            zenoh.handlers.FifoChannel(RECALL_LIMITS.orders),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._answer_timeout,
            cancellation_token=query,
        )
        copies, size = list[Any](), 0
        for sample in (reply.ok for reply in replies if reply.ok is not None):
            if len(copies) == RECALL_LIMITS.orders or size >= RECALL_LIMITS.size:
                self._drops.count("recall")
            elif (copied := self.copy(sample)) is not None:
                copies.append(copied)
                size += len(sample.payload)
        for start in range(0, len(copies), PUMP_PACE.batch):
            if not query.is_cancelled:
                self.feed(copies[start : start + PUMP_PACE.batch])

    def forget(self, verified: Verified[M], *, after: float = 0.0) -> None:
        """Deliver a message once more when it is sent again, `after` seconds; see `MessageValidator`."""
        self._validator.forget(verified, after=after)

    def statistics(self) -> ValidationStatistics:
        """The messages received, rejected (by reason) and dropped so far."""
        return self._validator.statistics(received=self.received, dropped=self.dropped)

    async def _ask_chain(self) -> None:
        """Ask the chain about one message after another. An unexpected error ends the iteration."""
        try:
            while True:
                unresolved = await self._unresolved.get()
                if not self._lookup_rate.allow(unresolved.signer):
                    self._drop_lookup(unresolved)
                elif (verified := await self._validator.complete(unresolved)) is not None:
                    self.insert(verified)
        except Exception as error:
            self.fail(error)


def message_families(subscriptions: Iterable[Subscription[Any]]) -> tuple[MetricFamily, ...]:
    """Messages received over these subscriptions, by kind and verdict, and those dropped before validation."""
    counts = [(subscription.kind, subscription.statistics()) for subscription in subscriptions]
    verdicts = [
        MetricSample(number, {"kind": kind, "verdict": verdict})
        for kind, one in counts
        for verdict, number in [("accepted", one.accepted), ("duplicate", one.duplicate), *sorted(one.invalid.items())]
    ]
    return (
        MetricFamily(
            "aira_messages_total",
            "counter",
            "Messages received, by kind and verdict: accepted, duplicate, or the reason for rejection",
            tuple(verdicts),
        ),
        MetricFamily(
            "aira_messages_dropped_total",
            "counter",
            "Messages dropped unseen, the oldest first, because they arrived faster than they were processed",
            tuple(MetricSample(one.dropped, {"kind": kind}) for kind, one in counts),
        ),
    )


ANSWER_TIMEOUT: Final = 5.0
"""Seconds that others have to answer a query."""


class Channel(Lifecycle):
    """The channel of one lighthouse on an open session: `async with Channel(session, lighthouse) as channel`.

    `market` has the rules of the market, or is its ENS name: then orders may name any lighthouse address and validator,
    and neither ENS names nor deadlines can be checked. `drops` counts what is dropped; a query ends after
    `answer_timeout` seconds. Leaving `async with` withdraws the tokens and ends the watches, but does not close the
    session. Raises `InvalidKey` for a name that no key may contain.
    """

    title = "channel"

    def __init__(
        self,
        session: zenoh.Session,
        market: MarketRules | str,
        *,
        drops: Drops | None = None,
        answer_timeout: float = ANSWER_TIMEOUT,
    ) -> None:
        self._session = session
        self.answer_timeout: Final = answer_timeout
        self._rules = MarketRules(market) if isinstance(market, str) else market
        self.lighthouse: Final = self._rules.lighthouse
        lighthouse_selector(self.lighthouse)  # raises InvalidKey
        self._drops = Drops() if drops is None else drops

    @property
    def address(self) -> str | None:
        """The lighthouse's address, where it is known."""
        return self._rules.address

    async def _open(self, stack: AsyncExitStack) -> None:
        """Announcements and watches are added later."""

    def publish(self, message: SignedMessage) -> str:
        """Put a signed message on its key, at most once and without waiting; return the key.

        Delivery is not confirmed: send a message that must arrive again until its effect is seen. Raises `InputError`
        for a message without a signature.
        """
        self.check_open()
        if not message.signature:
            raise InputError("an unsigned message can't be published", hint="sign it first")
        key = message_key(self.lighthouse, message)
        self.put(key, encode(message))
        return key

    def put(self, key: str, payload: bytes) -> None:
        """Put bytes on a key; a congested link drops them. Raises `InvalidKey` for a wildcard: it would reach all."""
        self.check_open()
        if "*" in key:
            raise InvalidKey(key, "it contains a wildcard")
        sending.put(self._session, key, payload)

    def subscribe(self, message_type: type[M], *, model: str = "*") -> Subscription[M]:
        """Subscribe to the verified messages of `message_type` (`Demand`, `Result`, …).

        `model` (CIDv0) limits orders to that model; the network filters at the source.
        """
        self.check_open()
        selector = market_selector(self.lighthouse, message_type.kind, model)
        return Subscription(
            self._session, selector, MessageValidator(message_type, self._rules), self._drops, self.answer_timeout
        )

    async def verified(self, message: M) -> Verified[M]:
        """A message that came another way, checked as a subscription does. Raises `InvalidMessage`."""
        self.check_open()
        return await self._rules.verified(message)

    def announce(self, role: str, address: str) -> None:
        """Announce the agent at `address` as present in `role`, for as long as the channel is open."""
        stack, key = self.check_open(), str(PresenceKey(self.lighthouse, role, address))
        stack.enter_context(declared(self._session, self._session.liveliness().declare_token(key)))

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
        stack = self.check_open()
        loop, context = asyncio.get_running_loop(), copy_context()

        def changed(text: str, is_present: bool) -> None:
            for key in _presence_keys([text]):
                call_in_loop(loop, appeared if is_present else gone, key, context=context)

        stack.callback(PresenceWatch(self._session, presence_selector(self.lighthouse, role), changed).end)

    async def present(self, role: str = "*", agent: str = "*") -> list[PresenceKey]:
        """The agents that are announced on the channel now, or those in a `role`, or an `agent` (address).

        At most `PRESENT_LIMIT`, in the order of their keys; more are counted in `drops`. Anybody may announce any
        number of agents: ask for the role, or the agent, that matters.
        """
        self.check_open()
        selector = presence_selector(self.lighthouse, role, agent)
        found = await asyncio.to_thread(
            present_keys, self._session, selector, timeout=self.answer_timeout, drops=self._drops
        )
        return list(_presence_keys(found))


def _presence_keys(texts: list[str]) -> Iterator[PresenceKey]:
    """The valid keys among `texts`: anybody may declare a token on any key."""
    for text in texts:
        with suppress(InvalidKey):
            key = parse_key(text)
            if isinstance(key, PresenceKey):
                yield key
