"""Readings: what agents publish outside any job, such as the state of a battery.

A reading is put on a key of its agent once. It is not signed, and not kept: those who listen get it. A router with a
roster lets nobody else write there.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from mesh.base.background import Background
from mesh.base.flood import Drops, FairQueue
from mesh.base.lifecycle import Lifecycle
from mesh.errors import AiraError
from mesh.network._validation import ValidationStatistics
from mesh.network.pump import Pump, PumpLimits
from schemas import parse_address
from schemas.keys import ReadingKey, parse_agent_key, reading_selector
from schemas.payloads import payload_type, plain_value

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    import zenoh

    from schemas.payloads import PayloadType

LARGEST_READING: Final = 256 * 1024
"""Bytes of the largest reading."""


class ReadingLimits(NamedTuple):
    """How many readings wait for the consumer."""

    waiting: int = 256
    """In all."""
    of_agent: int = 64
    """Those of one agent."""


READING_LIMITS: Final = ReadingLimits()


@dataclass(frozen=True, slots=True)
class Reading:
    """A message that an agent published outside any job."""

    agent: str
    """Its address, EIP-55."""
    topic: str
    value: Any
    """`Empty`, `String`, JSON data or bytes."""
    payload: bytes = field(repr=False)
    type: PayloadType = field(repr=False)
    result: str = ""
    """The CID of the recording, if it came as an answer: in a result that belongs to no contract."""


class ReadingSubscription(Lifecycle):
    """Readings from now on: `async with ReadingSubscription(session) as readings`, then iterate. For one consumer.

    `agent` (address) and `topic` select them; by default all are received. Agents take turns when more arrives than is
    consumed; what is too much, too large or not of its type is dropped, and counted in `drops`.
    """

    title = "subscription to readings"

    def __init__(
        self, session: zenoh.Session, *, agent: str = "*", topic: str = "/**", drops: Drops | None = None
    ) -> None:
        self._drops = Drops() if drops is None else drops
        self._lock = threading.Lock()
        self._invalid = self._overflow = 0
        selector = reading_selector(agent, topic)
        self._pump = Pump(session, selector, self._read, limits=PumpLimits(payload=LARGEST_READING), drops=self._drops)
        self._queue: FairQueue[Reading] = FairQueue(per_sender=READING_LIMITS.of_agent, total=READING_LIMITS.waiting)

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self._pump)
        tasks = await stack.enter_async_context(Background())
        tasks.start(self._receive(), "readings")

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Reading:
        return await self._queue.get()

    def refuse(self, agent: str = "") -> None:
        """Count a reading that is not believed."""
        with self._lock:  # the pump's thread counts, too
            self._invalid += 1
        self._drops.count("reading-invalid", agent)

    def statistics(self) -> ValidationStatistics:
        """What was received, refused (as `reading`) and dropped so far."""
        pump = self._pump
        accepted, dropped = pump.received - pump.dropped - self._invalid, pump.dropped + self._overflow
        return ValidationStatistics(
            received=pump.received, accepted=accepted, invalid={"reading": self._invalid}, duplicate=0, dropped=dropped
        )

    async def _receive(self) -> None:
        async for reading in self._pump:
            for dropped in self._queue.put(reading.agent, reading):
                self._overflow += 1
                self._drops.count("reading-overflow", dropped.agent)

    def _read(self, sample: zenoh.Sample) -> Reading | None:
        """The reading in a sample; None if it is not one."""
        kind, payload = payload_type(str(sample.encoding)), sample.payload.to_bytes()
        try:
            key = parse_agent_key(str(sample.key_expr))
            if isinstance(key, ReadingKey):
                return Reading(parse_address(key.agent), key.topic, plain_value(payload, kind), payload, kind)
        except AiraError:
            self.refuse()
        return None
