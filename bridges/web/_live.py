"""What robots and their devices publish now: the topics of jobs, and readings outside of jobs, as samples for the page.

Jobs are followed from the first question on, those of the local account from their contracts on; the readings of all
robots always, so that a robot's page has a past. What is kept, and how much comes of one robot, is bounded: what is too
much is dropped.
"""

from __future__ import annotations

import asyncio
import base64
import math
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from bridges.web._files import picture_in
from mesh.base.background import Background
from mesh.base.flood import Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.errors import AiraError
from mesh.network import Pump, PumpLimits
from mesh.recording import Played, numbers_of, shown_value
from schemas import parse_address, parse_key
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey, ReadingKey, job_selector, reading_selector
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.web._market import Market, SeenJob
    from bridges.web._stream import Stream
    from bridges.web.components import WebComponents


class LiveJobLimits(NamedTuple):
    """What is kept of jobs."""

    jobs: int = 16
    """Jobs that are followed, or of which samples are kept."""
    samples: int = 2_000
    """Samples of one job that are kept, …"""
    size: int = 4 << 20
    """… and their bytes as JSON."""


JOB_LIMITS: Final = LiveJobLimits()


class LiveReadingLimits(NamedTuple):
    """What is kept of robots' readings."""

    robots: int = 256
    """Robots whose readings are kept."""
    topics: int = 16
    """Topics of one robot."""
    readings: int = 500
    """Readings on one topic that are kept, …"""
    size: int = 128 << 10
    """… their bytes, …"""
    age: float = 600.0
    """… and how old they may be, in seconds; the last one may be older."""
    interval: float = 5.0
    """Seconds between two readings on one topic that are kept while nobody looks at the robot."""
    size_in_all: int = 48 << 20
    """Bytes of the readings of all robots."""
    overhead: int = 256
    """Bytes that a reading takes in memory beside its payload."""


LIVE_READING_LIMITS: Final = LiveReadingLimits()
MESSAGES: Final = Rate(per_second=400.0, burst=400)
"""Messages of one job, or of one robot's readings, that are shown."""
PICTURES: Final = Rate(per_second=4.0, burst=4)
"""Pictures among them."""


class LiveValueLimits(NamedTuple):
    """What is shown of one message."""

    counted: int = 4096
    """It counts once more (`MESSAGES`) for each of so many bytes, since they are decoded, unless it is a picture."""
    message: int = 512 << 10
    """Bytes of the largest message."""
    picture: int = 256 << 10
    """Bytes of the largest picture."""
    numbers: int = 32
    """Numbers of one message."""


VALUE_LIMITS: Final = LiveValueLimits()


class Samples:
    """Samples as JSON, the latest ones: `most` of them, of `most_bytes` bytes, and always the last one."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most = most
        self._most_bytes = most_bytes
        self._kept: deque[msgspec.Raw] = deque()
        self._bytes = 0

    def add(self, sample: msgspec.Raw) -> None:
        self._kept.append(sample)
        self._bytes += len(memoryview(sample))
        while len(self._kept) > self._most or (self._bytes > self._most_bytes and len(self._kept) > 1):
            self._bytes -= len(memoryview(self._kept.popleft()))

    def __iter__(self) -> Iterator[msgspec.Raw]:
        return iter(self._kept)


class TopicReadings(deque[Played]):
    """The latest readings on one topic, and always the last one."""

    size = 0
    """Their bytes in memory."""

    def add(self, reading: Played, *, interval: float) -> None:
        """Add the newest one. The one before it stays if it came `interval` seconds after its own predecessor."""
        if len(self) > 1 and _seconds(self[-1]) - _seconds(self[-2]) < interval:
            self._forget(self.pop())
        self.append(reading)
        self.size += len(reading.payload) + LIVE_READING_LIMITS.overhead
        oldest = _seconds(reading) - LIVE_READING_LIMITS.age
        while len(self) > 1 and (
            len(self) > LIVE_READING_LIMITS.readings
            or self.size > LIVE_READING_LIMITS.size
            or _seconds(self[0]) < oldest
        ):
            self._forget(self.popleft())

    def _forget(self, reading: Played) -> None:
        self.size -= len(reading.payload) + LIVE_READING_LIMITS.overhead


class Readings:
    """What robots have published lately outside of jobs, whether somebody looks at them or not.

    It is bounded by topic, by robot and in all. `is_viewed` says whether somebody looks at a robot (address) now.
    """

    def __init__(self, is_viewed: Callable[[str], bool]) -> None:
        self._is_viewed = is_viewed
        self._robots: dict[str, dict[str, TopicReadings]] = {}
        """By address and topic; who was heard longest ago comes first."""
        self.size = 0
        """Bytes of all of them in memory."""

    def add(self, robot: str, reading: Played) -> None:
        topics = self._robots.pop(robot, {})
        self._robots[robot] = topics
        if reading.topic not in topics and len(topics) >= LIVE_READING_LIMITS.topics:
            return
        kept = topics.setdefault(reading.topic, TopicReadings())
        before = kept.size
        kept.add(reading, interval=0.0 if self._is_viewed(robot) else LIVE_READING_LIMITS.interval)
        self.size += kept.size - before
        if len(self._robots) > LIVE_READING_LIMITS.robots:
            self._forget(next((one for one in self._robots if not self._is_viewed(one)), next(iter(self._robots))))
        while self.size > LIVE_READING_LIMITS.size_in_all and len(self._robots) > 1:
            self._forget(max(self._robots, key=lambda one: (not self._is_viewed(one), self._size_of(one))))

    def of(self, robot: str) -> dict[str, list[Played]]:
        """The readings of a robot (address) by topic, oldest first."""
        return {topic: list(kept) for topic, kept in self._robots.get(robot, {}).items()}

    def _size_of(self, robot: str) -> int:
        return sum(kept.size for kept in self._robots[robot].values())

    def _forget(self, robot: str) -> None:
        self.size -= self._size_of(robot)
        del self._robots[robot]


def _seconds(message: Played) -> float:
    return message.log_time_ns / 1e9


class Followed:
    """What is published on `selector`, with the agent (address) that it is of: `run` subscribes until it is cancelled.

    `keep` gets each message. What is too much of one agent is dropped before.
    """

    def __init__(
        self,
        components: WebComponents,
        selector: str,
        *,
        is_own: bool = False,
        keep: Callable[[str, Played], Awaitable[None]],
    ) -> None:
        self._parts = components
        self._selector = selector
        self._keep = keep
        self._messages = RateLimiter(per_sender=MESSAGES)
        self._pictures = RateLimiter(per_sender=PICTURES)
        self.is_own = is_own
        """Whether it is a job of the local account."""
        self.asked_at = time.monotonic()
        self.is_open = asyncio.Event()
        self.task: asyncio.Task[None] | None = None

    def stop(self) -> None:
        if self.task is not None:
            self.task.cancel()

    async def run(self) -> None:
        pump = Pump(
            self._parts.network.session,
            self._selector,
            self._read,
            limits=PumpLimits(1024, JOB_LIMITS.size, payload=VALUE_LIMITS.message),
            drops=self._parts.drops,
        )
        try:
            async with pump:
                self.is_open.set()
                async for agent, message in pump:
                    await self._keep(agent, message)
        finally:
            self.is_open.set()

    def _read(self, sample: zenoh.Sample) -> tuple[str, Played] | None:
        """The agent of a sample, and the message; None for what is not shown. On the pump's thread."""
        try:
            key = parse_key(str(sample.key_expr))
            if not isinstance(key, ObjectiveTopicKey | LiabilityTopicKey | ReadingKey):
                return None
            agent = parse_address(key.agent)
        except AiraError:
            return None
        now, kind = time.time_ns(), payload_type(str(sample.encoding))
        role = "objective" if isinstance(key, ObjectiveTopicKey) else "device"
        message = Played(key.topic, sample.payload.to_bytes(), now, now, 0, kind, role)
        is_picture = picture_in(message) is not None
        if not self._messages.allow(agent, 1.0 if is_picture else 1.0 + len(message.payload) / VALUE_LIMITS.counted):
            self._parts.drops.count("live-overflow", agent)
            return None
        if is_picture and not self._pictures.allow(agent):
            return None
        return agent, message


def sample_json(message: Played) -> dict[str, Any]:
    """A message as a sample. A large one takes a tenth of a second: call it in a thread."""
    picture, image, is_cut, value = picture_in(message), None, False, None
    if picture is None:
        value, is_cut = shown_value(message)
    elif len(picture[0]) <= VALUE_LIMITS.picture:
        image = f"data:{picture[1]};base64,{base64.b64encode(picture[0]).decode()}"
    else:
        is_cut = True
    numbers = islice(((name.removeprefix("."), number) for name, number in numbers_of(message)), VALUE_LIMITS.numbers)
    return {
        "topic": message.topic,
        "role": message.role,
        "at": _seconds(message),
        "value": value,
        "numbers": [[name[:200], number] for name, number in numbers if math.isfinite(number)] if not picture else [],
        "image": image,
        "size": len(message.payload),
        "cut": is_cut,
    }


def _encoded(message: Played) -> msgspec.Raw:
    return msgspec.Raw(msgspec.json.encode(sample_json(message)))


class Live(Lifecycle):
    """Follows jobs and readings for the page: `async with Live(components, market, stream) as live`."""

    title = "live values"

    def __init__(self, components: WebComponents, market: Market, stream: Stream) -> None:
        self._parts = components
        self._market = market
        self._stream = stream
        self._jobs: dict[str, tuple[Followed, Samples]] = {}
        self._readings = Readings(lambda robot: stream.has_subscribers(f"readings/{robot}"))

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        self._tasks.start(self._end_jobs(), "page: live jobs")
        readings = Followed(self._parts, reading_selector(), keep=self._take_reading)
        self._start(readings, "readings")
        await readings.is_open.wait()
        self._market.on_contract = self._take_contract
        self._stream.on_subscribe = self._subscribed

    async def samples(self, address: str) -> list[msgspec.Raw]:
        """The samples of a job that are kept, oldest first; it is followed from now on, unless it has ended.

        Raises `NotALiability`, `ChainError`.
        """
        job = self._market.jobs.get(address) or await self._market.job(address)
        self._follow_job(job)
        if (known := self._jobs.get(address)) is None:
            return []
        followed, samples = known
        await followed.is_open.wait()
        return list(samples)

    async def readings(self, robot: str) -> dict[str, list[dict[str, Any]]]:
        """The readings of a robot (address) that are kept, by topic, oldest first."""
        topics = self._readings.of(robot)
        return await asyncio.to_thread(lambda: {topic: [*map(sample_json, kept)] for topic, kept in topics.items()})

    async def _take_reading(self, robot: str, reading: Played) -> None:
        topic = f"readings/{robot}"
        sample = await asyncio.to_thread(sample_json, reading) if self._stream.has_subscribers(topic) else None
        self._readings.add(robot, reading)
        if sample is not None:
            self._stream.publish(topic, "message", sample)

    def _take_contract(self, job: SeenJob) -> None:
        agent = self._parts.agent
        if agent is not None and agent.address in (job.liability.promisee, job.liability.promisor):
            self._follow_job(job, is_own=True)

    def _subscribed(self, topics: frozenset[str]) -> None:
        """Follow the jobs that a browser has subscribed to, if they are known already."""
        for topic in topics:
            kind, _, named = topic.partition("/")
            if kind == "live" and (job := self._market.jobs.get(named)) is not None:
                self._follow_job(job)

    def _follow_job(self, job: SeenJob, *, is_own: bool = False) -> None:
        address, liability = job.liability.address, job.liability
        if (known := self._jobs.get(address)) is not None:
            known[0].asked_at = time.monotonic()
        elif not liability.is_finalized:
            samples = Samples(JOB_LIMITS.samples, JOB_LIMITS.size)

            async def keep(_agent: str, message: Played) -> None:
                sample = await asyncio.to_thread(_encoded, message)
                samples.add(sample)
                if self._stream.has_subscribers(topic := f"live/{address}"):
                    self._stream.publish(topic, "message", sample)

            selector = job_selector(liability.promisor, address)
            followed = Followed(self._parts, selector, is_own=is_own, keep=keep)
            self._jobs[address] = followed, samples
            self._start(followed, f"live {address}")
            self._forget_jobs()

    def _start(self, followed: Followed, name: str) -> None:
        followed.task = self._tasks.start(followed.run(), f"page: {name}")

    def _forget_jobs(self) -> None:
        """Forget what nobody looks at, and was asked for longest ago; jobs of the local account last."""

        def worth(address: str) -> tuple[bool, bool, float]:
            followed, _ = self._jobs[address]
            return followed.is_own, self._stream.has_subscribers(f"live/{address}"), followed.asked_at

        *others, _newest = self._jobs
        if len(self._jobs) > JOB_LIMITS.jobs:
            followed, _ = self._jobs.pop(min(others, key=worth))
            followed.stop()

    async def _end_jobs(self) -> None:
        """End the subscriptions of jobs a while after their end; what was kept of them stays."""
        ended: dict[str, float] = {}
        while True:
            await asyncio.sleep(1.0)  # seconds between two looks at which jobs have ended
            now = time.monotonic()
            for address, (followed, _) in self._jobs.items():
                job = self._market.jobs.get(address)
                if job is not None and job.liability.is_finalized:
                    if now - ended.setdefault(address, now) > 15.0:  # seconds after the end
                        followed.stop()
                else:
                    ended.pop(address, None)
            for address in [address for address in ended if address not in self._jobs]:
                del ended[address]
