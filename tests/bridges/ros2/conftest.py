"""Two sessions on one router: `here` is ours, `there` that of a robot."""

from __future__ import annotations

import itertools
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

import pytest
import pytest_asyncio

from bridges.ros2 import Robot
from mesh.network import Endpoints, Network
from tests.support.ros2.definitions import ros_types

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AbstractAsyncContextManager

    import zenoh

    from mesh.recording.ros import RosTypes
    from tests.support.routers import EmbeddedRouter

DOMAINS: Final = itertools.count(1)


@pytest.fixture
def domain() -> int:
    """A domain of the test's own."""
    return next(DOMAINS)


@pytest_asyncio.fixture
async def here(router: EmbeddedRouter) -> AsyncIterator[zenoh.Session]:
    """A client's session."""
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        yield network.session


@pytest_asyncio.fixture
async def there(router: EmbeddedRouter) -> AsyncIterator[zenoh.Session]:
    """Another client's session."""
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        yield network.session


@pytest.fixture
def our_robot(here: zenoh.Session) -> Callable[..., AbstractAsyncContextManager[Robot]]:
    """Opens a node of ours that knows the types of the peers."""

    @asynccontextmanager
    async def opened(types: RosTypes | None = None, **options: Any) -> AsyncIterator[Robot]:
        async with Robot(here, types or ros_types(), **options) as robot:
            yield robot

    return opened
