"""A market with a robot whose ROS nodes do its work, through our bridge."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bridges.ros1._bridge import Ros1Bridge
from bridges.ros1._topics import RosBridgeOptions, RosBridgeParts
from mesh.base.background import Background
from mesh.content import Exchange, Store
from mesh.network import Channel, Endpoints, Network

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping
    from pathlib import Path

    from bridges.ros1.node import Ros1Graph
    from mesh import Agent
    from tests.support.market import Place
    from tests.support.ros1.peers import Ros, Ros1NodeProcess


@dataclass
class Scene:
    """A robot's agent and a person's at work, the bridge beside the robot, and its ROS graph."""

    place: Place
    robot: Agent
    person: Agent
    bridge: Ros1Bridge
    graph: Ros1Graph
    tools: Ros
    """The programs of ROS on this graph."""
    messages: Mapping[str, Path]

    @asynccontextmanager
    async def node(self, *words: str, generation: str = "3") -> AsyncIterator[Ros1NodeProcess]:
        """A node of rospy (a function in `nodes.py` and its arguments) that is ready."""
        async with self.tools.node(*words, messages=self.messages[generation]) as node:
            assert await node.hear() == "ready"
            yield node


@asynccontextmanager
async def bridged(
    place: Place, robot: Agent, graph: Ros1Graph, *, endpoints: Endpoints | None = None, **options: Any
) -> AsyncIterator[Ros1Bridge]:
    """The bridge beside a running robot, on the market's router or by other `endpoints`."""
    async with (
        Network(endpoints or Endpoints(connect=(place.endpoint,))) as network,
        Channel(network.session, place.market.deployment.lighthouse_name) as channel,
    ):
        store = Store(place.folder / "ros1")
        async with (
            Exchange(network.session, store) as exchange,
            Ros1Bridge(
                RosBridgeParts(
                    agent=robot.address,
                    network=network,
                    channel=channel,
                    graph=graph,
                    store=store,
                    exchange=exchange,
                    directory=place.folder / "played",
                ),
                RosBridgeOptions(**options),
            ) as bridge,
            Background() as tasks,
        ):
            tasks.start(bridge.run(), "bridge of the test")
            yield bridge
        store.close()
