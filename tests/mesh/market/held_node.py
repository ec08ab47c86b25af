"""A node whose answers can be held back."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import aiohttp
from web3.providers.async_base import AsyncBaseProvider

if TYPE_CHECKING:
    from collections.abc import Iterator

    from web3.types import RPCEndpoint, RPCResponse


class HeldNode(AsyncBaseProvider):
    """Another node's answers: `async with HeldNode(node) as held`.

    Inside `with held.back(method)`, requests of that method are passed on only afterwards.
    """

    def __init__(self, node: str | AsyncBaseProvider) -> None:
        super().__init__()
        self._node = node
        self._released: dict[str, asyncio.Event] = {}

    async def __aenter__(self) -> Self:
        self._http = aiohttp.ClientSession()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._http.close()

    @contextmanager
    def back(self, method: str) -> Iterator[None]:
        """Answer requests of this method after the end of the body."""
        released = self._released[method] = asyncio.Event()
        try:
            yield
        finally:
            del self._released[method]
            released.set()

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        if method in self._released:
            await self._released[method].wait()
        if not isinstance(self._node, str):
            return await self._node.make_request(method, params)
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        async with self._http.post(self._node, json=request) as response:
            answer: RPCResponse = await response.json()
            return answer
