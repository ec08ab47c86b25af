"""Two sessions on one router: `here` is ours, `there` that of a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest_asyncio

from mesh.network import Endpoints, Network

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from tests.support.routers import EmbeddedRouter


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
