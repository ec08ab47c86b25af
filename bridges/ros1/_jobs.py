"""The jobs of an agent on the ROS graph: what objectives play is published, what nodes answer is recorded.

The topics of a job are below `/liability/eth_ADDRESS`. Which jobs there are is seen in the names of the graph's topics,
so a bridge that was killed goes on where it was. A node that started a job and then disappears fails it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

import zenoh

from bridges.ros1._payloads import RosPayloads, advertise, type_in
from bridges.ros1._wire import Ros1Error
from bridges.ros1.node import call_api
from mesh.base.background import Background
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import liability_context, log_event
from mesh.errors import AiraError, InvalidKey
from mesh.network import Pump, call, sending
from mesh.recording import NOTE_TOPIC
from mesh.recording.ros import LEGACY_TOPIC, legacy_topic
from schemas import String, parse_address
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey, objective_selector, parse_agent_key
from schemas.payloads import (
    PayloadType,
    SentDefinitions,
)
from schemas.rpc import FinishLiability

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack

    from bridges.ros1._parts import RosBridgeOptions, RosBridgeParts
    from bridges.ros1.node import Ros1Node, Ros1Publisher, Ros1Subscription

log = logging.getLogger(__name__)

SUBSCRIBER_SECONDS: Final = 5.0
"""For which the first message of a topic waits for a subscriber."""
ORIGINAL_SECONDS: Final = 1.0
"""After which the original player published it, subscriber or not."""
LOOK_SECONDS: Final = 0.25
"""Between two looks at the graph's topics."""
CONNECT_SECONDS: Final = 1.0
"""For which the first message of a topic waits for the recorder to be connected."""
CONNECTED_SECONDS: Final = 0.05
"""After which a node of rospy sends messages to a subscriber that it has just accepted."""
QUIET_SECONDS: Final = 0.2
"""For which nodes must have said nothing before a job ends: what they said just before comes another way …"""
LONGEST_QUIET: Final = 2.0
"""… but no longer than this."""
MOST_TOPICS: Final = 512
"""Topics that are recorded at the same time."""
MOST_WAITING: Final = 10_000
"""Messages of a job that wait to be published."""


@dataclass(eq=False)
class _Job:
    """A job whose objective is played, and the node that drives it."""

    queue: asyncio.Queue[tuple[str, bytes, PayloadType]] = field(default_factory=lambda: asyncio.Queue(MOST_WAITING))
    publishers: dict[str, Ros1Publisher] = field(default_factory=dict)
    player: asyncio.Task[None] | None = None
    driver: str = ""
    seen: float = 0.0
    """When the driver was seen last, on the monotonic clock."""
    is_busy: bool = False


class RosJobs(Lifecycle):
    """The topics of the agent's jobs, on the node `node`: `async with RosJobs(...)`."""

    title = "jobs on ROS 1"

    def __init__(self, parts: RosBridgeParts, options: RosBridgeOptions, node: Ros1Node) -> None:
        self._session = parts.network.session
        self._agent = parts.agent
        self._graph = parts.graph
        self._options = options
        self._node = node
        self._jobs: dict[str, _Job] = {}
        self._subscriptions: dict[str, Ros1Subscription] = {}
        self._payloads = RosPayloads()
        self._definitions = SentDefinitions()
        self._looking = asyncio.Lock()
        self._heard_at = 0.0
        self._idle = asyncio.Event()
        self._idle.set()
        self.published = self.received = 0
        """Messages that were published to ROS, and recorded from it."""

    async def _open(self, stack: AsyncExitStack) -> None:
        self._tasks = await stack.enter_async_context(Background())
        pump: Pump[tuple[str, bytes, PayloadType]] = Pump(
            self._session,
            objective_selector(self._agent),
            self._taken,
            capacity_bytes=32 << 20,  # bytes of played messages that wait, at most
            payload_limit=16 << 20,  # bytes of the largest message to ROS
            drops=self._node.drops,
        )
        await stack.enter_async_context(pump)
        self._tasks.start(self._queue_all(pump), "objectives")
        self._tasks.start(self._look(), "topics of jobs")
        self._tasks.start(self._watch_drivers(), "nodes that drive jobs")

    @property
    def open(self) -> tuple[str, ...]:
        """The jobs (addresses) that are played or driven."""
        return tuple(self._jobs)

    def topics(self, liability: str) -> tuple[str, ...]:
        """The topics of a job's objective that were published until now."""
        return tuple(self._jobs[liability].publishers) if liability in self._jobs else ()

    def driven(self, liability: str, caller: str) -> None:
        """A node has started the job, or goes on with it: if it disappears, the job fails."""
        job = self._jobs.setdefault(liability, _Job())
        job.driver, job.seen = caller, time.monotonic()

    def ended(self, liability: str) -> None:
        """The job is over: its topics are withdrawn."""
        if (job := self._jobs.pop(liability, None)) is not None:
            self._tasks.start(self._end(job), f"end of {liability}")

    async def wait_until_idle(self) -> None:
        """Return when everything that was played is published."""
        await self._idle.wait()

    async def settle(self) -> None:
        """Return when what nodes have said before is on its way to the recording."""
        self._heard_at = now = time.monotonic()
        until = now + LONGEST_QUIET
        while now < min(self._heard_at + QUIET_SECONDS, until):
            await asyncio.sleep(min(self._heard_at + QUIET_SECONDS, until) - now)
            now = time.monotonic()

    def _taken(self, sample: zenoh.Sample) -> tuple[str, bytes, PayloadType] | None:
        """A played message. Runs on the pump's thread."""
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        return str(sample.key_expr), sample.payload.to_bytes(), self._payloads.type_of(sample)

    async def _queue_all(self, pump: Pump[tuple[str, bytes, PayloadType]]) -> None:
        async for key, payload, kind in pump:
            try:
                parsed = parse_agent_key(key)
            except InvalidKey as error:
                log.info("%s", error, extra=log_event("key-ignored", key=key))
                continue
            if not isinstance(parsed, ObjectiveTopicKey):
                continue
            liability = parse_address(parsed.liability)  # as it is in the names of ROS
            job = self._jobs.setdefault(liability, _Job())
            if job.player is None:
                job.player = self._tasks.start(self._play(liability, job), f"play {liability}")
            try:
                job.queue.put_nowait((parsed.topic, payload, kind))
                self._idle.clear()
            except asyncio.QueueFull:
                self._node.drops.count("ros1-command", liability)

    async def _play(self, liability: str, job: _Job) -> None:
        while True:
            job.is_busy = not job.queue.empty()
            if not any(each.is_busy for each in self._jobs.values()):
                self._idle.set()
            topic, payload, kind = await job.queue.get()
            job.is_busy = True
            with liability_context(liability):
                try:
                    payload, kind = self._payloads.for_ros(payload, kind)
                    publisher = job.publishers.get(topic) or await self._advertise(liability, job, topic, kind)
                    publisher.publish(payload)
                    self.published += 1
                except AiraError as error:
                    self._node.drops.count("ros1-command", liability)
                    facts = log_event("command-rejected", topic=topic, code=error.code)
                    log.warning("%s is not published to ROS: %s", topic, error, extra=facts)

    async def _advertise(self, liability: str, job: _Job, topic: str, kind: PayloadType) -> Ros1Publisher:
        """Publish a topic of the job, and wait for its first subscriber, as the original waited a second."""
        publisher = job.publishers[topic] = await advertise(self._node, legacy_topic(liability, topic), kind)
        if self._options.as_original:
            await asyncio.sleep(ORIGINAL_SECONDS)
        elif not await publisher.wait_for_subscriber(SUBSCRIBER_SECONDS):
            facts = log_event("ros1-no-subscriber", topic=publisher.topic)
            log.warning(
                "nobody subscribes to %s; its messages are published all the same", publisher.topic, extra=facts
            )
        await self._listen_to_nodes()
        return publisher

    async def _end(self, job: _Job) -> None:
        if job.player is not None:
            job.player.cancel()
        await asyncio.sleep(LOOK_SECONDS)  # seconds in which nodes may still read what was published last
        for publisher in job.publishers.values():
            await publisher.close()
        if not any(each.is_busy for each in self._jobs.values()):
            self._idle.set()

    async def _look(self) -> None:
        while True:
            await self._subscribe_to_new()
            await asyncio.sleep(LOOK_SECONDS)

    async def _subscribe_to_new(self) -> None:
        """Subscribe to the topics of jobs, and to those that are recorded in each, that the graph has now."""
        async with self._looking:
            topics = await self._graph.topics()
            if topics is None:
                return  # what is connected stays
            also = self._options.recording_topics
            wanted = {topic for topic in topics if topic in also or LEGACY_TOPIC.fullmatch(topic)}
            for topic in self._subscriptions.keys() - wanted:
                await self._subscriptions.pop(topic).close()
            for topic in sorted(wanted - self._subscriptions.keys()):
                if len(self._subscriptions) >= MOST_TOPICS:
                    self._node.drops.count("ros1-topic", topic)
                    continue
                received = partial(self._record, topic)
                self._subscriptions[topic] = await self._node.subscribe(topic, topics[topic], received)

    async def _listen_to_nodes(self) -> None:
        """Connect to what nodes publish now, before anything is played to them, so that their answers are recorded."""
        await self._subscribe_to_new()
        with suppress(TimeoutError):
            async with asyncio.timeout(CONNECT_SECONDS):
                for subscription in tuple(self._subscriptions.values()):
                    await subscription.wait_until_connected()
        await asyncio.sleep(CONNECTED_SECONDS)

    def _record(self, topic: str, payload: bytes, header: Mapping[str, str]) -> None:
        """A node has said something: it becomes part of the recording of its job."""
        found = LEGACY_TOPIC.fullmatch(topic)
        jobs, below = (self.open, topic) if found is None else ((found[1],), found[2])
        kind = type_in(header)
        self.received += 1
        self._heard_at = time.monotonic()
        for liability in jobs:
            try:
                key = str(LiabilityTopicKey(self._agent, liability, below))
            except InvalidKey as error:
                self._node.drops.count("ros1-topic", topic)
                log.debug("%s is not recorded: %s", topic, error)
                continue
            # Not marked as said by a device: boards of the agent hear it, as they would in the ROS graph.
            definition_too = self._definitions.attachment(b"", key, kind, time.monotonic()) or None
            sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=definition_too)

    async def _watch_drivers(self) -> None:
        """Fail the jobs whose node has disappeared."""
        while True:
            await asyncio.sleep(min(1.0, self._options.gone_seconds / 4))
            for liability, job in tuple(self._jobs.items()):
                if not job.driver or await self._is_there(job.driver):
                    job.seen = time.monotonic()
                elif time.monotonic() - job.seen > self._options.gone_seconds:
                    await self._fail(liability, job)

    async def _is_there(self, node: str) -> bool:
        """Whether a node answers. While the master does not, nothing is known."""
        try:
            uri = await self._graph.call("lookupNode", node)
        except Ros1Error as error:
            return error.code == "ros1-unreachable"
        try:
            await call_api(uri, "getPid", self._node.name)
        except Ros1Error:
            return False
        return True

    async def _fail(self, liability: str, job: _Job) -> None:
        why, job.driver = f"the ROS node {job.driver} has disappeared [ros1-node-gone]", ""
        log.warning("%s", why, extra=log_event("ros1-node-gone", liability=liability))
        note = String(why)
        key = str(LiabilityTopicKey(self._agent, liability, NOTE_TOPIC))
        sending.put(self._session, key, note.encode(), encoding=note.type.zenoh_encoding)
        try:
            await call(self._session, self._agent, "finish", FinishLiability(liability, False))
        except AiraError as error:
            log.warning("the job can't be ended: %s", error, extra=log_event("job-not-ended", code=error.code))
