"""A market on an embedded chain that all tests share, and a local market for each test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.provider.local_market import LocalMarket

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.testing import MarketChain
    from tests.support.routers import EmbeddedRouter


@pytest.fixture
async def local(market_chain: MarketChain, router: EmbeddedRouter) -> AsyncIterator[LocalMarket]:
    """A local market for one test."""
    node = market_chain.node
    async with LocalMarket(market_chain.market, router.endpoint, node=node.provider, keys=node.funded_keys) as opened:
        yield opened
