"""What robots and their devices publish now: the topics of jobs, and readings outside of jobs, as samples for the page.

Subscribed to is what somebody asks for, and the jobs of the local account from their contracts on. What is kept, and
how much comes of one robot, is bounded: what is too much is dropped.
"""

from __future__ import annotations

import asyncio
import base64
import math
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web._files import picture_in, shown_value
from mesh.base.background import Background
from mesh.base.flood import Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.errors import AiraError
from mesh.network import Pump
from mesh.recording import Played, numbers_of
from schemas import parse_address, parse_key
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey, ReadingKey, job_selector, reading_selector
from schemas.payloads import payload_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.web._market import Market, SeenJob
    from bridges.web._stream import Stream
    from bridges.web.components import WebComponents


JOBS: Final = 16
"""Jobs that are followed, or of which samples are kept."""
ROBOTS: Final = 32
"""Robots whose readings are followed."""
SAMPLES: Final = 2_000
"""Samples of one job that are kept, …"""
BYTES: Final = 4 << 20
"""… and their bytes as JSON."""
READINGS: Final = 500
"""Readings on one topic that are kept, …"""
READING_BYTES: Final = 128 << 10
"""… and their bytes as JSON."""
TOPICS: Final = 16
"""Topics of one robot whose readings are kept."""
MESSAGES: Final = Rate(per_second=400.0, burst=400)
"""Messages of one job, or of one robot's readings, that are shown."""
PICTURES: Final = Rate(per_second=4.0, burst=4)
"""Pictures among them."""
LARGEST: Final = 512 << 10
"""Bytes of the largest message that is shown."""
LARGEST_PICTURE: Final = 256 << 10
"""Bytes of the largest picture that is shown."""
NUMBERS: Final = 32
"""Numbers of one message."""
AFTER_END: Final = 15.0
"""Seconds for which a job is followed after its end was seen."""


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


class Followed:
    """One job, or the readings of one robot: `run` subscribes until it is cancelled, and keeps what comes."""

    def __init__(
        self,
        components: WebComponents,
        selector: str,
        *,
        is_own: bool = False,
        keep: Callable[[str, msgspec.Raw], object],
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
        """End the subscription, if it is open."""
        if self.task is not None:
            self.task.cancel()

    async def run(self) -> None:
        """Subscribe until it is stopped."""
        pump = Pump(
            self._parts.network.session,
            self._selector,
            self._read,
            capacity=1024,
            capacity_bytes=BYTES,
            payload_limit=LARGEST,
            drops=self._parts.drops,
        )
        try:
            async with pump:
                self.is_open.set()
                async for topic, sample in pump:
                    self._keep(topic, sample)
        finally:
            self.is_open.set()

    def _read(self, sample: zenoh.Sample) -> tuple[str, msgspec.Raw] | None:
        """The topic of a sample and the sample as JSON; None for what is not shown. On the pump's thread."""
        try:
            key = parse_key(str(sample.key_expr))
        except AiraError:
            return None
        if not isinstance(key, ObjectiveTopicKey | LiabilityTopicKey | ReadingKey):
            return None
        if not self._messages.allow(""):
            self._parts.drops.count("live-overflow", key.agent)
            return None
        now, kind = time.time(), payload_type(str(sample.encoding))
        role = "objective" if isinstance(key, ObjectiveTopicKey) else "device"
        message = Played(key.topic, sample.payload.to_bytes(), int(now * 1e9), int(now * 1e9), 0, kind, role)
        picture = picture_in(message)
        if picture is not None and not self._pictures.allow(""):
            return None
        return key.topic, msgspec.Raw(msgspec.json.encode(sample_json(message, picture, at=now)))


def sample_json(message: Played, picture: tuple[bytes, str] | None, *, at: float) -> dict[str, Any]:
    """A message as a sample; `at` is when it came (Unix time)."""
    image, is_cut, value = None, False, None
    if picture is None:
        value, is_cut = shown_value(message)
    elif len(picture[0]) <= LARGEST_PICTURE:
        image = f"data:{picture[1]};base64,{base64.b64encode(picture[0]).decode()}"
    else:
        is_cut = True
    numbers = islice(((name.removeprefix("."), number) for name, number in numbers_of(message)), NUMBERS)
    return {
        "topic": message.topic,
        "role": message.role,
        "at": at,
        "value": value,
        "numbers": [[name[:200], number] for name, number in numbers if math.isfinite(number)] if not picture else [],
        "image": image,
        "size": len(message.payload),
        "cut": is_cut,
    }


class Live(Lifecycle):
    """Follows jobs and readings for the page: `async with Live(components, market, stream) as live`."""

    title = "live values"

    def __init__(self, components: WebComponents, market: Market, stream: Stream) -> None:
        self._parts = components
        self._market = market
        self._stream = stream
        self._jobs: dict[str, tuple[Followed, Samples]] = {}
        self._robots: dict[str, tuple[Followed, dict[str, Samples]]] = {}

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        self._tasks.start(self._end_jobs(), "page: live jobs")
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

    async def readings(self, robot: str) -> dict[str, list[msgspec.Raw]]:
        """The readings of a robot (address) that are kept, by topic, oldest first; it is followed from now on."""
        self._follow_robot(robot)
        followed, topics = self._robots[robot]
        await followed.is_open.wait()
        return {topic: list(samples) for topic, samples in topics.items()}

    def _take_contract(self, job: SeenJob) -> None:
        agent = self._parts.agent
        if agent is not None and agent.address in (job.liability.promisee, job.liability.promisor):
            self._follow_job(job, is_own=True)

    def _subscribed(self, topics: frozenset[str]) -> None:
        """Follow what a browser has subscribed to: jobs that are known already, and readings."""
        for topic in topics:
            kind, _, named = topic.partition("/")
            if kind == "live" and (job := self._market.jobs.get(named)) is not None:
                self._follow_job(job)
            elif kind == "readings" and _is_address(named):
                self._follow_robot(named)

    def _follow_job(self, job: SeenJob, *, is_own: bool = False) -> None:
        address, liability = job.liability.address, job.liability
        if (known := self._jobs.get(address)) is not None:
            known[0].asked_at = time.monotonic()
        elif not liability.is_finalized:
            samples = Samples(SAMPLES, BYTES)

            def keep(_topic: str, sample: msgspec.Raw) -> None:
                samples.add(sample)
                self._publish(f"live/{address}", sample)

            selector = job_selector(liability.promisor, address)
            followed = Followed(self._parts, selector, is_own=is_own, keep=keep)
            self._jobs[address] = followed, samples
            self._start(followed, f"live {address}")
            self._drop_beyond(self._jobs, JOBS, "live")

    def _follow_robot(self, robot: str) -> None:
        if (known := self._robots.get(robot)) is not None:
            known[0].asked_at = time.monotonic()
            return
        topics: dict[str, Samples] = {}

        def keep(topic: str, sample: msgspec.Raw) -> None:
            if topic not in topics and len(topics) >= TOPICS:
                return
            topics.setdefault(topic, Samples(READINGS, READING_BYTES)).add(sample)
            self._publish(f"readings/{robot}", sample)

        followed = Followed(self._parts, reading_selector(robot), keep=keep)
        self._robots[robot] = followed, topics
        self._start(followed, f"readings {robot}")
        self._drop_beyond(self._robots, ROBOTS, "readings")

    def _start(self, followed: Followed, name: str) -> None:
        followed.task = self._tasks.start(followed.run(), f"page: {name}")

    def _drop_beyond(self, known: dict[str, tuple[Followed, Any]], most: int, kind: str) -> None:
        """Forget what nobody looks at, and was asked for longest ago; jobs of the local account last."""

        def worth(address: str) -> tuple[bool, bool, float]:
            followed = known[address][0]
            return followed.is_own, self._stream.has_subscribers(f"{kind}/{address}"), followed.asked_at

        *others, _newest = known
        if len(known) > most:
            followed, _ = known.pop(min(others, key=worth))
            followed.stop()

    def _publish(self, topic: str, sample: msgspec.Raw) -> None:
        if self._stream.has_subscribers(topic):
            self._stream.publish(topic, "message", sample)

    async def _end_jobs(self) -> None:
        """End the subscriptions of jobs a while after their end; what was kept of them stays."""
        ended: dict[str, float] = {}
        while True:
            await asyncio.sleep(1.0)  # seconds between two looks at which jobs have ended
            now = time.monotonic()
            for address, (followed, _) in self._jobs.items():
                job = self._market.jobs.get(address)
                if job is not None and job.liability.is_finalized:
                    if now - ended.setdefault(address, now) > AFTER_END:
                        followed.stop()
                else:
                    ended.pop(address, None)
            for address in [address for address in ended if address not in self._jobs]:
                del ended[address]


def _is_address(text: str) -> bool:
    try:
        return parse_address(text) == text
    except AiraError:
        return False
