"""What an agent says and hears without a contract: readings, and answers to questions."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from mesh.agent.answers import Answer, Question, Unanswered, metadata_of_answer
from mesh.agent.trading_agent import Messages, TradingAgent, put_values
from mesh.errors import InputError
from mesh.log_context import log_event
from mesh.network import ReadingSubscription, sending
from mesh.network.readings import LARGEST_READING
from mesh.recording import encode_described
from schemas import Result, parse_address
from schemas.agent_keys import ReadingKey

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.flood import Drops
    from schemas import Demand, Verified
    from schemas.payloads import PayloadType

log = logging.getLogger(__name__)

ASK_SECONDS: Final = 60.0
"""How long `Agent.ask` waits for an answer by default."""


class ReadingTooLarge(InputError, code="reading-too-large"):
    """A reading has more bytes than those who listen accept."""

    def __init__(self, topic: str, size: int) -> None:
        super().__init__(
            f"a reading on {topic} has {size:,} bytes; the most are {LARGEST_READING:,}",
            hint="send less at once, or put it into a file and publish the CID that `agent.add` returns",
        )
        self.topic = topic
        self.size = size


class ReadingAgent(TradingAgent):
    """The methods of an `Agent` for readings, questions and answers."""

    drops: Drops

    def publish(self, topic: str, message: object) -> None:
        """Publish a reading on a topic of the agent, outside any job. Those who listen now get it; nobody keeps it.

        `message` is anything that `Job.publish` accepts. Raises `InvalidPayload`, `ReadingTooLarge`, `InvalidKey` for
        an invalid topic, `ClosedError`, and `ConfigurationError` if the agent has no account.
        """
        session, key = self.parts.network.session, str(ReadingKey(self.address, topic))
        payload, kind = _encoded(topic, message)
        sending.put(session, key, payload, encoding=kind.zenoh_encoding)

    def readings(self, topic: str = "/**", *, agent: str = "*") -> ReadingSubscription:
        """What agents publish outside of jobs: `async with agent.readings("/battery") as readings`, then iterate.

        By default on all topics, by all agents; `agent` is an address. Raises `InvalidKey`, `ClosedError`.
        """
        return ReadingSubscription(self.network.session, agent=agent, topic=topic, drops=self.drops)

    async def answer(self, demand: Verified[Demand], value: object, *, topic: str = "/answer") -> str:
        """Answer a demand without a contract; returns the CID of the recording with the `value`.

        `value` is anything that `Job.publish` accepts. A Result that names the asker as its liability is put on the
        market once; who asks with `ask` asks again if it is lost. Raises as `publish` does.
        """
        _encoded(topic, value)
        options = {"time_ns": time.time_ns(), "metadata": metadata_of_answer(demand, self.address)}
        cid = await asyncio.to_thread(put_values, self.parts.store, [(topic, value)], **options)
        self.send(Result(liability=demand.signer, result=cid, success=True))
        facts = log_event("demand-answered", demand=demand.hash.hex(), signer=demand.signer, result=cid)
        log.info("answered %s without a contract: %s", demand.signer, cid, extra=facts)
        return cid

    async def ask(
        self, model: str = "", objective: str | Path | Messages = "", *, agent: str = "", timeout: float = ASK_SECONDS
    ) -> Answer:
        """Ask the agents of a model, by default this agent's, and return the first answer: `(await agent.ask()).value`.

        The question is a demand that pays nothing, asked again until an answer comes. Its `objective`, as that of
        `order`, says what is asked, if the model needs that. With an `agent` (address) only its answer counts.
        Anybody can answer: who did is `Answer.agent`. Legacy answers don't say which question they are for.

        Raises `Unanswered` after `timeout` seconds. A robot may make a contract of a question, one that costs nothing.
        """
        cid = await self._cid_of(objective) if objective else ""
        writer = self.runtime.trader.writer
        by = parse_address(agent) if agent else ""
        try:
            async with asyncio.timeout(timeout):
                named = await self.parts.chain.names.model(model or self.model)
                terms = await writer.terms(
                    model=named, objective=cid or named, cost=0, token="", validator="", lifetime=None
                )
                return await Question(self.parts, writer, agent=by).ask(terms)
        except TimeoutError:
            raise Unanswered(model or self.model, timeout) from None


def _encoded(topic: str, value: object) -> tuple[bytes, PayloadType]:
    """The payload of a reading and its type. Raises `InvalidPayload`, `ReadingTooLarge`."""
    payload, kind = encode_described(value)
    if len(payload) > LARGEST_READING:
        raise ReadingTooLarge(topic, len(payload))
    return payload, kind
