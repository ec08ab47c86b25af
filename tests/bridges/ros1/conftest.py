"""Both masters, real ROS 1 on one of them, and the legacy network's messages of each generation as Python."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ros1._definitions import write_workspace
from bridges.ros1.master import RosMaster
from bridges.ros1.node import Ros1Graph
from mesh.base.flood import Drops
from tests.support.peers import require
from tests.support.ros1.jobs import Scene, bridged
from tests.support.ros1.peers import Ros, RosMasterServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from contextlib import AbstractAsyncContextManager

    from tests.support.market import Place


@pytest.fixture(scope="session")
def rosmaster() -> Iterator[RosMasterServer]:
    """The master of ROS, for all tests: their nodes have names of their own."""
    with RosMasterServer() as server:
        yield server


class Messages(dict[str, Path]):
    """The folder with the messages of each generation, made when it is needed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __missing__(self, generation: str) -> Path:
        write_workspace(self._folder / generation, generation)
        self[generation] = self._folder / generation
        return self[generation]


@pytest.fixture(scope="session")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The messages of each generation, as `aira bridge ros1 --messages` writes them."""
    require("genpy")
    return Messages(tmp_path_factory.mktemp("messages"))


@pytest.fixture
def graph() -> Callable[[], AbstractAsyncContextManager[Ros1Graph]]:
    """Opens a graph of ours on a master of ours."""

    @asynccontextmanager
    async def opened() -> AsyncIterator[Ros1Graph]:
        drops = Drops()
        async with RosMaster("127.0.0.1", 0, drops) as master:
            yield Ros1Graph(master.uri, drops=drops)

    return opened


@pytest.fixture
def scene(
    place: Place,
    graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]],
    ros: Callable[[str], Ros],
    messages: dict[str, Path],
) -> Callable[..., AbstractAsyncContextManager[Scene]]:
    """Opens a market with a robot behind the bridge, whose options are given, for a minute and a half at most."""

    @asynccontextmanager
    async def opened(*, open_services: bool = True, bag_results: bool = False, **options: Any) -> AsyncIterator[Scene]:
        robot = place.agent("robot", open_services=open_services, bag_results=bag_results)
        async with (
            asyncio.timeout(90),
            graph() as here,
            place.at_work(robot) as person,
            bridged(place, robot, here, **options) as bridge,
        ):
            yield Scene(place, robot, person, bridge, here, ros(here.master), messages)

    return opened


@pytest.fixture
def ros(tmp_path: Path) -> Callable[[str], Ros]:
    """The programs of ROS on a master."""
    return lambda master: Ros(master, tmp_path)
