"""A ROS 2 robot, as a Python program without ROS sees it, and what of it may be used."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from bridges.ros2._node import RosNode, RosPublisher, RosSubscription
from bridges.ros2._services import (
    ROBOT_LIMITS,
    RosActionClient,
    RosActionServer,
    RosClient,
    RosOwnParameters,
    RosParameters,
    RosServer,
    add_definitions,
)
from bridges.ros2._wire import ACTION, DEFAULT_QOS, SEND_GOAL, RmwZenoh, Ros2Dds, full_type, type_mismatch
from mesh.base.extras import needs_extra
from mesh.base.flood import Drops
from mesh.base.lifecycle import Lifecycle
from mesh.errors import ConfigurationError, InputError
from schemas.payloads import Payload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.ros2._node import RosGraph
    from bridges.ros2._services import RosGoal, RosRecorder
    from bridges.ros2._wire import RosQos
    from mesh.recording.ros import RosTypes


RosUse: TypeAlias = Literal["publish", "subscribe", "call", "serve"]


@dataclass(frozen=True, slots=True)
class RosAllowed:
    """The names that may be used, as patterns: `/odom`, `/camera/*`, `*`.

    `call` covers services, actions and parameters: an action by its own name, parameters by the name of their node.
    `serve` covers services and actions of ours.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    call: tuple[str, ...] = ()
    serve: tuple[str, ...] = ()

    def allows(self, use: RosUse, name: str) -> bool:
        """Whether a topic or service (absolute name) may be used so."""
        patterns: tuple[str, ...] = getattr(self, use)
        return any(fnmatchcase(name.split(ACTION)[0], pattern) for pattern in patterns)

    def check(self, use: RosUse, name: str) -> None:
        """Raise `ConfigurationError` (`ros-not-allowed`) unless a topic or service may be used so."""
        if not self.allows(use, name):
            hint = f"allow it: RosAllowed({use}=({name!r},))"
            raise ConfigurationError(f"{name}: not allowed to {use}", hint=hint, code="ros-not-allowed")


EVERYTHING: Final = RosAllowed(publish=("*",), subscribe=("*",), call=("*",), serve=("*",))


TIMEOUT: Final = 10.0
"""Seconds to wait for what a call needs."""


class Robot(Lifecycle):
    """A node of ours in a ROS 2 system: `async with Robot(session, RosTypes("jazzy")) as robot`.

    `session` is a Zenoh session on the router of the robot, `types` has the distribution's types and own ones. `allow`
    says which topics and services may be used: all by default, so give it where strangers choose names. `drops` counts
    what is refused. Names are absolute, or in `namespace`.
    """

    title = "robot"

    def __init__(
        self,
        session: zenoh.Session,
        types: RosTypes,
        *,
        domain: int = 0,
        node: str = "aira",
        namespace: str = "",
        flavour: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
        allow: RosAllowed = EVERYTHING,
        drops: Drops | None = None,
    ) -> None:
        with needs_extra("ros2", "ROS 2"):
            import xxhash as xxhash
        add_definitions(types)
        self.types = types
        self.drops = Drops() if drops is None else drops
        self._allow = allow
        keys = RmwZenoh(domain) if flavour == "rmw_zenoh" else Ros2Dds(domain)
        self._node = RosNode(session, types, keys, node, namespace, self.drops)
        self._publishers: dict[str, RosPublisher] = {}
        self._clients: dict[tuple[str, str], RosClient] = {}
        self._servers: list[RosServer | RosActionServer] = []

    async def _open(self, stack: AsyncExitStack) -> None:
        self._node.open()
        stack.callback(self._node.close)
        stack.push_async_callback(self._close_endpoints)

    @property
    def graph(self) -> RosGraph:
        return self._node.graph

    async def ready(self, name: str, *, timeout: float = TIMEOUT) -> None:
        """Wait until another node publishes, subscribes to or serves a name (topic, service, action).

        Raises `RosError` after `timeout` seconds.
        """
        self.check_open()
        await self._node.wait(self._node.resolve(name), timeout)

    def publish(
        self, topic: str, message: Payload | str, fields: Mapping[str, Any] | None = None, *, qos: RosQos | None = None
    ) -> None:
        """Publish a payload of `types.message`, or a message of the type `message` with these `fields`.

        The first message of a topic declares its publisher, with `qos`; subscriptions may need a moment to find it.
        Raises `ConfigurationError`, `UnknownRosType`, `InvalidPayload`, `RosError`.
        """
        if isinstance(message, Payload):
            self.advertise(topic, message.type.schema_name, qos=qos).put(message)
        else:
            self.advertise(topic, message, qos=qos).put(dict(fields or {}))

    def advertise(self, topic: str, type_name: str, *, qos: RosQos | None = None) -> RosPublisher:
        """The publisher of a topic, which is declared if there is none yet. It is closed with the robot.

        Raises `ConfigurationError`, `UnknownRosType`, and `RosError` if the topic has another type.
        """
        self.check_open()
        topic, type_name = self._node.resolve(topic), full_type(type_name)
        self._allow.check("publish", topic)
        publisher = self._publishers.get(topic)
        if publisher is None:
            if len(self._publishers) >= ROBOT_LIMITS.endpoints:
                raise _too_many(topic)
            self._node.check_type(self._node.others(topic, "subscription"), type_name)
            publisher = self._publishers[topic] = RosPublisher(self._node, topic, type_name, qos or DEFAULT_QOS)
        elif publisher.type != type_name:
            raise type_mismatch(topic, type_name, publisher.type)
        return publisher

    def subscribe(
        self, topic: str, type_name: str = "", *, qos: RosQos | None = None, timeout: float = TIMEOUT
    ) -> RosSubscription:
        """The messages of a topic from now on, and earlier ones of transient-local publishers.

        Without a type it waits for a publisher, `timeout` seconds at most. Raises `ConfigurationError`.
        """
        self.check_open()
        topic = self._node.resolve(topic)
        self._allow.check("subscribe", topic)
        return RosSubscription(self._node, topic, type_name, qos, timeout)

    async def call(
        self, name: str, type_name: str, request: object, *, timeout: float = TIMEOUT, job: RosRecorder | None = None
    ) -> Any:
        """Call a service; returns the decoded reply.

        `request` is a dict of the request's fields, a message or a payload. With `job` request and reply become part
        of its recording, on the topics `NAME/_request` and `NAME/_reply`. Raises `RosError`
        if no reply comes within `timeout` seconds, `ConfigurationError`, `RosError`, `UnknownRosType`,
        `InvalidPayload`.
        """
        name = self._node.resolve(name)
        self._allow.check("call", name)
        return await self._call(name, full_type(type_name, "srv"), request, timeout, job)

    async def action(
        self,
        name: str,
        type_name: str,
        goal: object,
        *,
        feedback: Callable[[Any], Awaitable[None] | None] | None = None,
        timeout: float | None = None,
        job: RosRecorder | None = None,
    ) -> Any:
        """Have a goal achieved by an action server; returns the decoded result.

        `goal` is a dict of the goal's fields, a message or a payload. `feedback` is called with each decoded feedback.
        If the call is cancelled, or takes more than `timeout` seconds, the goal is cancelled. With `job` goal,
        feedback and result become part of its recording. Raises `RosGoalFailed` if the server rejects, aborts or
        cancels the goal, and what `call` raises.
        """
        self.check_open()
        name, type_name = self._node.resolve(name), full_type(type_name, "action")
        self._allow.check("call", name)
        service = f"{name}{ACTION}send_goal"
        self.types.type_hash(f"{type_name}{SEND_GOAL}")
        servers = await self._node.wait(service, TIMEOUT if timeout is None else min(TIMEOUT, timeout), "server")
        self._node.check_type(servers, f"{type_name}{SEND_GOAL}")
        client = RosActionClient(self._node, name, type_name, self._client, job)
        return await client.run(goal, feedback, timeout)

    def parameters(self, node: str, *, timeout: float = TIMEOUT, job: RosRecorder | None = None) -> RosParameters:
        """The parameters of a node (its name with namespace). Raises `ConfigurationError`."""
        node = self._node.resolve(node)
        self._allow.check("call", node)
        return RosParameters(
            node,
            lambda service, kind, request: self._call(
                f"{node}/{service}", f"rcl_interfaces/srv/{kind}", request, timeout, job
            ),
        )

    def serve(
        self,
        name: str,
        type_name: str,
        handler: Callable[[Any], Awaitable[object]],
        *,
        limit: int = ROBOT_LIMITS.requests,
    ) -> RosServer:
        """Offer a service until the robot is closed.

        `handler` takes the decoded request, and returns a dict of the reply's fields, a message or a payload. `limit`
        requests are handled at a time. Raises `ConfigurationError`, `UnknownRosType`.
        """
        self.check_open()
        name = self._node.resolve(name)
        self._allow.check("serve", name)
        server = RosServer(self._node, name, full_type(type_name, "srv"), handler, limit=limit)
        self._servers.append(server)
        return server

    def declare_parameters(
        self, values: Mapping[str, Any], *, refusal: Callable[[str, Any], str] = lambda name, value: ""
    ) -> dict[str, Any]:
        """Offer parameters of our node, once; returns their values, which change when other nodes set them.

        A value is as in `RosParameters`. `refusal` is asked about each new value, and says why it is refused; with an
        empty text it is taken. Raises `InvalidPayload` for a value that no parameter has, and what `serve` raises.
        """
        own = RosOwnParameters(values, refusal)
        for service, (kind, handler) in own.services().items():
            self.serve(f"~/{service}", f"rcl_interfaces/srv/{kind}", handler)
        return own.values

    def serve_action(
        self, name: str, type_name: str, handler: Callable[[RosGoal], Awaitable[object]]
    ) -> RosActionServer:
        """Offer an action until the robot is closed.

        `handler` achieves a goal, and returns a dict of the result's fields, a message or a payload. It is cancelled
        when the client cancels the goal; it may then return a result all the same. Raises `ConfigurationError`,
        `UnknownRosType`.
        """
        self.check_open()
        name = self._node.resolve(name)
        self._allow.check("serve", name)
        server = RosActionServer(self._node, name, full_type(type_name, "action"), handler)
        self._servers.append(server)
        return server

    async def _call(self, name: str, type_name: str, request: object, timeout: float, job: RosRecorder | None) -> Any:
        self.check_open()
        self.types.type_hash(type_name)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        self._node.check_type(await self._node.wait(name, timeout, "server"), type_name)
        return await self._client(name, type_name).call(request, timeout=deadline - loop.time(), job=job)

    def _client(self, name: str, type_name: str, type_hash: str = "") -> RosClient:
        client = self._clients.get((name, type_name))
        if client is None:
            if len(self._clients) >= ROBOT_LIMITS.endpoints:
                raise _too_many(name)
            client = self._clients[name, type_name] = RosClient(self._node, name, type_name, type_hash)
        return client

    async def _close_endpoints(self) -> None:
        servers, self._servers = self._servers, []
        for server in servers:
            await server.close()
        endpoints: list[RosPublisher | RosClient] = [*self._publishers.values(), *self._clients.values()]
        self._publishers.clear()
        self._clients.clear()
        if not self._node.session.is_closed():
            for endpoint in endpoints:
                endpoint.close()


def _too_many(name: str) -> InputError:
    why = f"{name}: this robot has {ROBOT_LIMITS.endpoints} publishers or clients already"
    return InputError(why, code="too-many-ros-endpoints")
