"""The bridge: a ROS 2 system as a device of an agent.

Its topics are those of a device: in a job they are the liability's and are recorded, outside a job they are
`aira/agent/{address}/device/{device}/{topic}`. What a job's objective plays, its handlers publish, or anyone puts on
the device's topics, is published to the robot. Only topics that are allowed are carried, each in one direction: what
may be published is not carried back.

The two sides have a session each, so nothing of the ROS 2 system is ever on a key of the mesh's router that is not one
of the device's. The definition of a topic's type travels with its first message of each job, and again every few
seconds. A query for `/aira/idle` is answered when all that came before it is published to the robot.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from typing import TYPE_CHECKING, Any, Final

import zenoh

from bridges.devices import ABOUT, CONNECTION, DeviceAbout, DeviceTopic, JobTracker, is_put_by_edge, said_by
from bridges.ros2._robot import Robot
from mesh.base.background import Background, call_in_loop
from mesh.base.flood import Drops
from mesh.base.lifecycle import Role
from mesh.base.log_context import liability_context, log_event
from mesh.errors import AiraError, ConfigurationError, InputError, InvalidKey
from mesh.network import PumpLimits, sending
from mesh.network.endpoints import Endpoints
from mesh.network.pump import Pump
from mesh.recording.ros import RosTypes
from mesh.telemetry.metrics import MetricFamily, by_label, drop_family
from schemas.address import ZERO_ADDRESS
from schemas.errors import InvalidPayload
from schemas.keys import (
    IDLE,
    PRESENT,
    DeviceTopicKey,
    LiabilityTopicKey,
    ObjectiveTopicKey,
    device_selector,
    event_selector,
    objective_selector,
    parse_agent_key,
    topic_chunks,
    topic_selector,
)
from schemas.payloads import Payload, PayloadType, SentDefinitions, String, decode_value, payload_type
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from contextlib import AsyncExitStack
    from pathlib import Path

    from bridges.ros2._robot import RosAllowed
    from bridges.ros2._wire import RosEntity
    from mesh.settings import Settings


log = logging.getLogger(__name__)


class RosBridge(Role):
    """A ROS 2 system as the device `name` of the agent with the address `agent`.

    `session` is that of the mesh, `ros_session` that of the ROS 2 system, on another router. `allow` says which topics
    are carried: `publish` those from the mesh to the robot, `subscribe` those of the robot. `options` are those of
    `Robot`. Raises `InvalidKey` for an invalid name.
    """

    title = "bridge to ROS 2"

    def __init__(
        self,
        session: zenoh.Session,
        ros_session: zenoh.Session,
        types: RosTypes,
        allow: RosAllowed,
        *,
        agent: str,
        name: str = "robot",
        **options: Any,
    ) -> None:
        self.drops: Final = Drops()
        self._session = session
        self._ros_session = ros_session
        self._robot = Robot(ros_session, types, allow=allow, drops=self.drops, **options)
        self._own = str(ros_session.zid())
        self._allow = allow
        self._agent = agent
        self._name = name
        self.jobs: Final = JobTracker()
        self._carried: set[str] = set()
        self._definitions = SentDefinitions()
        self._refused: set[str] = set()
        self._present: Any = None
        self._until_idle: dict[bytes, tuple[zenoh.Query, set[str]]] = {}
        """The queries that wait for earlier commands, and the keys on which their markers are under way, by marker."""
        self.published = self.received = 0
        """Messages from the mesh to the robot, and from the robot."""
        self._key(PRESENT)
        self._selectors = {
            self._key(IDLE): device_selector(agent, name),
            str(LiabilityTopicKey(agent, ZERO_ADDRESS, IDLE)): topic_selector(agent),
            str(ObjectiveTopicKey(agent, ZERO_ADDRESS, IDLE)): objective_selector(agent),
        }
        """What commands are received by, and a key of each that only markers have."""

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        await stack.enter_async_context(self._robot)
        self._tasks = await stack.enter_async_context(Background())
        self._tasks.start(self.drops.run(), "drops")
        stack.callback(self._withdraw)
        declared: list[Any] = [
            self._session.declare_subscriber(
                event_selector(self._agent),
                lambda sample: call_in_loop(loop, self.jobs.handle_event, str(sample.key_expr)),
            ),
            self._session.declare_queryable(
                self._key(ABOUT), lambda query: call_in_loop(loop, self._reply_about, query)
            ),
            self._session.declare_queryable(
                self._key(IDLE), lambda query: call_in_loop(loop, self._reply_when_idle, query)
            ),
        ]
        stack.callback(self._undeclare, declared)
        for selector in self._selectors.values():
            pump: Pump[tuple[str, bytes, str]] = Pump(
                self._session,
                selector,
                self._taken,
                limits=PumpLimits(size=32 << 20, payload=16 << 20),  # of messages of each kind from the mesh
                drops=self.drops,
            )
            await stack.enter_async_context(pump)
            self._tasks.start(self._publish_all(pump), f"commands of {selector}")

    async def _work(self) -> None:
        while True:
            await self._robot.graph.wait_for(self._has_changed)
            self._show_presence()
            for topic in self._offered() - self._carried:
                if len(self._carried) >= 256:  # topics of the robot that are carried, at most
                    self.drops.count("ros-topic")
                    self._refused.add(topic)
                    continue
                self._carried.add(topic)
                self._tasks.start(self._carry(topic), f"carry {topic}")

    def families(self) -> tuple[MetricFamily, ...]:
        counts = {"in": self.received, "out": self.published}
        help_text = "Messages from the ROS 2 system (in) and to it (out)"
        return (
            by_label("aira_ros2_messages_total", "counter", help_text, "direction", counts),
            drop_family(self.drops),
        )

    def parts(self) -> Mapping[str, str]:

        def linked(session: zenoh.Session) -> bool:
            return not session.is_closed() and bool(session.info.routers_zid())

        return {
            "channel": ALIVE if linked(self._session) else "waits for a router",
            "ros2": ALIVE if linked(self._ros_session) else "waits for the router of the ROS 2 system",
            "robot": ALIVE if self._present is not None else "is absent",
        }

    def _has_changed(self) -> bool:
        return bool(self._offered() - self._carried) or self._is_there() != (self._present is not None)

    def _offered(self) -> set[str]:
        """The robot's topics that may be carried and have a publisher of its own."""
        found = {one.name for one in self._others() if one.kind == "publisher"} - self._refused
        allow = self._allow
        return {name for name in found if allow.allows("subscribe", name) and not allow.allows("publish", name)}

    def _is_there(self) -> bool:
        return bool(self._others())

    def _others(self) -> list[RosEntity]:
        return [one for one in self._robot.graph.entities() if one.session != self._own]

    def _show_presence(self) -> None:
        """Declare or withdraw the device's presence: whether a node of the ROS 2 system is there."""
        if self._is_there() == (self._present is not None):
            return
        job = self.jobs.current
        if self._present is None:
            self._present = self._session.liveliness().declare_token(self._key(PRESENT))
        else:
            self._withdraw()
        state = "absent" if self._present is None else "present"
        facts = log_event("ros-presence", device=self._name, state=state)
        log.info("the ROS 2 system is %s", state, extra=facts)
        if job:
            payload = self._robot.types.message("std_msgs/String", data=state)
            self._put(job, f"{CONNECTION}/{self._name}", payload.data, payload.type)

    async def _carry(self, topic: str) -> None:
        while True:
            try:
                topic_chunks(topic)
                async with self._robot.subscribe(topic) as messages:
                    log.info("%s is carried", topic, extra=log_event("ros-topic-carried", topic=topic))
                    async for message in messages:
                        self.received += 1
                        self._put(self.jobs.current, message.topic, message.payload.data, message.payload.type)
            except AiraError as error:
                level = logging.DEBUG if error.code == "ros-unavailable" else logging.WARNING
                refused = log_event("ros-topic-refused", topic=topic, code=error.code)
                log.log(level, "%s is not carried: %s", topic, error, extra=refused)
            await asyncio.sleep(5.0)  # seconds after which a topic is tried again that could not be subscribed to

    def _put(self, job: str, topic: str, payload: bytes, kind: PayloadType) -> None:
        """Put a message of the robot on its topic of the current job, or of the device."""
        key = str(LiabilityTopicKey(self._agent, job, topic)) if job else self._key(topic)
        mark = self._definitions.attachment(said_by(self._name), key, kind, time.monotonic())
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=mark)

    def _taken(self, sample: zenoh.Sample) -> tuple[str, bytes, str] | None:
        """A message from the mesh to the robot. Runs on the pump's thread."""
        if sample.kind != zenoh.SampleKind.PUT or is_put_by_edge(sample.attachment):
            return None
        return str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)

    async def _publish_all(self, commands: Pump[tuple[str, bytes, str]]) -> None:
        async for key, payload, encoding in commands:
            if key in self._selectors:
                self._pass_marker(key, payload)
                continue
            self._publish(key, payload, payload_type(encoding))
            if self.published % 64 == 0:
                await asyncio.sleep(0)

    def _publish(self, key: str, payload: bytes, kind: PayloadType) -> None:
        """Publish a message from the mesh to the robot, if its topic is allowed."""
        try:
            parsed = parse_agent_key(key)
        except InvalidKey as error:
            log.info("%s", error, extra=log_event("key-ignored", key=key))
            return
        if not isinstance(parsed, DeviceTopicKey | LiabilityTopicKey | ObjectiveTopicKey):
            return
        job = "" if isinstance(parsed, DeviceTopicKey) else parsed.liability
        if not self._allow.allows("publish", parsed.topic):
            return
        with liability_context(job):
            try:
                self._robot.publish(parsed.topic, *self._message(parsed.topic, payload, kind))
                self.published += 1
            except AiraError as error:
                self.drops.count("ros-command", job)
                rejected = log_event("command-rejected", topic=parsed.topic, code=error.code)
                log.warning("%s: %s", parsed.topic, error, extra=rejected)

    def _message(self, topic: str, payload: bytes, kind: PayloadType) -> tuple[Any, ...]:
        """What to publish: a payload of ROS 2 as it is; anything else as the fields of the topic's type."""
        if kind.encoding == "cdr":
            return (Payload(payload, kind),)
        value = decode_value(payload, kind)
        types = {one.type for one in self._robot.graph.find(topic, "subscription") if one.type}
        if len(types) != 1 or isinstance(value, bytes):
            why = "it is no message of ROS 2, and the robot does not say of which one type the topic is"
            raise InvalidPayload(topic, why)
        if not isinstance(value, dict):
            value = {"data": value.data if isinstance(value, String) else value}
        return next(iter(types)), value

    def _reply_when_idle(self, query: zenoh.Query) -> None:
        """Reply once a marker has passed through each queue of commands: samples reach a subscriber in order."""
        marker = secrets.token_bytes(16)
        self._until_idle[marker] = query, set(self._selectors)
        for key in self._selectors:
            self._session.put(key, marker, allowed_destination=zenoh.Locality.SESSION_LOCAL)

    def _pass_marker(self, key: str, marker: bytes) -> None:
        query, under_way = self._until_idle.get(marker, (None, set()))
        under_way.discard(key)
        if query is not None and not under_way:
            del self._until_idle[marker]
            with query:
                query.reply(str(query.key_expr), b"")

    def _reply_about(self, query: zenoh.Query) -> None:
        about = DeviceAbout(
            name=self._name,
            present=self._present is not None,
            job=self.jobs.current,
            topics=tuple(
                DeviceTopic(name, flow, kinds[0])
                for name, kinds in self._robot.graph.topics().items()
                for flow, is_allowed in (
                    ("hears", self._allow.allows("publish", name)),
                    ("says", self._allow.allows("subscribe", name)),
                )
                if is_allowed
            ),
            counters={"published": self.published, "received": self.received},
        )
        about.reply(query)

    def _key(self, topic: str) -> str:
        return str(DeviceTopicKey(self._agent, self._name, topic))

    def _undeclare(self, declared: list[Any]) -> None:
        for query, _ in self._until_idle.values():
            query.drop()  # type: ignore[no-untyped-call]
        if not self._session.is_closed():
            for each in declared:
                each.undeclare()

    def _withdraw(self) -> None:
        token, self._present = self._present, None
        if token is not None and not self._session.is_closed():
            token.undeclare()


def types_of(settings: Settings, allow: RosAllowed, folder: Path | None) -> RosTypes:
    """The types of the settings' distribution, and those in a folder (PACKAGE/msg/TYPE.msg).

    Raises `InputError` if no topic is allowed, `UnknownRosType`, `PackageMissing`.
    """
    if not allow.publish and not allow.subscribe:
        raise InputError(
            "no topic is allowed, and the bridge carries no others",
            hint="allow some: --publish /cmd_vel (to the robot), --subscribe '/camera/*' (from it)",
            code="ros-nothing-allowed",
        )
    types = RosTypes(settings.ros2_distribution)
    for path in sorted(folder.rglob("*.msg") if folder is not None else ()):
        with path.open(encoding="utf-8", errors="replace") as file:
            # Bytes of the longest file with a definition.
            types.register(f"{path.parent.parent.name}/msg/{path.stem}", file.read(1 << 20))
    return types


def ros_endpoints(settings: Settings) -> Endpoints:
    """Where the ROS 2 system is. Raises `ConfigurationError` if that is the mesh's router."""
    _check_apart(settings.ros2_connect, settings.connect)
    return Endpoints(connect=settings.ros2_connect, timeout=settings.connect_timeout)


def check_apart(mesh: zenoh.Session, ros: zenoh.Session) -> None:
    """Raise `ConfigurationError` if both sessions are on one router, whatever it is called."""
    _check_apart(map(str, mesh.info.routers_zid()), map(str, ros.info.routers_zid()))


def _check_apart(here: Iterable[str], there: Iterable[str]) -> None:
    for router in {*here} & {*there}:
        raise ConfigurationError(
            f"the ROS 2 system and the mesh are on the same router, {router}",
            hint="start another router for one of them, and name it: --ros2-connect tcp/HOST:PORT",
            code="ros-router-shared",
        )
