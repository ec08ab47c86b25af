"""A page server at a real market: router, chain, provider."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
import pytest_asyncio
from aiohttp import ClientSession

from bridges.web._access import WebOptions
from bridges.web.components import opened
from bridges.web.server import PageServer
from mesh.testing import MarketChain
from tests.support.web.openapi import check, check_answer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from aiohttp import ClientResponse

    from tests.support.market import Place


OWN = {"X-Aira-Request": "1", "Content-Type": "application/json"}


@dataclass
class Browser:
    """Asks a page server as the page does."""

    session: ClientSession
    server: PageServer

    async def get(self, path: str, *, status: int = 200, **query: Any) -> Any:
        """The JSON at a path of the interface."""
        async with self.session.get(f"{self.server.url}/api/v1/{path}", params=query) as response:
            return await _checked("get", f"/api/v1/{path}", response, status)

    async def post(self, path: str, content: Any, *, status: int = 200, headers: dict[str, str] | None = None) -> Any:
        """Post JSON, or bytes as they are."""
        data = content if isinstance(content, bytes) else msgspec.json.encode(content)
        url = f"{self.server.url}/{path}" if path == "rpc" else f"{self.server.url}/api/v1/{path}"
        async with self.session.post(url, data=data, headers=OWN if headers is None else headers) as response:
            return await _checked("post", url.removeprefix(self.server.url), response, status)


async def _checked(method: str, path: str, response: ClientResponse, status: int) -> Any:
    """The answer, which is as documented."""
    body = await response.json()
    assert response.status == status, body
    if status < 300:
        check_answer(method, path.partition("?")[0], body)
    else:
        check({"$ref": "#/components/schemas/Error"}, body, path)
    return body


@pytest_asyncio.fixture(scope="package", loop_scope="package")
async def market_chain() -> AsyncIterator[MarketChain]:
    """One of these tests' own: a page shows the jobs and accounts of a whole chain."""
    async with MarketChain() as chain:
        yield chain


@pytest.fixture
def serve(place: Place, tmp_path: Path) -> Callable[..., AbstractAsyncContextManager[Browser]]:
    """Serves a page at the test's market: with the account of a `role`, or without one, and `settings` changed."""

    @asynccontextmanager
    async def serving(role: str = "", settings: dict[str, Any] | None = None, **options: Any) -> AsyncIterator[Browser]:
        static = tmp_path / "static"
        static.mkdir(exist_ok=True)
        (static / "index.html").write_text("<!doctype html><title>page</title>")
        given: dict[str, Any] = {"port": 0, "static": static}
        chosen = WebOptions(**(given | options))
        account = place.market.accounts[role] if role else None
        chain = place.chains[role or "provider"]
        async with (
            opened(place.settings(role or "page", **(settings or {})), account=account, chain=chain) as components,
            PageServer(components, chosen) as server,
            ClientSession() as session,
        ):
            yield Browser(session, server)

    return serving
