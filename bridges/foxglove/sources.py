"""What is shown live: the market, an agent, a running job."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from contextlib import AsyncExitStack
from datetime import datetime
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.base.background import Background
from mesh.cli.watch import EventFormatter, event_json
from mesh.errors import AiraError
from mesh.network import Pump, Reading
from mesh.recording import foxglove
from mesh.watching import JobEvent, MarketWatch, status_of
from mesh.watching.market import read_event
from mesh.watching.presence import LogReader
from schemas import PlaybackPosition, ProgressKey, event_selector
from schemas.keys import (
    DeviceTopicKey,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    ReadingKey,
    RpcKey,
    device_selector,
    objective_selector,
    parse_agent_key,
    reading_selector,
    topic_selector,
)
from schemas.payloads import PayloadType, defined_by, payload_type

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

    from bridges.foxglove.server import FoxgloveServer
    from mesh.network import Channel
    from mesh.watching import MarketEvent

LOG: Final = "/aira/log"
"""Lines for people."""
JOB: Final = "/aira/job"
PROGRESS: Final = "/aira/progress"
STATUS: Final = "/aira/status"
COUNTS: Final = "/aira/counts"
_LEVELS: Final = {
    "debug": foxglove.LogLevel.DEBUG,
    "info": foxglove.LogLevel.INFO,
    "warning": foxglove.LogLevel.WARNING,
    "error": foxglove.LogLevel.ERROR,
    "critical": foxglove.LogLevel.FATAL,
}


class LiveMessage(NamedTuple):
    """A message of an agent, or what it says of its job."""

    topic: str
    payload: bytes
    type: PayloadType
    at_ns: int
    event: JobEvent | None = None


async def show_market(server: FoxgloveServer, session: zenoh.Session, channel: Channel) -> None:
    """Show everything that happens on a market, until cancelled: a topic for each kind of event, and a log."""
    formatter, counts = EventFormatter({}), Counter[str]()
    async with AsyncExitStack() as stack:
        watch = await stack.enter_async_context(MarketWatch(session, channel, readings=True))
        tasks = await stack.enter_async_context(Background())
        tasks.start(watch.recall(), "foxglove: open orders")
        tasks.start(_show_counts(server, counts), "foxglove: counts")
        async for event in watch:
            counts[_show_event(server, formatter, event)] += 1


def _show_event(server: FoxgloveServer, formatter: EventFormatter, event: MarketEvent) -> str:
    """Show an event of the market; returns its kind."""
    if isinstance(event, Reading):
        topic = f"/{event.agent.lower()}{event.topic}"
        server.publish(topic, event.payload, event.type, sender=event.agent)
        return "reading"
    facts = _facts(event)
    kind = "job" if isinstance(event, JobEvent) else str(facts["event"])
    server.publish_value(f"/market/{kind}", facts)
    server.publish_value(LOG, foxglove.Log(message=formatter.line(event), name=kind))
    return kind


async def _show_counts(server: FoxgloveServer, counts: Counter[str]) -> None:
    """Show how many events there were since the start."""
    kinds = ("demand", "offer", "result", "rejected", "declined", "job", "reading")
    while True:
        server.publish_value(COUNTS, {kind: counts[kind] for kind in kinds})
        await asyncio.sleep(1.0)


async def show_agent(server: FoxgloveServer, session: zenoh.Session, agent: str, lighthouse: str) -> None:
    """Show what an agent (address) and its devices publish, its jobs, its status and its log, until cancelled."""
    selectors = (
        reading_selector(agent),
        device_selector(agent),
        topic_selector(agent),
        objective_selector(agent),
        event_selector(agent),
    )
    async with Background() as tasks:
        for selector in selectors:
            tasks.start(_show_topics(server, session, selector, _agent_topic), f"foxglove: {selector}")
        tasks.start(_show_log(server, session, agent), "foxglove: log")
        while True:
            for status in await status_of(session, agent, lighthouse):
                server.publish(STATUS, status.encode(), PayloadType("json", "aira.Status"))
            await asyncio.sleep(5.0)


async def show_job(server: FoxgloveServer, session: zenoh.Session, agent: str, liability: str) -> None:
    """Show a job, by the address of its promisor and its own, until cancelled."""
    selectors = (
        topic_selector(agent, liability),
        objective_selector(agent, liability),
        event_selector(agent, liability),
    )
    async with Background() as tasks:
        for selector in selectors:
            tasks.start(_show_topics(server, session, selector, attrgetter("topic")), f"foxglove: {selector}")
        await _show_log(server, session, agent, liability)
        await asyncio.Event().wait()


async def _show_topics(
    server: FoxgloveServer, session: zenoh.Session, selector: str, name: Callable[[Any], str]
) -> None:
    async with Pump(session, selector, lambda sample: received(sample, name), drops=server.front.drops) as pump:
        async for message in pump:
            if message.event is None:
                server.publish(message.topic, message.payload, message.type, at_ns=message.at_ns)
                continue
            server.publish_value(JOB, _facts(message.event), at_ns=message.at_ns)
            words = f"{message.event.event}: {message.event.liability.address}"
            server.publish_value(LOG, foxglove.Log(message=words, name="job"), at_ns=message.at_ns)


def _facts(event: MarketEvent) -> dict[str, Any]:
    return {name: value for name, value in event_json(event, time="").items() if name != "time"}


def received(sample: zenoh.Sample, name: Callable[[Any], str]) -> LiveMessage | None:
    """What an agent has sent; None if it is nothing that is shown. `name` gives the topic for a key."""
    text, payload, now = str(sample.key_expr), sample.payload.to_bytes(), time.time_ns()
    try:
        match key := parse_agent_key(text):
            case ProgressKey():
                position = PlaybackPosition.decode(payload)
                facts = b'{"position":%d,"total":%d}' % (position.position, position.total)
                return LiveMessage(PROGRESS, facts, PayloadType("json", "aira.Progress"), now)
            case ReadingKey() | DeviceTopicKey() | ObjectiveTopicKey() | LiabilityTopicKey():
                return LiveMessage(name(key), payload, _type_of(sample), now)
        event = read_event(text, payload)
        return None if event is None else LiveMessage(JOB, b"", PayloadType("json"), now, event)
    except AiraError:
        return None


def _type_of(sample: zenoh.Sample) -> PayloadType:
    """The type of a message; its definition may travel with the first one of a topic."""
    kind = payload_type(str(sample.encoding))
    if sample.attachment is None or kind.schema_data:
        return kind
    return defined_by(sample.attachment.to_bytes(), kind) or kind


def _agent_topic(key: Any) -> str:
    match key:
        case ReadingKey():
            return f"/reading{key.topic}"
        case DeviceTopicKey():
            return f"/device/{key.device}{key.topic}"
    return f"/job{key.topic}"


async def _show_log(server: FoxgloveServer, session: zenoh.Session, agent: str, liability: str = "") -> None:
    """Show the lines of an agent's log as long as it answers us: on a site, it answers operators only."""
    reader = LogReader(session, str(RpcKey(agent, "logs")), lines=100, level="info", liability=liability)
    while True:
        try:
            update = await reader.poll()
        except AiraError:
            return
        for event in update.events:
            at = _time_of(event.time)
            line = foxglove.Log(
                message=event.message,
                level=_LEVELS.get(event.level, foxglove.LogLevel.UNKNOWN),
                name=event.logger,
                timestamp=foxglove.Timestamp(*divmod(at, 10**9)),
            )
            server.publish_value(LOG, line, at_ns=at)
        if not update.more:
            await asyncio.sleep(2.0)


def _time_of(text: str) -> int:
    """The Unix time in ns of a text in ISO 8601; now if it is none."""
    try:
        return max(0, round(datetime.fromisoformat(text).timestamp() * 1e9))
    except (ValueError, OverflowError):
        return time.time_ns()
