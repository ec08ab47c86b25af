"""A market founded on an embedded chain, and the floor on which a test's traders and providers meet."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.market.floor import Floor
from tests.support.market import Founded, founded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.support.routers import EmbeddedRouter

__all__ = ["founded"]


@pytest.fixture
async def floor(founded: Founded, router: EmbeddedRouter) -> AsyncIterator[Floor]:
    """The market's floor of this test's own."""
    node = founded.node
    async with Floor(founded.market, router.endpoint, node=node.provider, keys=node.funded_keys) as opened:
        yield opened
