"""What the page knows of the market: orders, contracts, what providers and agents say of them; and the orders and stops
that are posted here.

Contracts are as the chain has them. What agents say is kept only of a job's promisor, and everything is bounded. Orders
that people post are checked as a provider would, and published until they have an effect. In JSON, amounts are decimal
texts.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from bridges.web._access import WebError, unusable
from mesh.agent.contracts import is_about, send_stop, verdict_words
from mesh.agent.hiring import PROVIDERS, send_pair
from mesh.agent.orders import OrderState
from mesh.agent.validators import accepted_of
from mesh.base.background import Background
from mesh.base.flood import BoundedDict, Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.retry import Backoff
from mesh.chain import Finalized, NewLiability, Reorganisation
from mesh.cli.demand import JudgedTerms
from mesh.cli.liability import liability_json as record_json
from mesh.cli.liability import refund_words
from mesh.errors import AiraError, ChainError, RemoteError, public_text
from mesh.network import Pump
from mesh.role.program import RESEND
from mesh.watching import JobEvent, MarketWatch
from mesh.watching.market import query_all
from schemas import (
    Demand,
    EventKey,
    InvalidMessage,
    Liability,
    Offer,
    Permit,
    PlaybackPosition,
    ProgressKey,
    Result,
    Verified,
    Withdrawal,
    event_selector,
    parse_address,
    parse_key,
    verify,
    verify_message,
)
from schemas.decoding import InvalidData, decode_json
from schemas.rpc import OrderPair
from schemas.signing import Decline, Refusal, Rejection
from schemas.verdicts import ValidatorReport

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.web._stream import Stream
    from bridges.web.components import WebComponents
    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Progress
    from mesh.agent.trade import Order
    from mesh.chain import Chain
    from schemas import SignedMessage
    from schemas.rpc import Stopped
    from schemas.signing import StopRequest


class Labels:
    """What tokens are called, by address."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._known: BoundedDict[str, dict[str, Any]] = BoundedDict(1024)

    async def learn(self, token: str) -> dict[str, Any]:
        """The label of a token; asked of the chain once. One that is not well-known has its address in its symbol."""
        if token not in self._known:
            try:
                unit = (await self._chain.tokens.units([token]))[token]
            except ChainError:
                return self.of(token)
            self._known[token] = {"address": token, "symbol": unit.symbol, "decimals": unit.decimals}
        return self._known[token]

    def of(self, token: str) -> dict[str, Any]:
        """The label, as far as it is known."""
        return self._known.get(token) or {"address": token, "symbol": "", "decimals": 0}


def liability_json(liability: Liability, labels: Labels) -> dict[str, Any]:
    return record_json(liability) | {"token": labels.of(liability.token)}


def result_json(seen: Verified[Result]) -> dict[str, Any]:
    fields: dict[str, Any] = msgspec.to_builtins(seen.message)
    return fields | {"signer": seen.signer}


async def require_judged(parts: WebComponents, validator: str, fee: int | None) -> int:
    """The fee (wn) of a demand that names a validator (address or name); by default what it announces.

    Raises `RemoteError` if perhaps nobody judges, `UnsafeValidator` and its like, `ChainError`.
    """
    judged = await judged_terms(parts, validator, fee)
    if judged.doubts:
        hint = "name another validator, or order without one"
        raise RemoteError(f"not posted: {judged.reasons}", hint=hint, code="validator-doubtful")
    return judged.fee


async def judged_terms(parts: WebComponents, validator: str, fee: int | None) -> JudgedTerms:
    """What a validator (address or name) announces, and what to doubt about it; `fee` (wn) if the demand names one."""
    return await JudgedTerms.of(
        parts.chain,
        parts.validators,
        await parts.chain.names.address(validator),
        lighthouse=parts.lighthouse,
        generation=parts.settings.generation,
        fee=fee,
    )


class PageMarketLimits(NamedTuple):
    """What the page remembers of the market."""

    jobs: int = 16_384
    """Jobs, the latest ones."""
    steps: int = 32
    """Steps of one job."""
    orders: int = 16_384
    """Orders, the latest ones; those that were posted here besides."""
    sent: int = 4096
    """Orders and withdrawals that are published at a time …"""
    per_signer: int = 64
    """… and those of one signer."""


MARKET_LIMITS: Final = PageMarketLimits()
REPORTED: Final = Rate(per_second=4.0, burst=16)
"""Reports of an agent about its playbacks."""
PHASES: Final = {"incoming": "incoming", "ready": "ready", "playing": "running", "result": "complete"}
"""The phase of a job after each step."""


@dataclass(eq=False)
class SeenJob:
    """A liability as the chain has it, and what its promisor says of it."""

    liability: Liability
    demand: str
    """The hash of its demand."""
    offer: str
    steps: list[dict[str, Any]] = field(default_factory=list)
    playback: PlaybackPosition | None = None
    phase: str = "incoming"
    reports: dict[str, ValidatorReport] = field(default_factory=dict)
    """How jurors of its validator have judged, by juror."""
    stopped: dict[str, str] | None = None
    """Who has stopped it through this server (`by`), and `why`."""

    @property
    def orders(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """The hashes of its orders, each with its maker."""
        return (self.demand, self.liability.promisee), (self.offer, self.liability.promisor)


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
    robot: str = ""
    """The only robot (address) that it is for: then it is private, and its signature stays here. Empty for any."""

    @property
    def hash(self) -> str:
        return self.verified.hash.hex()

    @property
    def message(self) -> Demand | Offer:
        message: Demand | Offer = self.verified.message
        return message

    def json(self) -> dict[str, Any]:
        fields: dict[str, Any] = msgspec.to_builtins(self.message)
        fields |= {name: str(fields[name]) for name in AMOUNTS if name in fields}
        fields |= {"nonce": str(fields["nonce"]), "sender": fields.get("sender")}
        about: dict[str, Any] = {"kind": self.message.kind, "generation": self.message.generation}
        if self.robot:
            fields["signature"] = ""
        about |= {"private": bool(self.robot), "robot": self.robot or None}
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

    def __init__(self, components: WebComponents, stream: Stream, *, from_block: int) -> None:
        self._parts = components
        self._stream = stream
        self._from_block = from_block
        self._start = components.chain_head.head
        self.labels = Labels(components.chain)
        self._seen: BoundedDict[str, SeenOrder] = BoundedDict(MARKET_LIMITS.orders)
        self._posted: dict[str, SeenOrder] = {}
        """Orders that were posted here: they are remembered until their deadline."""
        # Accounts whose latest question is remembered: a demand that pays nothing.
        self._questions: BoundedDict[str, SeenOrder] = BoundedDict(1024)
        self.dropped = 0
        """Orders that were forgotten because there are too many."""
        self.jobs: BoundedDict[str, SeenJob] = BoundedDict(MARKET_LIMITS.jobs)
        self._matched: BoundedDict[tuple[str, str], str] = BoundedDict(2 * MARKET_LIMITS.jobs)
        """The contracts by order and maker."""
        self.results: BoundedDict[tuple[str, str], Verified[Result]] = BoundedDict(MARKET_LIMITS.jobs)
        """The signed results by liability and signer."""
        # Contracts of which agents spoke before they were read.
        self._said: BoundedDict[str, list[tuple[str, str, str]]] = BoundedDict(1024)
        """What agents said of liabilities that were not read yet: who, which step, detail."""
        self._unread: dict[str, dict[str, tuple[int, str]]] = {}
        self._has_unread = asyncio.Event()
        self._times: BoundedDict[int, float] = BoundedDict(MARKET_LIMITS.jobs)
        self._limiter = RateLimiter(per_sender=REPORTED)
        self._asking = asyncio.Semaphore(8)  # promisors that are asked for the phase of a job at a time
        self.on_contract: Callable[[SeenJob], object] = lambda _job: None
        """Called with a contract that is not finalized, when it is first read."""
        self._providers: frozenset[str] = frozenset()
        self._providers_at = float("-inf")

    @property
    def head(self) -> int:
        """The latest block that was read, as contracts count it, which deadlines and refunds go by."""
        return self._parts.chain_head.contract_block

    async def _open(self, stack: AsyncExitStack) -> None:
        session, enter = self._parts.network.session, stack.enter_async_context
        watch = await enter(MarketWatch(session, self._parts.channel))
        reports = await enter(Pump(session, event_selector(), _progress_in, drops=self._parts.drops))
        self._tasks = tasks = await enter(Background())
        tasks.start(self._follow_playbacks(reports), "page: playbacks")
        tasks.start(self._follow_chain(), "page: chain")
        tasks.start(self._read_contracts(), "page: contracts")
        tasks.start(self._follow(watch), "page: market")
        tasks.start(watch.recall(), "page: open orders")

    def order(self, order_hash: str) -> SeenOrder | None:
        return self._posted.get(order_hash) or self._seen.get(order_hash)

    def orders(self) -> list[SeenOrder]:
        """All orders that are remembered, oldest first."""
        return list({order.hash: order for order in (*self._seen.values(), *self._posted.values())}.values())

    def add(self, verified: Verified[Any], *, posted: bool = False, robot: str = "") -> SeenOrder:
        """Remember an order, and publish it if it is new and not for one `robot` (address) alone."""
        order_hash = verified.hash.hex()
        known = self.order(order_hash)
        if known is not None and known.verified.signer != verified.signer and not posted:
            return known  # the same terms, signed by another account
        if known is None or known.verified.signer != verified.signer:
            known = SeenOrder(verified, time.time(), robot=robot)
            known.liability = self._matched.get((order_hash, verified.signer), "")
            if not robot:
                self._stream.publish("market", "order", known.json())
        if posted and isinstance(known.message, Demand) and not known.message.cost:
            self._questions[verified.signer] = known
        if posted:
            self._posted[order_hash] = known
        elif order_hash not in self._seen:
            self.dropped += len(self._seen) >= MARKET_LIMITS.orders
            self._seen[order_hash] = known
        return known

    def changed(self, order: SeenOrder, kind: str) -> None:
        self._stream.publish(f"order/{order.hash}", kind, self.posted_json(order))

    def posted_json(self, order: SeenOrder) -> dict[str, Any]:
        return {
            "order": order.json(),
            "state": order.state(self.head),
            "liability": order.liability or None,
            "statements": list(order.statements.values()),
            "answers": order.answers,
        }

    async def job(self, address: str) -> SeenJob:
        """A job; read from the chain if it is not known. Raises `NotALiability`, `ChainError`."""
        if (known := self.jobs.get(address)) is None:
            liability, (demand, offer) = await self._parts.chain.liabilities.get_with_orders(address)
            known = SeenJob(liability, demand.hex(), offer.hex())
        return known

    async def time_of(self, block: int) -> float | None:
        """The time of a block; None if the node does not tell it."""
        if block not in self._times:
            with suppress(AiraError):
                header = await self._parts.chain.node.header(block)
                if header is not None:
                    self._times[block] = float(header.timestamp)
        return self._times.get(block)

    async def providers(self) -> frozenset[str]:
        """The providers with a stake, a few seconds old; the last ones known while the node does not answer."""
        if time.monotonic() - self._providers_at > 15.0:  # seconds after which the list of providers is read again
            self._providers_at = time.monotonic()
            with suppress(AiraError):
                state = await self._parts.chain.lighthouses.get(self._parts.lighthouse)
                self._providers = frozenset(state.stakes)
        return self._providers

    def _order_matched(self, order_hash: str, maker: str, liability: str) -> None:
        """An order became a contract; `liability` is empty if a reorganisation reverted it."""
        order = self.order(order_hash)
        if order is not None and order.verified.signer == maker:
            order.liability = liability
            self.changed(order, "contract" if liability else "open")

    def _new_head(self, block: int) -> None:
        """The chain was read up to a block."""
        for order in [order for order in self._posted.values() if order.message.deadline <= block]:
            self._seen[order.hash] = self._posted.pop(order.hash)
            if order.state(block) == "expired":
                self.changed(order, "expired")

    async def _follow(self, watch: MarketWatch) -> None:
        async for event in watch:
            match event:
                case Verified(message=Result() as result):
                    self._take_result(Verified(result, event.hash, event.signer))
                    self._take_answer(Verified(result, event.hash, event.signer))
                case Verified(message=Demand() | Offer()):
                    self.add(event)
                case Rejection(order=order_hash, provider=agent, reason=code):
                    if agent in await self.providers():
                        self.take_statement(order_hash, "rejected", agent, code, event.detail)
                case Decline(order=order_hash, agent=agent, code=code):
                    self.take_statement(order_hash, "declined", agent, code, event.detail)
                case ValidatorReport():
                    await self._take_report(event)
                case JobEvent(agent, "ready", liability):
                    self._say(liability.address, agent, "ready", "")
                case JobEvent(agent, "complete", liability):
                    self._say(liability.address, agent, "result", liability.result)

    def _take_answer(self, result: Verified[Result]) -> None:
        """A Result for an account, not for a contract, answers the latest question of that account."""
        order = self._questions.get(result.message.liability)
        if order is None or len(order.answers) >= 8:  # answers to one question that are remembered
            return
        answer = result_json(result) | {"at": time.time()}
        if all(known["signature"] != answer["signature"] for known in order.answers):
            order.answers.append(answer)
            self.changed(order, "answered")

    def take_statement(self, order_hash: str, kind: str, agent: str, code: str, detail: str) -> None:
        """What a provider (`rejected`) or a robot (`declined`) says of an order."""
        statement = {"kind": kind, "agent": agent, "code": code, "detail": detail[:500], "at": time.time()}
        order = self.order(order_hash)
        if order is None or not order.robot:
            self._stream.publish("market", kind, statement | {"order": order_hash})
        if order is None:
            return
        order.withdrawn = order.withdrawn or code == Refusal.WITHDRAWN
        # Rejections and declines of one order that are remembered.
        if len(order.statements) < 32 or (agent, code) in order.statements:
            order.statements[agent, code] = statement
        self.changed(order, "withdrawn" if code == Refusal.WITHDRAWN else kind)

    def _take_result(self, seen: Verified[Result]) -> None:
        key = seen.message.liability, seen.signer
        if key not in self.results:
            self.results[key] = seen
            self._stream.publish("market", "result", result_json(seen))
            self._say(seen.message.liability, seen.signer, "result", seen.message.result)

    async def _take_report(self, report: ValidatorReport) -> None:
        """Remember how a juror has judged a job, if it is one of the job's validator."""
        job = self.jobs.get(report.liability)
        if job is None or report.juror in job.reports or not is_about(report, job.liability):
            return
        if not self._limiter.allow(report.juror):
            return
        with suppress(AiraError):
            if await accepted_of(self._parts.chain, report.validator, [report.juror]):
                job.reports[report.juror] = report
                self._step(job, "judged", agent=report.juror, detail=verdict_words(report), at=time.time())

    def _say(self, address: str, agent: str, kind: str, detail: str) -> None:
        """An agent says that its job took a step. Of a liability that was not read yet, it is kept until then."""
        if (job := self.jobs.get(address)) is None:
            said = self._said.get(address) or []
            if len(said) < MARKET_LIMITS.steps and (agent, kind, detail) not in said:
                self._said[address] = [*said, (agent, kind, detail)]
        elif job.liability.promisor == agent and all(step["kind"] != kind for step in job.steps):
            self._step(job, kind, agent=agent, detail=detail, at=time.time())

    def _step(self, job: SeenJob, kind: str, *, is_live: bool = True, **fields: Any) -> None:
        step = {"kind": kind, "at": None, "block": None, "tx": None, "agent": None, "detail": ""} | fields
        if len(job.steps) < MARKET_LIMITS.steps:
            job.steps.append(step)
        if job.phase != "finalized":
            job.phase = PHASES.get(kind, job.phase)
        if not is_live:
            return
        self._stream.publish(f"liability/{job.liability.address}", kind, step)
        if kind == "ready":
            about = {"agent": fields["agent"], "event": kind, "liability": liability_json(job.liability, self.labels)}
            self._stream.publish("market", "job", about)

    async def _follow_playbacks(self, reports: Pump[tuple[ProgressKey, PlaybackPosition]]) -> None:
        async for key, position in reports:
            address, agent = parse_address(key.liability), parse_address(key.agent)
            if (job := self.jobs.get(address)) is not None:
                self._take_position(job, agent, position)
            else:
                self._say_playing(address, agent)

    async def _recall(self, job: SeenJob) -> None:
        """Ask the promisor for the phase, which it may have published before the job was read here."""
        agent, address = job.liability.promisor, job.liability.address
        async with self._asking:
            replies = await query_all(self._parts.network.session, [event_selector(agent, address)])
        for sample in (reply.ok for reply in replies if reply.ok is not None):
            if str(sample.key_expr) == str(EventKey(agent, address, "ready")):
                self._say(address, agent, "ready", "")
            elif job.playback is None and (said := _progress_in(sample)) is not None:
                self._take_position(job, agent, said[1])

    def _take_position(self, job: SeenJob, agent: str, position: PlaybackPosition) -> None:
        if job.liability.promisor != agent or not self._limiter.allow(agent):
            return
        self._say_playing(job.liability.address, agent)
        job.playback = position
        about = {"position": position.position, "total": position.total}
        self._stream.publish(f"liability/{job.liability.address}", "playing", about)

    def _say_playing(self, address: str, agent: str) -> None:
        for kind in ("ready", "playing"):
            self._say(address, agent, kind, "")

    async def _follow_chain(self) -> None:
        async with aclosing(self._parts.chain.follow(self._from_block, parties=())) as blocks:
            async for block in blocks:
                if isinstance(block, Reorganisation):
                    for event in block.reverted_events:
                        self._revert(event, block.block_number)
                for event in block.events:
                    match event:
                        case NewLiability():
                            self._read_soon(event.liability, "created", block.block_number, event.tx)
                        case Finalized():
                            self._read_soon(event.liability, "ended", block.block_number, event.tx)
                if block.block_number >= self._start:
                    count = partial(self._parts.chain.node.contract_blocks.last, block.block_number)
                    contract_block = await self._parts.chain.retrying(count)
                    self._parts.chain_head.advance_to(block.block_number, contract_block)
                    self._stream.publish("chain", "block", {"number": contract_block, "at": time.time()})
                    self._new_head(contract_block)

    def _revert(self, event: object, block: int) -> None:
        if isinstance(event, NewLiability):
            self._unread.pop(event.liability, None)
            if (job := self.jobs.pop(event.liability, None)) is not None:
                self._step(job, "reverted", tx=event.tx)
                for order_hash, maker in job.orders:
                    self._matched.pop((order_hash, maker), None)
                    self._order_matched(order_hash, maker, "")
        elif isinstance(event, Finalized) and (job := self.jobs.get(event.liability)) is not None:
            job.phase = "complete"
            job.steps = [step for step in job.steps if step["kind"] not in ("paid", "refunded")]
            self._step(job, "reverted", tx=event.tx)
            self._read_soon(event.liability, "reverted", block, event.tx)

    def _read_soon(self, address: str, what: str, block: int, tx: str) -> None:
        self._unread.setdefault(address, {})[what] = (block, tx)
        self._has_unread.set()

    async def _read_contracts(self) -> None:
        """Read the contracts of which the chain has news, many in one call."""
        parts = self._parts
        while True:
            await self._has_unread.wait()
            some = list(self._unread)[:32]  # contracts that are read in one call
            news = {address: self._unread.pop(address) for address in some}
            if not self._unread:
                self._has_unread.clear()
            found = await parts.chain.retrying(partial(parts.chain.liabilities.read_existing, some))
            for liability, hashes in found:
                await self.labels.learn(liability.token)
                await self._take_contract(liability, hashes, news[liability.address])

    async def _take_contract(
        self, liability: Liability, hashes: tuple[bytes, bytes], news: dict[str, tuple[int, str]]
    ) -> None:
        is_live = max(block for block, _ in news.values()) > self._start
        job = self.jobs.get(liability.address)
        if job is None:
            job = self.jobs[liability.address] = SeenJob(liability, hashes[0].hex(), hashes[1].hex())
        job.liability = liability
        if "created" in news:
            block, tx = news["created"]
            at = time.time() if is_live else None
            self._step(job, "created", is_live=is_live, block=block, tx=tx, at=at)
            self._match(job, is_live=is_live)
            for agent, kind, detail in self._said.pop(liability.address, ()):
                self._say(liability.address, agent, kind, detail)
            if not liability.is_finalized:
                self.on_contract(job)
                self._tasks.start(self._recall(job), f"phase of {liability.address}")
        if "ended" in news and liability.is_finalized:
            block, tx = news["ended"]
            at = time.time() if is_live else None
            kind = "paid" if liability.is_success else "refunded"
            job.phase = "finalized"
            self._step(job, kind, is_live=is_live, block=block, tx=tx, detail=liability.result, at=at)

    def _match(self, job: SeenJob, *, is_live: bool) -> None:
        address = job.liability.address
        if is_live:
            data = {"demand": job.demand, "offer": job.offer, "liability": liability_json(job.liability, self.labels)}
            self._stream.publish("market", "matched", data)
        for order_hash, maker in job.orders:
            self._matched[order_hash, maker] = address
            self._order_matched(order_hash, maker, address)


def _progress_in(sample: zenoh.Sample) -> tuple[ProgressKey, PlaybackPosition] | None:
    """How far a playback is, by an agent's word; None for anything else."""
    try:
        key = parse_key(str(sample.key_expr))
        return (key, PlaybackPosition.decode(sample.payload.to_bytes())) if isinstance(key, ProgressKey) else None
    except AiraError:
        return None


class Sent(msgspec.Struct):
    """A message that is published again and again."""

    message: Any
    signer: str
    backoff: Backoff
    next_at: float
    pair: OrderPair | None = None
    """With it, the message is for one robot alone, and goes to the providers only."""
    permit: Permit | None = None
    """It travels before the message, a demand. That of a pair is in the pair, unless its maker has signed another."""


class OrderPublisher(Lifecycle):
    """Posts orders, and passes stops on: `async with OrderPublisher(components, market) as publisher`.

    A message is sent again with the backoff of agents until its order is a contract, withdrawn or expired, a withdrawal
    until its deadline. Nothing is kept on disk: after a restart the page posts its orders again.
    """

    title = "publisher of orders"

    def __init__(self, components: WebComponents, market: Market) -> None:
        self._parts = components
        self._market = market
        self._sent: dict[str, Sent] = {}
        self._stopping = asyncio.Semaphore(16)  # stops at a time: a robot that is silent takes ten seconds

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = tasks = await stack.enter_async_context(Background())
        tasks.start(self._send_again(), "page: orders")
        if (agent := self._parts.agent) is not None:
            for order in agent.orders(OrderState.OPEN, OrderState.WITHDRAWN):
                if order.robot:
                    self._follow(order).withdrawn = order.state is OrderState.WITHDRAWN

    async def post(self, payload: bytes) -> SeenOrder:
        """Check a signed message and publish it, or a permit and its demand; returns the order that it is or withdraws.

        Raises `InvalidMessage`, `UnsafeValidator`, `WebError`, `ChainError`.
        """
        verified, permit = await asyncio.to_thread(_posted, payload)
        message, key = verified.message, verified.hash.hex() + verified.signer
        is_new = key not in self._sent
        if is_new:
            self._check_place(verified.signer)
        match message:
            case Demand() | Offer():
                await self._check(verified, permit)
                order = self._market.add(verified, posted=True)
            case Withdrawal(order=order_hash):
                order = self._withdrawn(order_hash, verified.signer)
            case _:
                raise unusable("kind", "only demands, offers and withdrawals are posted")
        if is_new:
            self._sent[key] = Sent(message, verified.signer, Backoff(RESEND), time.monotonic(), permit=permit)
            self._send_due()
        self._market.changed(order, order.state(self._market.head))
        return order

    async def post_pair(self, pair: OrderPair) -> SeenOrder:
        """Check a demand with a robot's offer, and send both to the providers; returns the demand, also if it is posted
        again.

        Raises as `post`, and `InvalidMessage` for a pair that a provider would refuse.
        """
        demand, offer, permit = await asyncio.to_thread(_pair_of, pair)
        key = demand.hash.hex() + demand.signer
        if key in self._sent and (known := self._market.order(demand.hash.hex())) is not None:
            return known
        self._check_place(demand.signer)
        await self._check(demand, permit)
        order = self._market.add(demand, posted=True, robot=offer.signer)
        self._sent[key] = Sent(demand.message, demand.signer, Backoff(RESEND), time.monotonic(), pair)
        self._send_due()
        self._market.changed(order, order.state(self._market.head))
        return order

    async def post_permit(self, payload: bytes) -> None:
        """Publish a new permit for the posted demands of its owner in its token, and send those again.

        Raises `InvalidMessage`, `WebError` without such a demand, or if the permit is not better than a known one.
        """
        permit = (await asyncio.to_thread(verify, payload)).message
        if not isinstance(permit, Permit):
            raise unusable("kind", "only permits are posted here")
        waiting = [
            sent
            for sent in self._sent.values()
            if isinstance(sent.message, Demand) and (sent.signer, sent.message.token) == (permit.owner, permit.token)
        ]
        if not waiting:
            raise WebError("no open demand was posted here that the permit could pay", code="page-not-found")
        if not self._parts.chain.funds.note(permit):
            raise unusable("permit", "the permit is not for this market, or no better than the last one")
        for sent in waiting:
            sent.permit, sent.backoff, sent.next_at = permit, Backoff(RESEND), 0.0
        self._send_due()

    async def _send_pair(self, pair: OrderPair) -> None:
        session, providers = self._parts.network.session, sorted(await self._market.providers())[:PROVIDERS]
        for said in await asyncio.gather(*(send_pair(session, provider, pair) for provider in providers)):
            if said is not None:
                detail = public_text(said.detail)
                self._market.take_statement(said.order, "rejected", said.provider, said.reason, detail)

    def _check_place(self, signer: str) -> None:
        of_signer = sum(sent.signer == signer for sent in self._sent.values())
        if len(self._sent) >= MARKET_LIMITS.sent or of_signer >= MARKET_LIMITS.per_signer:
            hint = "wait until some have ended, or withdraw them"
            raise WebError("too many orders are open here", hint=hint, code="too-many-requests")

    async def order(self, *, objective: str, validator: str, validator_fee: int | None, **terms: Any) -> SeenOrder:
        """The local account orders; its agent publishes, or sends the order to the one `robot` alone.

        Raises `WebError`, `RemoteError`, and as `Agent.order`.
        """
        agent = self._local_agent("start it with --keyfile, or connect a wallet")
        fee = await require_judged(self._parts, validator, validator_fee) if validator else 0
        posted = await agent.order(objective, validator=validator, validator_fee=fee, **terms)
        if posted.robot:
            return self._follow(posted)
        return self._market.add(verify_message(posted.message), posted=True)

    def _follow(self, order: Order) -> SeenOrder:
        """Show an order for one robot alone, and what that robot and the providers say of it to the local account."""
        seen = self._market.add(verify_message(order.message), posted=True, robot=order.robot)
        if order.state is OrderState.OPEN:
            self._tasks.start(self._listen(order), f"order {order.hash}")
        return seen

    async def _listen(self, order: Order) -> None:
        def told(progress: Progress) -> None:
            if progress.kind in ("declined", "rejected"):
                self._market.take_statement(order.hash, progress.kind, progress.agent, progress.code, progress.detail)

        with suppress(AiraError):  # it is withdrawn, has expired, or another robot got the contract
            await order.contract(on_progress=told)

    async def withdraw(self, order_hash: str) -> SeenOrder:
        """The local account withdraws its order. Raises `OrderClosed`, `WebError`."""
        agent = self._local_agent("sign the withdrawal with your wallet")
        for mine in agent.orders(OrderState.OPEN, OrderState.WITHDRAWN):
            if mine.hash == order_hash:
                await mine.withdraw()
                return self._withdrawn(order_hash, agent.address)
        raise WebError(f"the local account has no open order {order_hash}", code="page-not-found")

    async def refund(self, address: str) -> None:
        """The local account takes back the cost of its job. Raises `WebError`, `ChainError`."""
        agent = self._local_agent("send the transaction from your wallet")
        liabilities = self._parts.chain.liabilities
        liability = await liabilities.get(address)
        if liability.promisee != agent.address:
            raise ChainError(f"the local account did not order {address}", code="not-refundable")
        state = await liabilities.refund_state(address)
        if not state.is_refundable:
            raise ChainError(f"{address} can't be refunded: {refund_words(state)}", code="not-refundable")
        await liabilities.refund(address)

    async def pass_stop(self, request: StopRequest) -> dict[str, Any]:
        """Pass a signed request to stop a job on to its robot; returns what the robot's devices say.

        Raises `InvalidMessage` for one that is not signed by a party of the job, `NotALiability`, `ServiceFailed`.
        """
        job = await self._stoppable(request.liability)
        liability = job.liability
        if not request.is_signed or request.by not in (liability.promisee, liability.promisor):
            raise InvalidMessage("signature", "a stop is signed by the customer or the robot of the job")
        async with self._stopping:
            stopped = await send_stop(self._parts.network.session, liability.promisor, request)
        return self._stopped(job, by=request.by, why=request.why, stopped=stopped)

    async def stop(self, address: str, why: str) -> dict[str, Any]:
        """The local account stops its job. Raises `WebError`, and as `Contract.stop`."""
        agent = self._local_agent("sign the stop with your wallet")
        job = await self._stoppable(address)
        contract = await agent.contract(address)
        async with self._stopping:
            stopped = await contract.stop(why)
        return self._stopped(job, by=agent.address, why=why, stopped=stopped)

    async def _stoppable(self, address: str) -> SeenJob:
        job = await self._market.job(address)
        if job.liability.is_finalized:
            raise ChainError(f"{address} has ended", code="liability-ended")
        return job

    def _stopped(self, job: SeenJob, *, by: str, why: str, stopped: Stopped) -> dict[str, Any]:
        known = self._market.jobs.get(job.liability.address, job)
        known.stopped = known.stopped or {"by": by, "why": why}
        return {"devices": [msgspec.structs.asdict(device) for device in stopped.devices]}

    def _local_agent(self, hint: str) -> Agent:
        if self._parts.agent is None:
            raise WebError("this server has no account", hint=hint, code="no-local-account")
        return self._parts.agent

    def _withdrawn(self, order_hash: str, signer: str) -> SeenOrder:
        order = self._market.order(order_hash)
        if order is None or order.verified.signer != signer:
            raise WebError(f"no open order {order_hash} of {signer} is known here", code="page-not-found")
        order.withdrawn = True
        self._market.changed(order, "withdrawn")
        return order

    async def _check(self, verified: Verified[Any], permit: Permit | None = None) -> None:
        """What a provider checks, with a demand's permit. Raises `WebError`."""
        order, parts, head = verified.message, self._parts, self._market.head
        if order.lighthouse != parts.lighthouse:
            raise unusable("lighthouse", f"the order names {order.lighthouse}, this market is {parts.lighthouse}")
        if order.deadline <= head:
            raise unusable("expired", f"block {order.deadline} has passed, the chain is at {head}")
        if order.deadline > head + parts.settings.deadline_limit:
            most = parts.settings.deadline_limit
            raise unusable("deadline", f"the order is valid for more than {most} blocks")
        await parts.chain.validators.check(order)
        liabilities = parts.chain.liabilities
        if await liabilities.is_used(order, order_hash=verified.hash, signer=verified.signer):
            raise unusable("used", "the order has become a contract, or was withdrawn", hint="sign a new one")
        if permit is not None:
            self._note(permit, verified)
        (shortage,) = await parts.chain.funds.shortages([verified], fresh=True)
        if shortage:
            raise unusable(shortage, "the account can't pay the order", hint=HINTS.get(shortage, ""))

    def _note(self, permit: Permit, demand: Verified[Demand]) -> None:
        """Remember a permit, which is published with its demand. Raises `WebError` if it is for something else."""
        factory = self._parts.chain.factory
        if (permit.owner, permit.token, permit.spender) != (demand.signer, demand.message.token, factory):
            raise unusable("permit", "the permit is not the demand's maker's, or for another token or spender")
        self._parts.chain.funds.note(permit)

    async def _send_again(self) -> None:
        while True:
            await asyncio.sleep(0.25)  # seconds between two looks at what has to be sent again
            self._send_due()

    def _send_due(self) -> None:
        now = time.monotonic()
        for key, sent in list(self._sent.items()):
            if not self._is_wanted(sent.message, key[:64]):
                del self._sent[key]
            elif sent.next_at <= now and self._parts.network.connected:
                if sent.permit is not None:
                    self._parts.channel.publish(sent.permit)
                if sent.pair is None:
                    self._parts.channel.publish(sent.message)
                else:
                    self._tasks.start(self._send_pair(sent.pair), f"pair {key[:64]}")
                sent.next_at = now + (sent.backoff.next_delay() or 0.0)

    def _is_wanted(self, message: SignedMessage, order_hash: str) -> bool:
        if isinstance(message, Withdrawal):
            return message.deadline > self._market.head
        order = self._market.order(order_hash)
        return order is not None and order.state(self._market.head) == "open"


def _posted(payload: bytes) -> tuple[Verified[Any], Permit | None]:
    """The message that is posted; of a list, its demand with its permit. Raises `InvalidMessage`."""
    if not payload.lstrip().startswith(b"["):
        return verify(payload), None
    try:
        texts = decode_json(payload, tuple[msgspec.Raw, msgspec.Raw])
    except InvalidData as error:
        raise InvalidMessage("not-json", str(error)) from None
    permit, demand = (verify(bytes(text)) for text in texts)
    if not isinstance(permit.message, Permit) or not isinstance(demand.message, Demand):
        raise InvalidMessage("unknown-kind", "a list has a permit and its demand")
    return demand, permit.message


def _pair_of(pair: OrderPair) -> tuple[Verified[Demand], Verified[Offer], Permit | None]:
    """The demand and the offer of a pair, and its permit. Raises `InvalidMessage`."""
    if not pair.is_signed:
        raise InvalidMessage("signature", "the pair is not signed by its maker")
    demand: Verified[Demand] = verify_message(pair.demand.message())
    offer: Verified[Offer] = verify_message(pair.offer.message())
    pair.check(demand, offer)
    return demand, offer, None if pair.permit is None else verify_message(pair.permit.message()).message


HINTS: Final = {
    "ERC20InsufficientAllowance": "sign a permit for the amount, or approve the factory for it",
    "ERC20InsufficientBalance": "send the account the missing tokens, or order for less",
    "TokenUnreadable": "choose another token",
}
"""What to do about a shortage."""
