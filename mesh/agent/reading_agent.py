"""What an agent says and hears outside of jobs: readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.agent.trading_agent import TradingAgent
from mesh.errors import InputError
from mesh.network import ReadingSubscription, sending
from mesh.network.readings import LARGEST_READING
from schemas.agent_keys import ReadingKey
from schemas.payloads import encode_value

if TYPE_CHECKING:
    from mesh.flood import Drops


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
    """The methods of an `Agent` for readings."""

    drops: Drops

    def publish(self, topic: str, message: object) -> None:
        """Publish a reading on a topic of the agent, outside any job. Those who listen now get it; nobody keeps it.

        `message` is anything that `Job.publish` accepts. Raises `InvalidPayload`, `ReadingTooLarge`, `InvalidKey` for
        an invalid topic, `ClosedError`, and `ConfigurationError` if the agent has no account.
        """
        session, key = self.parts.network.session, str(ReadingKey(self.address, topic))
        payload, kind = encode_value(message)
        if len(payload) > LARGEST_READING:
            raise ReadingTooLarge(topic, len(payload))
        sending.put(session, key, payload, encoding=kind.zenoh_encoding)

    def readings(self, topic: str = "/**", *, agent: str = "*") -> ReadingSubscription:
        """What agents publish outside of jobs: `async with agent.readings("/battery") as readings`, then iterate.

        By default on all topics, by all agents; `agent` is an address. Raises `InvalidKey`, `ClosedError`.
        """
        return ReadingSubscription(self.network.session, agent=agent, topic=topic, drops=self.drops)
