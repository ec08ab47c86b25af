"""The jobs that the page knows: contracts as the chain has them, and what their promisors say of them.

What agents say is kept only of a job's promisor, and everything is bounded.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from bridges.web.views import Labels, liability_json, result_json
from mesh.agent.judged_contract import verdict_words
from mesh.agent.reports import is_about
from mesh.agent.validators import accepted_of
from mesh.background import Background
from mesh.chain import Finalized, NewLiability, NoContracts, Reorganisation
from mesh.errors import AiraError
from mesh.flood import BoundedDict, Rate, RateLimiter
from mesh.network import Pump
from mesh.role import Lifecycle
from schemas import (
    Liability,
    PlaybackPosition,
    ProgressKey,
    Result,
    Verified,
    event_selector,
    parse_address,
    parse_key,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.web.components import WebComponents
    from bridges.web.stream import Stream
    from schemas.verdicts import ValidatorReport

JOBS: Final = 16_384
"""Jobs that are remembered, the latest ones."""
STEPS: Final = 32
"""Steps of one job that are remembered."""
READ_AT_ONCE: Final = 32
"""Contracts that are read in one call."""
EARLY: Final = 1024
"""Contracts of which agents spoke before they were read."""
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

    @property
    def orders(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """The hashes of its orders, each with its maker."""
        return (self.demand, self.liability.promisee), (self.offer, self.liability.promisor)


class ContractListener(Protocol):
    """What wants to know of contracts and blocks."""

    def matched(self, order_hash: str, maker: str, liability: str) -> None:
        """An order became a contract; `liability` is empty if a reorganisation reverted it."""

    def new_head(self, block: int) -> None:
        """The chain was read up to a block."""


class ContractFollower(Lifecycle):
    """Follows the chain and the playbacks: `async with ContractFollower(components, stream, listener) as contracts`.

    `from_block` is the first block whose contracts are listed. Changes are published on `stream`. Used in one event
    loop.
    """

    title = "contracts of the page"

    def __init__(
        self,
        components: WebComponents,
        stream: Stream,
        listener: ContractListener,
        *,
        from_block: int = 0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._parts = components
        self._stream = stream
        self._listener = listener
        self._from_block = from_block
        self._clock = clock
        self.labels = Labels(components.chain)
        self.jobs: BoundedDict[str, SeenJob] = BoundedDict(JOBS)
        self.matched: BoundedDict[tuple[str, str], str] = BoundedDict(2 * JOBS)
        """The contracts by order and maker."""
        self.results: BoundedDict[tuple[str, str], Verified[Result]] = BoundedDict(JOBS)
        """The signed results by liability and signer."""
        self._start = components.chain_head.head
        self._said: BoundedDict[str, list[tuple[str, str, str]]] = BoundedDict(EARLY)
        """What agents said of liabilities that were not read yet: who, which step, detail."""
        self._unread: dict[str, dict[str, tuple[int, str]]] = {}
        self._has_unread = asyncio.Event()
        self._times: BoundedDict[int, float] = BoundedDict(JOBS)
        self._limiter = RateLimiter(per_sender=REPORTED)

    async def _open(self, stack: AsyncExitStack) -> None:
        parts = self._parts
        pump = Pump(parts.network.session, event_selector(), _progress_in, drops=parts.drops)
        reports = await stack.enter_async_context(pump)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._follow_playbacks(reports), "page: playbacks")
        tasks.start(self._follow_chain(), "page: chain")
        tasks.start(self._read(), "page: contracts")

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

    def take_result(self, seen: Verified[Result]) -> None:
        """Remember a signed result."""
        key = seen.message.liability, seen.signer
        if key not in self.results:
            self.results[key] = seen
            self._stream.publish("market", "result", result_json(seen))
            self.say(seen.message.liability, seen.signer, "result", seen.message.result)

    async def take_report(self, report: ValidatorReport) -> None:
        """Remember how a juror has judged a job, if it is one of the job's validator."""
        job = self.jobs.get(report.liability)
        if job is None or report.juror in job.reports or not is_about(report, job.liability):
            return
        if not self._limiter.allow(report.juror):
            return
        with suppress(AiraError):
            if await accepted_of(self._parts.chain, report.validator, [report.juror]):
                job.reports[report.juror] = report
                self._step(job, "judged", agent=report.juror, detail=verdict_words(report), at=self._clock())

    def say(self, address: str, agent: str, kind: str, detail: str) -> None:
        """An agent says that its job took a step. Of a liability that was not read yet, it is kept until then."""
        if (job := self.jobs.get(address)) is None:
            said = self._said.get(address) or []
            if len(said) < STEPS:
                self._said[address] = [*said, (agent, kind, detail)]
        elif job.liability.promisor == agent and all(step["kind"] != kind for step in job.steps):
            self._step(job, kind, agent=agent, detail=detail, at=self._clock())

    def _step(self, job: SeenJob, kind: str, *, is_live: bool = True, **fields: Any) -> None:
        step = {"kind": kind, "at": None, "block": None, "tx": None, "agent": None, "detail": ""} | fields
        if len(job.steps) < STEPS:
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
            job = self.jobs.get(parse_address(key.liability))
            agent = parse_address(key.agent)
            if job is None or job.liability.promisor != agent or not self._limiter.allow(agent):
                continue
            if job.playback is None:
                self.say(job.liability.address, agent, "ready", "")
                self._step(job, "playing", agent=agent, at=self._clock())
            job.playback = position
            about = {"position": position.position, "total": position.total}
            self._stream.publish(f"liability/{job.liability.address}", "playing", about)

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
                    self._parts.chain_head.advance_to(block.block_number)
                    self._stream.publish("chain", "block", {"number": block.block_number, "at": self._clock()})
                    self._listener.new_head(block.block_number)

    def _revert(self, event: object, block: int) -> None:
        """A reorganisation reverted an event."""
        if isinstance(event, NewLiability):
            self._unread.pop(event.liability, None)
            if (job := self.jobs.pop(event.liability, None)) is not None:
                self._step(job, "reverted", tx=event.tx)
                for order_hash, maker in job.orders:
                    self.matched.pop((order_hash, maker), None)
                    self._listener.matched(order_hash, maker, "")
        elif isinstance(event, Finalized) and (job := self.jobs.get(event.liability)) is not None:
            job.phase = "complete"
            job.steps = [step for step in job.steps if step["kind"] not in ("paid", "refunded")]
            self._step(job, "reverted", tx=event.tx)
            self._read_soon(event.liability, "reverted", block, event.tx)

    def _read_soon(self, address: str, what: str, block: int, tx: str) -> None:
        self._unread.setdefault(address, {})[what] = (block, tx)
        self._has_unread.set()

    async def _read(self) -> None:
        """Read the contracts of which the chain has news, many in one call."""
        parts = self._parts
        while True:
            await self._has_unread.wait()
            some = list(self._unread)[:READ_AT_ONCE]
            news = {address: self._unread.pop(address) for address in some}
            if not self._unread:
                self._has_unread.clear()
            try:
                found = await parts.chain.retrying(partial(parts.chain.liabilities.get_all_with_orders, some))
            except NoContracts:  # reverted meanwhile: the reorganisation comes next
                continue
            for liability, hashes in found:
                await self.labels.learn(liability.token)
                await self._take(liability, hashes, news[liability.address])

    async def _take(self, liability: Liability, hashes: tuple[bytes, bytes], news: dict[str, tuple[int, str]]) -> None:
        is_live = max(block for block, _ in news.values()) > self._start
        job = self.jobs.get(liability.address)
        if job is None:
            job = self.jobs[liability.address] = SeenJob(liability, hashes[0].hex(), hashes[1].hex())
        job.liability = liability
        if "created" in news:
            block, tx = news["created"]
            at = await self.time_of(block) if is_live else None
            self._step(job, "created", is_live=is_live, block=block, tx=tx, at=at)
            self._match(job, is_live=is_live)
            for agent, kind, detail in self._said.pop(liability.address, ()):
                self.say(liability.address, agent, kind, detail)
        if "ended" in news and liability.is_finalized:
            block, tx = news["ended"]
            at = await self.time_of(block) if is_live else None
            kind = "paid" if liability.is_success else "refunded"
            job.phase = "finalized"
            self._step(job, kind, is_live=is_live, block=block, tx=tx, detail=liability.result, at=at)

    def _match(self, job: SeenJob, *, is_live: bool) -> None:
        address = job.liability.address
        if is_live:
            data = {"demand": job.demand, "offer": job.offer, "liability": liability_json(job.liability, self.labels)}
            self._stream.publish("market", "matched", data)
        for order_hash, maker in job.orders:
            self.matched[order_hash, maker] = address
            self._listener.matched(order_hash, maker, address)


def _progress_in(sample: zenoh.Sample) -> tuple[ProgressKey, PlaybackPosition] | None:
    """How far a playback is, by an agent's word; None for anything else."""
    try:
        key = parse_key(str(sample.key_expr))
        return (key, PlaybackPosition.decode(sample.payload.to_bytes())) if isinstance(key, ProgressKey) else None
    except AiraError:
        return None
