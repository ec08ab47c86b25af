"""The bridge: a ROS 1 system as a device and a control surface of an agent.

The legacy stack's nodes, topics and services are in the graph (`_legacy`); the topics of jobs and of boards are carried
between it and the mesh (`_topics`).
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from bridges.devices import ABOUT, DeviceAbout, DeviceTopic
from bridges.ros1._definitions import md5_of, message_types
from bridges.ros1._legacy import FILES_NODE, NODES, PLAYER_NODE, LegacyFiles, LegacyGraph
from bridges.ros1._topics import DEVICES_NODE, RosDevices, RosJobs
from bridges.ros1._wire import Ros1Error
from bridges.ros1.node import Ros1Node
from mesh.base.background import Background, call_in_loop
from mesh.base.lifecycle import Role
from mesh.base.log_context import log_event
from mesh.network.services import declared
from mesh.telemetry.metrics import MetricFamily, by_label, drop_family
from schemas.keys import IDLE, PRESENT, DeviceTopicKey
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack

    import zenoh

    from bridges.ros1._topics import RosBridgeOptions, RosBridgeParts

log = logging.getLogger(__name__)

ROSOUT: Final = "/rosout"
LOG: Final = "rosgraph_msgs/Log"


class NodeShutDown(Ros1Error, code="ros1-shut-down"):
    """Somebody shut one of the bridge's nodes down: by `rosnode kill`, or with a new node of its name."""


class Ros1Bridge(Role):
    """A ROS 1 system as a device of an agent, and its control surface. Raises `InvalidKey` for an invalid name."""

    title = "bridge to ROS 1"

    def __init__(self, parts: RosBridgeParts, options: RosBridgeOptions) -> None:
        self._parts = parts
        self._options = options
        self._graph = parts.graph
        self._session = parts.network.session
        self._key(PRESENT)

    async def _open(self, stack: AsyncExitStack) -> None:
        options, loop = self._options, asyncio.get_running_loop()
        nodes = {
            name: await stack.enter_async_context(Ros1Node(self._graph, name))
            for name in (*NODES, FILES_NODE, PLAYER_NODE, DEVICES_NODE)
        }
        self._tasks = await stack.enter_async_context(Background())
        if options.is_alone:
            await self._serve_rosout(stack)
        executor = next(iter(nodes.values()))
        self.jobs = await stack.enter_async_context(RosJobs(self._parts, options, executor))
        await stack.enter_async_context(RosDevices(self._parts, nodes[DEVICES_NODE]))
        await stack.enter_async_context(LegacyFiles(self._parts, options, nodes))
        await stack.enter_async_context(LegacyGraph(self._parts, options, nodes, self.jobs))
        for declaration in (
            self._session.liveliness().declare_token(self._key(PRESENT)),
            self._session.declare_queryable(
                self._key(ABOUT), lambda query: call_in_loop(loop, self._reply_about, query)
            ),
            self._session.declare_queryable(self._key(IDLE), lambda query: call_in_loop(loop, self._ask_idle, query)),
        ):
            stack.enter_context(declared(self._session, declaration))
        self._tasks.start(self._graph.watch(), "registrations")
        self._tasks.start(self._graph.drops.run(), "drops")

    async def _work(self) -> None:
        """Serve until one of our nodes is shut down. Raises `NodeShutDown`."""
        await self._graph.ended.wait()
        raise NodeShutDown(
            self._graph.ended_by,
            hint="was it `rosnode kill`? Or is another bridge, or the legacy stack, on this master? Stop one of them",
        )

    async def measure(self) -> tuple[MetricFamily, ...]:
        counts = {"in": self.jobs.received, "out": self.jobs.published}
        help_text = "Messages of jobs from the ROS 1 system (in) and to it (out)"
        families = by_label("aira_ros1_messages_total", "counter", help_text, "direction", counts)
        return families, drop_family(self._graph.drops), *self._parts.network.families()

    def parts(self) -> Mapping[str, str]:
        is_linked = not self._session.is_closed() and bool(self._session.info.routers_zid())
        return {
            "channel": ALIVE if is_linked else "waits for a router",
            "master": "waits for the ROS master" if self._graph.outage.is_down else ALIVE,
        }

    async def _serve_rosout(self, stack: AsyncExitStack) -> None:
        """The node that collects the logs of a graph: they go to our log, and to `/rosout_agg`."""
        node = await stack.enter_async_context(Ros1Node(self._graph, ROSOUT))
        kind = message_types()[LOG][md5_of(LOG, "3")]
        everything = await node.advertise("/rosout_agg", kind)

        def received(payload: bytes, _header: Mapping[str, str]) -> None:
            everything.publish(payload)
            if log.isEnabledFor(logging.DEBUG):
                values = kind.decode(payload)
                facts = log_event("ros1-log", node=values["name"])
                log.debug("%s: %s", values["name"], values["msg"][:1000], extra=facts)

        await node.subscribe(ROSOUT, LOG, received)

    def _ask_idle(self, query: zenoh.Query) -> None:
        self._tasks.start(self._reply_when_idle(query), "question whether ROS is idle")

    async def _reply_when_idle(self, query: zenoh.Query) -> None:
        with query:
            await self.jobs.wait_until_idle()
            query.reply(str(query.key_expr), b"")

    def _reply_about(self, query: zenoh.Query) -> None:
        topics = {topic for job in self.jobs.open for topic in self.jobs.topics(job)}
        DeviceAbout(
            name=self._options.name,
            present=True,
            port=self._graph.master,
            job=next(iter(self.jobs.open), ""),
            topics=tuple(DeviceTopic(topic, "hears") for topic in sorted(topics)),
            counters={"published": self.jobs.published, "received": self.jobs.received},
        ).reply(query)

    def _key(self, topic: str) -> str:
        return str(DeviceTopicKey(self._parts.agent, self._options.name, topic))
