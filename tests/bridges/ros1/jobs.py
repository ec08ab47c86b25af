"""A market with a robot whose ROS nodes do its work, through our bridge."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bridges.ros1._bridge import Ros1Bridge, RosBridgeOptions
from mesh.base.background import Background
from mesh.content import Exchange, Store
from mesh.network import Channel, Endpoints, Network

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from bridges.ros1.node import Ros1Graph
    from mesh import Agent
    from tests.support.market import Place


@dataclass
class Bridged:
    """The bridge at work, and its graph."""

    bridge: Ros1Bridge
    graph: Ros1Graph
    network: Network


@asynccontextmanager
async def bridged(place: Place, robot: Agent, graph: Ros1Graph, **options: Any) -> AsyncIterator[Bridged]:
    """The bridge beside a running robot."""
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Channel(network.session, place.market.deployment.lighthouse_name) as channel,
    ):
        store = Store(place.folder / "ros1")
        async with (
            Exchange(network.session, store) as exchange,
            Ros1Bridge(
                network.session, channel, graph, store, exchange,
                agent=robot.address, directory=place.folder / "played", options=RosBridgeOptions(**options),
            ) as bridge,
            Background() as tasks,
        ):  # fmt: skip
            tasks.start(bridge.run(), "bridge of the test")
            yield Bridged(bridge, graph, network)
        store.close()
