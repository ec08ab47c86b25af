"""What the page knows of the market: orders, and what providers and agents say of them."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web.contracts import ContractFollower
from bridges.web.views import result_json
from mesh.background import Background
from mesh.errors import AiraError
from mesh.flood import BoundedDict
from mesh.market.refusals import Refusal
from mesh.role import Lifecycle
from mesh.watching import JobEvent, MarketWatch
from schemas import Demand, Offer, Result, Verified
from schemas.signing import Decline, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    from bridges.web.components import WebComponents
    from bridges.web.stream import Stream
    from mesh.watching import MarketEvent

ORDERS: Final = 16_384
"""Orders that are remembered, the latest ones; those that were posted here besides."""
STATEMENTS: Final = 32
"""Rejections and declines of one order that are remembered."""
PROVIDERS_AGE: Final = 15.0
"""Seconds after which the list of providers is read again."""
LONGEST_DETAIL: Final = 500
ASKERS: Final = 1024
"""Accounts whose latest question is remembered: a demand that pays nothing."""
ANSWERS: Final = 8
"""Answers to one question that are remembered."""
AMOUNTS: Final = ("cost", "validatorFee", "lighthouseFee")


@dataclass(eq=False)
class SeenOrder:
    """An order, and what became of it."""

    verified: Verified[Any]
    at: float
    withdrawn: bool = False
    liability: str = ""
    statements: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    answers: list[dict[str, Any]] = field(default_factory=list)
    """Results without a contract, if the order pays nothing."""

    @property
    def hash(self) -> str:
        """Its hash, hexadecimal."""
        return self.verified.hash.hex()

    @property
    def message(self) -> Demand | Offer:
        """The order itself."""
        message: Demand | Offer = self.verified.message
        return message

    def json(self) -> dict[str, Any]:
        """The order with its hash and its signer."""
        fields: dict[str, Any] = msgspec.to_builtins(self.message)
        fields |= {name: str(fields[name]) for name in AMOUNTS if name in fields}
        fields |= {"nonce": str(fields["nonce"]), "sender": fields.get("sender")}
        about = {"kind": self.message.kind, "generation": self.message.generation}
        return {"hash": self.hash, "signer": self.verified.signer, "at": self.at} | about | fields

    def state(self, head: int) -> str:
        """`open`, `withdrawn`, `contract` or `expired`."""
        if self.liability:
            return "contract"
        if self.withdrawn:
            return "withdrawn"
        return "expired" if self.message.deadline <= head else "open"


class Market(Lifecycle):
    """The market as the page shows it: `async with Market(components, stream) as market`. Used in one event loop.

    Changes are published on `stream`. `from_block` is the first block whose contracts are listed.
    """

    title = "market of the page"

    def __init__(
        self, components: WebComponents, stream: Stream, *, from_block: int = 0, clock: Callable[[], float] = time.time
    ) -> None:
        self._parts = components
        self._stream = stream
        self._clock = clock
        self.contracts = ContractFollower(components, stream, self, from_block=from_block, clock=clock)
        self._seen: BoundedDict[str, SeenOrder] = BoundedDict(ORDERS)
        self._questions: BoundedDict[str, SeenOrder] = BoundedDict(ASKERS)
        self._posted: dict[str, SeenOrder] = {}
        """Orders that were posted here: they are remembered until their deadline."""
        self.dropped = 0
        """Orders that were forgotten because there are too many."""
        self._providers: frozenset[str] = frozenset()
        self._providers_at = float("-inf")

    @property
    def head(self) -> int:
        """The last block."""
        return self._parts.chain_head.head

    async def _open(self, stack: AsyncExitStack) -> None:
        watch = await stack.enter_async_context(MarketWatch(self._parts.network.session, self._parts.channel))
        await stack.enter_async_context(self.contracts)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._follow(watch), "page: market")
        tasks.start(watch.recall(), "page: open orders")

    def order(self, order_hash: str) -> SeenOrder | None:
        """An order by its hash."""
        return self._posted.get(order_hash) or self._seen.get(order_hash)

    def orders(self) -> list[SeenOrder]:
        """All orders that are remembered, oldest first."""
        return list({order.hash: order for order in (*self._seen.values(), *self._posted.values())}.values())

    def add(self, verified: Verified[Any], *, posted: bool = False) -> SeenOrder:
        """Remember an order, and publish it if it is new."""
        order_hash = verified.hash.hex()
        known = self.order(order_hash)
        if known is not None and known.verified.signer != verified.signer and not posted:
            return known  # the same terms, signed by another account
        if known is None or known.verified.signer != verified.signer:
            known = SeenOrder(verified, self._clock())
            known.liability = self.contracts.matched.get((order_hash, verified.signer), "")
            self._stream.publish("market", "order", known.json())
        if posted and isinstance(known.message, Demand) and not known.message.cost:
            self._questions[verified.signer] = known
        if posted:
            self._posted[order_hash] = known
        elif order_hash not in self._seen:
            self.dropped += len(self._seen) >= ORDERS
            self._seen[order_hash] = known
        return known

    def changed(self, order: SeenOrder, kind: str) -> None:
        """Publish what became of an order."""
        self._stream.publish(f"order/{order.hash}", kind, self.posted_json(order))

    def posted_json(self, order: SeenOrder) -> dict[str, Any]:
        """An order and what became of it."""
        return {
            "order": order.json(),
            "state": order.state(self.head),
            "liability": order.liability or None,
            "statements": list(order.statements.values()),
            "answers": order.answers,
        }

    async def providers(self) -> frozenset[str]:
        """The providers with a stake, a few seconds old; the last ones known while the node does not answer."""
        if time.monotonic() - self._providers_at > PROVIDERS_AGE:
            self._providers_at = time.monotonic()
            with suppress(AiraError):
                state = await self._parts.chain.lighthouses.get(self._parts.lighthouse)
                self._providers = frozenset(state.stakes)
        return self._providers

    def matched(self, order_hash: str, maker: str, liability: str) -> None:
        """See `ContractListener`."""
        order = self.order(order_hash)
        if order is not None and order.verified.signer == maker:
            order.liability = liability
            self.changed(order, "contract" if liability else "open")

    def new_head(self, block: int) -> None:
        """See `ContractListener`."""
        for order in [order for order in self._posted.values() if order.message.deadline <= block]:
            self._seen[order.hash] = self._posted.pop(order.hash)
            if order.state(block) == "expired":
                self.changed(order, "expired")

    async def _follow(self, watch: MarketWatch) -> None:
        async for event in watch:
            await self._take(event)

    async def _take(self, event: MarketEvent) -> None:
        match event:
            case Verified(message=Result() as result):
                self.contracts.take_result(Verified(result, event.hash, event.signer))
                self._take_answer(Verified(result, event.hash, event.signer))
            case Verified():
                self.add(event)
            case Rejection(order=order_hash, provider=agent, reason=code):
                if agent in await self.providers():
                    self._state(order_hash, "rejected", agent, code, event.detail)
            case Decline(order=order_hash, agent=agent, code=code):
                self._state(order_hash, "declined", agent, code, event.detail)
            case ValidatorReport():
                await self.contracts.take_report(event)
            case JobEvent(agent, "ready", liability):
                self.contracts.say(liability.address, agent, "ready", "")
            case JobEvent(agent, "complete", liability):
                self.contracts.say(liability.address, agent, "result", liability.result)

    def _take_answer(self, result: Verified[Result]) -> None:
        """A Result for an account, not for a contract, answers the latest question of that account."""
        order = self._questions.get(result.message.liability)
        if order is None or len(order.answers) >= ANSWERS:
            return
        answer = result_json(result) | {"at": self._clock()}
        if all(known["signature"] != answer["signature"] for known in order.answers):
            order.answers.append(answer)
            self.changed(order, "answered")

    def _state(self, order_hash: str, kind: str, agent: str, code: str, detail: str) -> None:
        """Remember and publish a rejection or a decline."""
        statement = {"kind": kind, "agent": agent, "code": code, "detail": detail[:LONGEST_DETAIL], "at": self._clock()}
        self._stream.publish("market", kind, statement | {"order": order_hash})
        order = self.order(order_hash)
        if order is None:
            return
        order.withdrawn = order.withdrawn or code == Refusal.WITHDRAWN
        if len(order.statements) < STATEMENTS or (agent, code) in order.statements:
            order.statements[agent, code] = statement
        self.changed(order, "withdrawn" if code == Refusal.WITHDRAWN else kind)
