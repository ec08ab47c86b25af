"""The topics that the bridge carries, and what it is built from.

Jobs: what objectives play is published below `/liability/eth_ADDRESS`, what nodes answer there is recorded. Which jobs
there are is seen in the names of the graph's topics, so a bridge that was killed goes on where it was. A node that
started a job and then disappears fails it.

Devices: what the agent's boards say is published under the names that the boards give their topics, so a node hears a
board on `aira edge` as it heard one on rosserial, in a job and outside.
"""

from __future__ import annotations

import asyncio
import logging
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from bridges.devices import is_said_by_device
from bridges.ros1._wire import Ros1Error
from bridges.ros1.messages import Ros1Type
from bridges.ros1.node import call_api
from mesh.base.background import Background
from mesh.base.flood import BoundedDict
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import liability_context, log_event
from mesh.errors import AiraError, InvalidKey
from mesh.network import Pump, PumpLimits, call, sending
from mesh.recording import NOTE_TOPIC
from mesh.recording.ros import LEGACY_TOPIC, RosConverter, legacy_topic
from schemas import String, parse_address
from schemas.errors import InvalidPayload
from schemas.keys import (
    DeviceTopicKey,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    device_selector,
    objective_selector,
    parse_agent_key,
    topic_selector,
)
from schemas.payloads import (
    EMPTY,
    JSON,
    RAW,
    STRING,
    PayloadType,
    SentDefinitions,
    decode_value,
    defined_by,
    encode_value,
    payload_type,
)
from schemas.rpc import FinishLiability

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack

    from bridges.ros1.node import Ros1Graph, Ros1Node, Ros1Publisher, Ros1Subscription
    from mesh.content import Exchange, Store
    from mesh.network import Channel, Network
    from mesh.recording.ros import RosConversion

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RosBridgeParts:
    """The agent with the address `agent`, which the bridge shows, and the ROS graph that it shows it to.

    `channel` is that of the agent's market; files are those of `store` and `exchange`; recordings of the player of
    bags are made in `directory`.
    """

    agent: str
    network: Network
    channel: Channel
    graph: Ros1Graph
    store: Store
    exchange: Exchange
    directory: Path


@dataclass(frozen=True, kw_only=True)
class RosBridgeOptions:
    """How a bridge serves its graph.

    It is the device `name` of its agent. `recording_topics` are recorded besides those of jobs. With `as_original`
    topics are published after a second, whether anybody subscribes or not. `folders` are those that the services for
    files may read and write, up to `size_limit` bytes of a file. `generation` is the version of messages for those who
    take any. With `is_alone`, our master is the only one: it has /rosout. A job whose node has disappeared for
    `gone_seconds` fails; until then it may be restarted.
    """

    name: str = "ros1"
    recording_topics: frozenset[str] = frozenset()
    as_original: bool = False
    folders: tuple[Path, ...] = (Path(tempfile.gettempdir()),)
    generation: str = "3"
    is_alone: bool = False
    size_limit: int = 256 << 20
    gone_seconds: float = 30.0


class Ros1TopicLimits(NamedTuple):
    """What topics may use of the bridge."""

    recorded: int = 512
    """Topics that are recorded at the same time."""
    waiting: int = 10_000
    """Messages of a job that wait to be published."""
    of_devices: int = 256
    """Topics of devices that are published."""
    types: int = 10_000
    """Definitions of topics' types that are remembered."""
    conversions: int = 256
    """Types of ROS 2 whose conversions are remembered."""


TOPIC_LIMITS: Final = Ros1TopicLimits()


def type_in(header: Mapping[str, str]) -> PayloadType:
    """The type of a publisher's messages, with its definition, by the header of its connection."""
    definition = header.get("message_definition", "").encode()
    return PayloadType("ros1", header.get("type", ""), "ros1msg", definition)


async def advertise(node: Ros1Node, topic: str, kind: PayloadType) -> Ros1Publisher:
    """Publish a topic of messages that are encoded already. Raises `InvalidPayload`, `InvalidGraphName`."""
    return await node.advertise(topic, Ros1Type(kind.schema_name, kind.schema_data.decode(errors="replace")))


class RosPayloads:
    """Makes messages of ROS 1 from what arrives. It remembers the definitions that come with some messages only."""

    def __init__(self) -> None:
        self._types: dict[tuple[str, str], PayloadType] = {}
        self._converter = RosConverter(0, "jazzy")
        self._conversions: BoundedDict[PayloadType, RosConversion] = BoundedDict(TOPIC_LIMITS.conversions)
        """Of types of ROS 2: to make one takes some 90 ms."""

    def type_of(self, sample: zenoh.Sample) -> PayloadType:
        """The type of what arrived, with its definition if that is known. On the thread of a pump."""
        key, kind = str(sample.key_expr), payload_type(str(sample.encoding))
        if kind.schema_data or not kind.schema_name:
            return kind
        found = None if sample.attachment is None else defined_by(sample.attachment.to_bytes(), kind)
        if found is not None and len(self._types) < TOPIC_LIMITS.types:
            self._types[key, kind.schema_name] = found
        return found or self._types.get((key, kind.schema_name), kind)

    def for_ros(self, payload: bytes, kind: PayloadType) -> tuple[bytes, PayloadType]:
        """A message as one of ROS 1, with its definition. Raises `InvalidPayload`, `PackageMissing`."""
        if kind.encoding == "ros1":
            kind = kind if kind.schema_data else self._converter.of(kind).type
            if not kind.schema_data and kind != EMPTY:
                raise InvalidPayload(kind.schema_name, "its definition is not known")
            return payload, kind
        if kind.encoding == "cdr":
            conversion = self._conversions.get(kind)
            if conversion is None:
                conversion = self._conversions[kind] = RosConverter(1, "jazzy").of(kind)
            if conversion.why:
                raise InvalidPayload(kind.schema_name, conversion.why)
            try:
                return conversion.convert(payload), conversion.type
            except Exception as error:  # whatever rosbags raises for a stranger's payload
                raise InvalidPayload(kind.schema_name, str(error)) from None
        changed, type = encode_value(decode_value(payload, kind))
        if type not in (JSON, RAW):
            return changed, type
        return encode_value(String(payload.decode(errors="replace")))


class Ros1TopicPace(NamedTuple):
    """How long topics wait for nodes, in seconds."""

    subscriber: float = 5.0
    """For which the first message of a topic waits for a subscriber."""
    look: float = 0.25
    """Between two looks at the graph's topics."""
    connect: float = 1.0
    """For which the first message of a topic waits for the recorder to be connected."""
    quiet: float = 0.2
    """For which nodes must have said nothing before a job ends: what they said just before comes another way …"""
    longest_quiet: float = 2.0
    """… but no longer than this."""


TOPIC_PACE: Final = Ros1TopicPace()


@dataclass(eq=False)
class _Job:
    """A job whose objective is played, and the node that drives it."""

    queue: asyncio.Queue[tuple[str, bytes, PayloadType]] = field(
        default_factory=lambda: asyncio.Queue(TOPIC_LIMITS.waiting)
    )
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
            limits=PumpLimits(size=32 << 20, payload=16 << 20),  # of messages that are played
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
        until = now + TOPIC_PACE.longest_quiet
        while now < min(self._heard_at + TOPIC_PACE.quiet, until):
            await asyncio.sleep(min(self._heard_at + TOPIC_PACE.quiet, until) - now)
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
            await asyncio.sleep(1.0)  # as the original player did, subscriber or not
        elif not await publisher.wait_for_subscriber(TOPIC_PACE.subscriber):
            facts = log_event("ros1-no-subscriber", topic=publisher.topic)
            log.warning(
                "nobody subscribes to %s; its messages are published all the same", publisher.topic, extra=facts
            )
        await self._listen_to_nodes()
        return publisher

    async def _end(self, job: _Job) -> None:
        if job.player is not None:
            job.player.cancel()
        await asyncio.sleep(TOPIC_PACE.look)  # seconds in which nodes may still read what was published last
        for publisher in job.publishers.values():
            await publisher.close()
        if not any(each.is_busy for each in self._jobs.values()):
            self._idle.set()

    async def _look(self) -> None:
        while True:
            await self._subscribe_to_new()
            await asyncio.sleep(TOPIC_PACE.look)

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
                if len(self._subscriptions) >= TOPIC_LIMITS.recorded:
                    self._node.drops.count("ros1-topic", topic)
                    continue
                received = partial(self._record, topic)
                self._subscriptions[topic] = await self._node.subscribe(topic, topics[topic], received)

    async def _listen_to_nodes(self) -> None:
        """Connect to what nodes publish now, before anything is played to them, so that their answers are recorded."""
        await self._subscribe_to_new()
        with suppress(TimeoutError):
            async with asyncio.timeout(TOPIC_PACE.connect):
                for subscription in tuple(self._subscriptions.values()):
                    await subscription.wait_until_connected()
        # Seconds after which a node of rospy sends messages to a subscriber that it has just accepted.
        await asyncio.sleep(0.05)

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


DEVICES_NODE: Final = "/aira_devices"
RESERVED: Final = ("/liability/", "/eth/", "/ipfs/", "/rosbagplayer/", "/rosout")
"""What names of topics begin with that only the bridge publishes."""


class RosDevices(Lifecycle):
    """The topics of the agent's devices on the node `node`: `async with RosDevices(...)`."""

    title = "devices on ROS 1"

    def __init__(self, parts: RosBridgeParts, node: Ros1Node) -> None:
        self._session = parts.network.session
        self._agent = parts.agent
        self._node = node
        self._payloads = RosPayloads()
        self._topics: dict[str, tuple[Ros1Publisher, PayloadType]] = {}
        self._refused: set[str] = set()
        """Keys whose refusal is in the log already."""

    async def _open(self, stack: AsyncExitStack) -> None:
        tasks = await stack.enter_async_context(Background())
        for selector in (topic_selector(self._agent), device_selector(self._agent)):
            pump: Pump[tuple[str, bytes, PayloadType]] = Pump(
                self._session,
                selector,
                self._taken,
                limits=PumpLimits(payload=16 << 20),
                drops=self._node.drops,
            )
            await stack.enter_async_context(pump)
            tasks.start(self._publish_all(pump), f"devices on {selector}")

    def _taken(self, sample: zenoh.Sample) -> tuple[str, bytes, PayloadType] | None:
        """What a board says; robots of ROS 2 have a graph of their own. Runs on the pump's thread."""
        if sample.kind != zenoh.SampleKind.PUT or not is_said_by_device(sample.attachment):
            return None
        kind = self._payloads.type_of(sample)
        return None if kind.encoding == "cdr" else (str(sample.key_expr), sample.payload.to_bytes(), kind)

    async def _publish_all(self, pump: Pump[tuple[str, bytes, PayloadType]]) -> None:
        async for key, payload, kind in pump:
            try:
                parsed = parse_agent_key(key)
                if isinstance(parsed, DeviceTopicKey | LiabilityTopicKey):
                    await self._publish(parsed.topic, payload, kind)
            except AiraError as error:
                self._refuse(key, error)

    async def _publish(self, topic: str, payload: bytes, kind: PayloadType) -> None:
        """Raises `InvalidKey`, `InvalidGraphName`, `InvalidPayload`, `PackageMissing`."""
        if kind.encoding == "json":  # whose values may have another type each time
            payload, kind = String(payload.decode(errors="replace")).encode(), STRING
        else:
            payload, kind = self._payloads.for_ros(payload, kind)
        if topic not in self._topics:
            if topic.startswith(RESERVED) or len(self._topics) >= TOPIC_LIMITS.of_devices:
                raise InvalidKey(topic, "the bridge has it itself, or has too many")
            publisher = await advertise(self._node, topic, kind)
            self._topics[topic] = publisher, kind
            await publisher.wait_for_subscriber(1.0)  # seconds for one that is there already
        publisher, known = self._topics[topic]
        if kind != known:
            raise InvalidPayload(topic, f"it was {known.schema_name} before, and is {kind.schema_name}")
        publisher.publish(payload)

    def _refuse(self, key: str, error: AiraError) -> None:
        self._node.drops.count("ros1-topic", key)
        if key not in self._refused and len(self._refused) < TOPIC_LIMITS.of_devices:
            self._refused.add(key)
            log.warning("a device is not heard in ROS: %s", error, extra=log_event("ros1-not-sent", topic=key))
