"""The page of a market in this process, as `aira up` and `aira demo --web` show it."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from bridges.web.components import opened
from bridges.web.options import WebOptions
from bridges.web.server import PageServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent import Agent
    from mesh.chain import Chain
    from mesh.settings import Settings


@asynccontextmanager
async def served(
    settings: Settings, *, port: int, chain: Chain | None = None, agent: Agent | None = None
) -> AsyncIterator[str]:
    """See `mesh.page.ServePage`."""
    async with (
        opened(settings, agent=agent, chain=chain) as components,
        PageServer(components, WebOptions(port=port)) as server,
    ):
        yield server.url
