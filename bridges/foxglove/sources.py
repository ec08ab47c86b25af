"""What is shown: live the market, an agent or a running job; of a job that has ended its recording, which clients
control: play, pause, speed, seek.

All clients see the same playback. What a recording showed at a moment, the last message of each topic, is found fast,
also far into a long recording.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from bisect import bisect_right
from collections import Counter
from contextlib import AsyncExitStack, aclosing, suppress
from datetime import datetime
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from foxglove.websocket import PlaybackCommand, PlaybackState, PlaybackStatus

from bridges.foxglove.server import FoxgloveServer, PlaybackControl
from mesh.base.background import Background, call_in_loop
from mesh.base.log_context import log_event
from mesh.cli.watch import EventFormatter, event_json
from mesh.errors import AiraError, InputError
from mesh.network import Pump, Reading
from mesh.recording import GENEROUS, foxglove, open_objective
from mesh.recording.playback import read_ahead
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
    from collections.abc import Callable, Mapping
    from pathlib import Path

    import zenoh
    from foxglove.websocket import PlaybackControlRequest

    from bridges.foxglove.server import FoxgloveFront
    from bridges.web.components import WebComponents
    from mesh.network import Channel
    from mesh.recording import Objective, Played
    from mesh.watching import MarketEvent
    from schemas import Liability

log = logging.getLogger(__name__)

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
    kinds = ("demand", "offer", "result", "rejected", "declined", "judged", "job", "reading")
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


class MomentLimits(NamedTuple):
    """What is remembered of a recording, so that any moment of it is found soon."""

    points: int = 64
    """Points of a recording from which a moment is found."""
    topics: int = 512
    """Topics whose last message is shown."""
    size: int = 32 << 20
    """Bytes of the messages that are remembered at the points; beyond, there are no more points."""


MOMENT_LIMITS: Final = MomentLimits()


class _Point(NamedTuple):
    time_ns: int
    number: int
    last: Mapping[str, Played]


class Moments:
    """The moments of a recording. Everything here blocks: use one thread at a time. The first one reads it all."""

    def __init__(self, recording: Objective) -> None:
        self._recording = recording
        self._points: list[_Point] = []

    def at(self, time_ns: int) -> tuple[int, list[Played]]:
        """The number of the first message after a time (ns), and the last message of each topic before.

        Raises `CorruptRecording` if the file has changed.
        """
        if time_ns < self._recording.start_ns:
            return 0, []
        if not self._points:
            self._points = self._read_points()
        # The time of a point is that of its first message, which the point itself does not have.
        place = bisect_right(self._points, time_ns, key=lambda point: point.time_ns) - 1
        index, last = self._points[place].number, dict(self._points[place].last)
        for message in self._recording.messages(from_index=index):
            if message.log_time_ns > time_ns:
                break
            index += 1
            _note(last, message)
        return index, sorted(last.values(), key=lambda message: message.log_time_ns)

    def _read_points(self) -> list[_Point]:
        step = max(1, -(-self._recording.count // MOMENT_LIMITS.points))
        points: list[_Point] = []
        last: dict[str, Played] = {}
        remembered, since = 0, dict[str, int]()
        for index, message in enumerate(self._recording.messages()):
            if index % step == 0:
                remembered += sum(since.values())
                if points and remembered > MOMENT_LIMITS.size:
                    break
                points.append(_Point(message.log_time_ns, index, dict(last)))
                since = {}
            if _note(last, message):
                since[message.topic] = len(message.payload)
        return points


def _note(last: dict[str, Played], message: Played) -> bool:
    """Remember a message as the last one of its topic, unless there are too many topics."""
    if message.topic not in last and len(last) >= MOMENT_LIMITS.topics:
        return False
    last[message.topic] = message
    return True


class PlayerPace(NamedTuple):
    """How fast a recording may be played."""

    slowest: float = 0.01
    """The lowest speed; 1 is that of the recording."""
    fastest: float = 100.0
    """The highest speed."""
    tick: float = 1 / 30
    """Seconds between two announcements of the playback's time."""


PLAYER_PACE: Final = PlayerPace()


class PlaybackHead:
    """Where the playback is, in the recording's time (ns). For any thread; `clock` is monotonic, in ns."""

    def __init__(self, start_ns: int, end_ns: int, *, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.start_ns: Final = start_ns
        self.end_ns: Final = end_ns
        self._clock = clock
        self._lock = threading.Lock()
        self._at = start_ns
        self._since = clock()
        self._jump = start_ns
        self.speed = 1.0
        self.status = PlaybackStatus.Paused
        self.seeks = 0
        """How often the position jumped."""

    @property
    def now_ns(self) -> int:
        """The time in the recording."""
        with self._lock:
            return self._now()

    def handle(self, request: PlaybackControlRequest) -> PlaybackState:
        """Do what a client requests; the state afterwards."""
        with self._lock:
            plays = request.playback_command == PlaybackCommand.Play
            to = request.seek_time
            if to is None and plays and self.status == PlaybackStatus.Ended:
                to = self.start_ns
            self._at, self._since = self._now(), self._clock()
            if to is not None:
                self._at = min(max(to, self.start_ns), self.end_ns)
                self._jump = self._at
                self.seeks += 1
            speed = request.playback_speed
            self.speed = 1.0 if math.isnan(speed) else min(max(speed, PLAYER_PACE.slowest), PLAYER_PACE.fastest)
            if to is not None or self.status != PlaybackStatus.Ended:
                self.status = PlaybackStatus.Playing if plays else PlaybackStatus.Paused
            return self._state(did_seek=to is not None, request=request.request_id)

    def jump(self) -> tuple[int, int]:
        """How often the position jumped, and where to."""
        with self._lock:
            return self.seeks, self._jump

    def go_on(self, seeks: int, at_ns: int) -> None:
        """Reading up to there took time that does not count, unless the position has jumped again."""
        with self._lock:
            if seeks == self.seeks:
                self._at, self._since = at_ns, self._clock()

    def end(self, seeks: int) -> PlaybackState | None:
        """All messages are played, after so many jumps; None if there was another one."""
        with self._lock:
            if seeks != self.seeks or self.status != PlaybackStatus.Playing:
                return None
            self._at, self.status = self.end_ns, PlaybackStatus.Ended
            return self._state(did_seek=False, request=None)

    def _now(self) -> int:
        if self.status != PlaybackStatus.Playing:
            return self._at
        return min(self.end_ns, self._at + int((self._clock() - self._since) * self.speed))

    def _state(self, *, did_seek: bool, request: str | None) -> PlaybackState:
        return PlaybackState(self.status, self._at, self.speed, did_seek, request)


class RecordingPlayer:
    """Plays a recording as clients control it: `FoxgloveServer(…, control=player.control)`, then `run(server)`."""

    def __init__(self, recording: Objective) -> None:
        self._recording = recording
        self.head = PlaybackHead(recording.start_ns, recording.start_ns + recording.duration_ns)
        self._moments = Moments(recording)
        # The last type of each topic by encoding and name: a recorder widens the schemas of JSON.
        self._types = {(one.name, one.type.encoding, one.type.schema_name): one.type for one in recording.topics}
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()

    @property
    def control(self) -> PlaybackControl:
        """What the server needs to know of the playback."""
        return PlaybackControl(self.head.start_ns, self.head.end_ns, self._answer)

    def _answer(self, request: PlaybackControlRequest) -> PlaybackState:
        """Called on a thread of the SDK."""
        state = self.head.handle(request)
        call_in_loop(self._loop, self._changed.set)
        return state

    async def run(self, server: FoxgloveServer) -> None:
        """Play until cancelled. Raises `CorruptRecording` if the file has changed."""
        server.announce((topic, kind) for (topic, _, _), kind in self._types.items())
        while True:
            seeks, at_ns = self.head.jump()
            index = await self._show_moment(server, at_ns) if seeks else 0
            self.head.go_on(seeks, at_ns)
            await self._play(server, index, seeks)

    async def _show_moment(self, server: FoxgloveServer, at_ns: int) -> int:
        """Show the last message of each topic up to a time; returns the number of the first message after it."""
        number, last = await asyncio.to_thread(self._moments.at, at_ns)
        server.forget()
        for message in last:
            self._show(server, message)
        server.sdk.broadcast_time(at_ns)
        return number

    async def _play(self, server: FoxgloveServer, index: int, seeks: int) -> None:
        """Show the messages from a number on, each when it is due, until the position jumps."""
        head, late = self.head, 0
        async with aclosing(read_ahead(self._recording.messages(from_index=index))) as messages:
            async for message in messages:
                while head.now_ns < message.log_time_ns or head.status != PlaybackStatus.Playing:
                    late = 0
                    await self._wait(server, message.log_time_ns)
                    if head.seeks != seeks:
                        return
                self._show(server, message)
                late += 1
                if late % 64 == 0:
                    await asyncio.sleep(0)
                    if head.seeks != seeks:
                        return
        while head.seeks == seeks:
            self._changed.clear()
            if (state := head.end(seeks)) is not None:
                await asyncio.sleep(PLAYER_PACE.tick)  # the answer to a client goes first
                if head.seeks != seeks:
                    return
                server.sdk.broadcast_playback_state(state)
            await self._changed.wait()

    async def _wait(self, server: FoxgloveServer, due_ns: int) -> None:
        """Wait until a time of the recording, for the next tick, or until a client changes something."""
        self._changed.clear()
        left = PLAYER_PACE.tick
        if self.head.status == PlaybackStatus.Playing:
            server.sdk.broadcast_time(self.head.now_ns)
            left = min(PLAYER_PACE.tick, (due_ns - self.head.now_ns) / 1e9 / self.head.speed)
        try:
            async with asyncio.timeout(None if self.head.status != PlaybackStatus.Playing else max(left, 0)):
                await self._changed.wait()
        except TimeoutError:
            return

    def _show(self, server: FoxgloveServer, message: Played) -> None:
        kind = self._types.get((message.topic, message.type.encoding, message.type.schema_name), message.type)
        server.publish(message.topic, message.payload, kind, at_ns=message.log_time_ns)


async def show_job_until_end(parts: WebComponents, front: FoxgloveFront, address: str) -> Liability:
    """Show a job that runs; returns it when the chain has ended it. Raises `NotALiability`, `ChainError`."""
    liability = await parts.chain.liabilities.get(address)
    if liability.is_finalized:
        return liability
    session, promisor = parts.network.session, liability.promisor
    known = await _types_in(parts, liability.objective)
    async with FoxgloveServer(front, f"job {address}", known=known) as server, Background() as tasks:
        tasks.start(show_job(server, session, promisor, address), "foxglove: job")
        return await _ended(parts, address)


async def show_recording(parts: WebComponents, front: FoxgloveFront, liability: Liability) -> None:
    """Play the recording of a job as clients control it, until cancelled. Raises `InputError`, `ContentError`."""
    if not liability.result:
        raise InputError(f"the job {liability.address} has ended without a recording", code="no-recording")
    recording = await asyncio.to_thread(open_objective, await _fetch(parts, liability.result), GENEROUS)
    if not recording.count:
        raise InputError(f"the job {liability.address} has ended without a recording", code="no-recording")
    player = RecordingPlayer(recording)
    name = f"recording of {liability.address}"
    async with FoxgloveServer(front, name, control=player.control) as server:
        facts = log_event("recording-shown", liability=liability.address, recording=liability.result)
        log.info("%s has ended; its recording can be played", liability.address, extra=facts)
        await player.run(server)


async def _ended(parts: WebComponents, address: str) -> Liability:
    """A job when the chain has ended it. Waits while the node does not answer."""
    while True:
        await asyncio.sleep(2.0)  # seconds between two questions whether the job has ended
        liability = await parts.chain.retrying(partial(parts.chain.liabilities.get, address))
        if liability.is_finalized:
            return liability


async def _types_in(parts: WebComponents, cid: str) -> tuple[PayloadType, ...]:
    """The types that a job's objective describes; none if it can't be read soon."""
    with suppress(AiraError):
        path = await _fetch(parts, cid, timeout=4.0)
        return tuple(topic.type for topic in (await asyncio.to_thread(open_objective, path, GENEROUS)).topics)
    return ()


async def _fetch(parts: WebComponents, cid: str, timeout: float | None = None) -> Path:
    settings = parts.settings
    most = settings.fetch_timeout if timeout is None else min(timeout, settings.fetch_timeout)
    return await parts.exchange.fetch(cid, size_limit=settings.objective_expanded_limit, timeout=most)
