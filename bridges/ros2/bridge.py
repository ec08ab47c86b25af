"""The bridge: a ROS 2 system as a device of an agent.

Its topics are those of a device: in a job they are the liability's and are recorded, outside a job they are
`aira/agent/{address}/device/{device}/{topic}`. What a job's objective plays, its handlers publish, or anyone puts on
the device's topics, is published to the robot. Only topics that are allowed are carried, each in one direction: what
may be published is not carried back.

The two sides have a session each, so nothing of the ROS 2 system is ever on a key of the mesh's router that is not one
of the device's. The definition of a topic's type travels with its first message of each job, and again every few
seconds.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec
import zenoh

from bridges.devices import ABOUT, CONNECTION, PRESENT, JobTracker, is_put_by_edge, said_by
from bridges.ros2.errors import RosUnavailable
from bridges.ros2.robot import Robot
from mesh.background import Background, call_in_loop
from mesh.errors import AiraError, InvalidKey
from mesh.flood import Drops
from mesh.log_context import liability_context, log_event
from mesh.network import sending
from mesh.network.pump import Pump
from mesh.role import Role
from schemas.agent_keys import DeviceTopicKey, LiabilityTopicKey, ObjectiveTopicKey, parse_agent_key, topic_chunks
from schemas.definitions import SentDefinitions
from schemas.errors import InvalidPayload
from schemas.payloads import Payload, PayloadType, String, decode_value, payload_type
from schemas.selectors import device_selector, event_selector, objective_selector, topic_selector

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

    from bridges.ros2.allowed import RosAllowed
    from bridges.ros2.tokens import RosEntity
    from bridges.ros2.topics import RosMessage
    from mesh.ros import RosTypes

log = logging.getLogger(__name__)

RETRY_SECONDS: Final = 5.0
"""Seconds after which a topic is tried again that could not be subscribed to."""
MOST_TOPICS: Final = 256
"""Topics of the robot that are carried, at most."""
LARGEST_COMMAND: Final = 16 << 20
"""Bytes of the largest message from the mesh to the robot."""
COMMAND_BYTES: Final = 32 << 20
"""Bytes of messages from the mesh that wait, at most, of each kind."""


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
        self._robot = Robot(ros_session, types, allow=allow, drops=self.drops, **options)
        self._own = str(ros_session.zid())
        self._allow = allow
        self._agent = agent
        self._name = name
        self._jobs = JobTracker()
        self._carried: set[str] = set()
        self._definitions = SentDefinitions()
        self._refused: set[str] = set()
        self._present: Any = None
        self.published = self.received = 0
        """Messages from the mesh to the robot, and from the robot."""
        self._key(PRESENT)

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        await stack.enter_async_context(self._robot)
        self._tasks = await stack.enter_async_context(Background())
        self._tasks.start(self.drops.run(), "drops")
        stack.callback(self._withdraw)
        declared: list[Any] = [
            self._session.declare_subscriber(
                event_selector(self._agent),
                lambda sample: call_in_loop(loop, self._jobs.handle_event, str(sample.key_expr)),
            ),
            self._session.declare_queryable(
                self._key(ABOUT), lambda query: call_in_loop(loop, self._reply_about, query)
            ),
        ]
        stack.callback(self._undeclare, declared)
        for selector in (
            device_selector(self._agent, self._name),
            topic_selector(self._agent),
            objective_selector(self._agent),
        ):
            pump: Pump[tuple[str, bytes, str]] = Pump(
                self._session,
                selector,
                self._taken,
                capacity_bytes=COMMAND_BYTES,
                payload_limit=LARGEST_COMMAND,
                drops=self.drops,
            )
            await stack.enter_async_context(pump)
            self._tasks.start(self._publish_all(pump), f"commands of {selector}")

    async def _work(self) -> None:
        """Carry the robot's topics as they appear, until cancelled."""
        while True:
            await self._robot.graph.wait_for(self._has_changed)
            self._show_presence()
            for topic in self._offered() - self._carried:
                if len(self._carried) >= MOST_TOPICS:
                    self.drops.count("ros-topic")
                    self._refused.add(topic)
                    continue
                self._carried.add(topic)
                self._tasks.start(self._carry(topic), f"carry {topic}")

    @property
    def current_job(self) -> str:
        """The liability (address) that the robot works for now; empty for none."""
        return self._jobs.current

    @property
    def is_present(self) -> bool:
        """Whether a node of the ROS 2 system is there."""
        return self._present is not None

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
        job = self._jobs.current
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
        """Put the messages of a topic of the robot into the mesh."""
        while True:
            try:
                topic_chunks(topic)
                async with self._robot.subscribe(topic) as messages:
                    log.info("%s is carried", topic, extra=log_event("ros-topic-carried", topic=topic))
                    async for message in messages:
                        self._take(message)
            except RosUnavailable:
                log.debug("%s has no publisher", topic)
            except AiraError as error:
                refused = log_event("ros-topic-refused", topic=topic, code=error.code)
                log.warning("%s is not carried: %s", topic, error, extra=refused)
            await asyncio.sleep(RETRY_SECONDS)

    def _take(self, message: RosMessage) -> None:
        self.received += 1
        self._put(self._jobs.current, message.topic, message.payload.data, message.payload.type)

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

    def _reply_about(self, query: zenoh.Query) -> None:
        graph = self._robot.graph
        facts = {
            "name": self._name,
            "version": "",
            "present": self._present is not None,
            "port": "",
            "job": self._jobs.current,
            "topics": [
                {"name": name, "flow": flow, "type": kinds[0]}
                for name, kinds in graph.topics().items()
                for flow, use in (("hears", "publish"), ("says", "subscribe"))
                if self._allow.allows(use, name)  # type: ignore[arg-type]
            ],
            "counters": {"published": self.published, "received": self.received},
        }
        with query:
            query.reply(str(query.key_expr), msgspec.json.encode(facts), encoding="application/json")

    def _key(self, topic: str) -> str:
        return str(DeviceTopicKey(self._agent, self._name, topic))

    def _undeclare(self, declared: list[Any]) -> None:
        if not self._session.is_closed():
            for each in declared:
                each.undeclare()

    def _withdraw(self) -> None:
        token, self._present = self._present, None
        if token is not None and not self._session.is_closed():
            token.undeclare()
