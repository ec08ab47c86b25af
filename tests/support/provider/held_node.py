"""A node whose answers can be held back."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import aiohttp

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.chain.rpc import Transport


class HeldNode:
    """Another node's answers: `async with HeldNode(node) as held`.

    Inside `with held.back(method)`, requests of that method are passed on only afterwards.
    """

    def __init__(self, node: str | Transport) -> None:
        self._node = node
        self._released: dict[str, asyncio.Event] = {}
        self.waiting: Counter[str] = Counter()
        """Requests that are held back, by method."""

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

    async def make_request(self, method: str, params: Any) -> Any:
        if method in self._released:
            self.waiting[method] += 1
            await self._released[method].wait()
            self.waiting[method] -= 1
        if not isinstance(self._node, str):
            return await self._node.make_request(method, params)
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        async with self._http.post(self._node, json=request) as response:
            answer: Any = await response.json()
            return answer
