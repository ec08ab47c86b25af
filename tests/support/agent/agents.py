"""Agents for tests of the messages they receive and of their end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh import Settings
from mesh.network import Channel, Endpoints, MarketRules, Network
from tests.support.market import MODEL
from tests.support.orders import LIGHTHOUSE, MARKET
from tests.support.waiting import until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from tests.support.routers import EmbeddedRouter

SOON = 0.02


class OpenChannel(Channel):
    """A channel whose session is public, so that a test can see who listens."""

    def __init__(self, session: zenoh.Session, rules: MarketRules) -> None:
        super().__init__(session, rules)
        self.session = session


@pytest.fixture
def settings(router: EmbeddedRouter) -> Settings:
    """Settings of an agent that only watches."""
    return Settings(connect=(router.endpoint,), lighthouse_contract=MARKET)


@pytest.fixture
async def channel(router: EmbeddedRouter) -> AsyncIterator[OpenChannel]:
    """Another participant's channel of the market."""
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        OpenChannel(network.session, MarketRules(MARKET, address=LIGHTHOUSE)) as channel,
    ):
        yield channel


async def heard_on(channel: OpenChannel, kind: str) -> None:
    """Wait until a subscriber receives a kind of message."""
    await until_heard(channel.session, f"aira/{MARKET}/{kind}" if kind == "result" else f"aira/{MARKET}/{kind}/{MODEL}")
