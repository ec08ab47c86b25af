"""A market on an embedded chain that all tests share, and a local market for each test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.market.local_market import LocalMarket
from tests.support.market import Founded, founded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.routers import EmbeddedRouter

__all__ = ["founded"]


@pytest.fixture
async def local(founded: Founded, router: EmbeddedRouter) -> AsyncIterator[LocalMarket]:
    """A local market for one test."""
    node = founded.node
    async with LocalMarket(founded.market, router.endpoint, node=node.provider, keys=node.funded_keys) as opened:
        yield opened
