"""Answers without a contract: a demand that pays nothing is a question, and a Result addressed to its maker the answer.

The Result names the asker's address as its liability, as in the legacy network; its file holds the values. It is put on
the market once: who gets no answer asks again.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.orders import deadline_in, lifetime_of, withdrawal_of
from mesh.base.background import Background
from mesh.base.database import LedgerUnusable
from mesh.base.flood import FairQueue
from mesh.base.retry import Backoff, RetryPolicy
from mesh.content import ContentUnavailable
from mesh.errors import AiraError, RemoteError
from mesh.recording import ABOUT, Played, RecordingAbout, open_objective
from mesh.watching.market import LIMITS
from schemas import Demand, Result, Verified, message_hash
from schemas.payloads import plain_value

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from mesh.agent.orders import Terms, TermsWriter
    from mesh.network import Subscription

log = logging.getLogger(__name__)

ANSWERED: Final = "aira-answer"
"""The metadata record of an answer's recording that has the hash of the demand."""


class Unanswered(RemoteError, code="unanswered"):
    """Nobody answered a question in time."""

    def __init__(self, model: str, seconds: float) -> None:
        super().__init__(
            f"nobody answered a demand for {model} within {seconds:g} s",
            hint="`aira peers` shows who is present on the market",
        )
        self.model = model


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer without a contract."""

    agent: str
    """Who signed it."""
    result: str
    """The CID of its recording."""
    values: tuple[Any, ...]
    """The messages of the recording, decoded."""
    messages: tuple[Played, ...] = field(repr=False)
    """The same as they were recorded, with their topics and times."""

    @property
    def value(self) -> Any:
        """The first value, which is the only one of most answers."""
        return self.values[0]


def metadata_of_answer(demand: Verified[Demand], agent: str) -> dict[str, dict[str, str]]:
    """The metadata records of the recording with which `agent` (address) answers a demand."""
    about = RecordingAbout(agent=agent, lighthouse=demand.message.lighthouse, objective=demand.message.objective)
    return {ABOUT: asdict(about), ANSWERED: {"demand": demand.hash.hex()}}


def read_answer(path: Path, result: Verified[Result]) -> tuple[Answer, str]:
    """An answer and the hash of the demand that it is for; legacy answers name none. Raises a `RecordingError`."""
    recording = open_objective(path, LIMITS)
    messages = tuple(recording.messages())
    values = tuple(plain_value(message.payload, message.type) for message in messages)
    demand = recording.metadata.get(ANSWERED, {}).get("demand", "")
    return Answer(result.signer, result.message.result, values, messages), demand


class Question:
    """A demand that pays nothing, asked again until an answer comes: `await Question(…).ask(terms)`.

    At the end of `ask` it is withdrawn; if the process is killed before, it expires `seconds` after it was asked.

    With an `agent` (address) only its answers count. Answers come from strangers: their fetching is bounded, and what
    is no answer is counted in the agent's drops.
    """

    def __init__(self, parts: AgentComponents, writer: TermsWriter, *, seconds: float, agent: str = "") -> None:
        self._parts = parts
        self._writer = writer
        self._seconds = seconds
        self._agent = agent
        self._open: list[Demand] = []
        """Those that are not withdrawn."""
        self._asked: set[str] = set()
        self._arrived: FairQueue[Verified[Result]] = FairQueue(per_sender=4, total=64)
        """Answers that wait to be fetched."""

    async def ask(self, terms: Terms) -> Answer:
        """Ask until the first answer comes, or until cancelled; nothing that was asked is open afterwards."""
        answered: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        try:
            async with self._parts.channel.subscribe(Result) as results, Background() as tasks:
                tasks.start(self._receive(results), "answers")
                for _ in range(4):  # answers that are fetched at once
                    tasks.start(self._fetch(results, answered), "fetch an answer")
                tasks.start(self._publish(terms), "ask")
                return await answered
        finally:
            await self._withdraw(self._open)

    async def _publish(self, terms: Terms) -> None:
        """Publish the demand again and again; a new one each time, as a robot takes each only once."""
        backoff, chain = Backoff(RetryPolicy(initial=2.0, ceiling=10.0)), self._parts.chain
        while True:
            deadline = await deadline_in(chain, await lifetime_of(chain, self._seconds))
            demand = await self._writer.sign(Demand, {**terms, "deadline": deadline}, validator_fee=0)
            assert isinstance(demand, Demand)
            before, self._open = self._open, [*self._open, demand]
            self._asked.add(message_hash(demand).hex())
            self._parts.channel.publish(demand)
            await self._withdraw(before)
            self._open = [demand]
            await backoff.wait()

    async def _withdraw(self, demands: Sequence[Demand]) -> None:
        if demands:
            with suppress(LedgerUnusable):  # then they expire
                await self._parts.outbox.withdraw(*(self._parts.signer.sign(withdrawal_of(one)) for one in demands))

    async def _receive(self, results: Subscription[Result]) -> None:
        async for result in results:
            if result.message.liability == self._parts.signer.address and self._agent in ("", result.signer):
                for dropped in self._arrived.put(result.signer, result):
                    self._parts.drops.count("answer-overflow", dropped.signer)

    async def _fetch(self, results: Subscription[Result], answered: asyncio.Future[Answer]) -> None:
        """Fetch one answer after another. One that nobody had is fetched once more when it is sent again."""
        timeout = min(10.0, self._parts.settings.fetch_timeout)  # seconds without a block
        while True:
            result = await self._arrived.get()
            cid = result.message.result
            try:
                path = await self._parts.exchange.fetch(cid, size_limit=LIMITS.size, timeout=timeout, sync=False)
                answer, demand = await asyncio.to_thread(read_answer, path, result)
            except AiraError as error:
                if isinstance(error, ContentUnavailable):
                    results.forget(result)
                self._parts.drops.count("answer-unreadable", result.signer)
                log.debug("%s of %s is no answer: %s", cid, result.signer, error)
                continue
            if answer.values and demand in ("", *self._asked) and not answered.done():
                answered.set_result(answer)
