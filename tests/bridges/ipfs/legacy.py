"""Somebody of 2018 with an IPFS daemon: knows its HTTP RPC and nothing of the mesh, not even this project's code."""

from __future__ import annotations

import asyncio
import json
from base64 import urlsafe_b64decode, urlsafe_b64encode
from typing import TYPE_CHECKING, Any, Self

import aiohttp

if TYPE_CHECKING:
    from types import TracebackType


def multibase(data: bytes) -> str:
    """As today's daemons write bytes."""
    return "u" + urlsafe_b64encode(data).decode().rstrip("=")


class Bare:
    """A client of the daemon whose RPC is at `api`. `heard` is what it heard since `listen` returned.

    `pause` seconds follow on each message: a Kubo drops what it checks after a later message of the same node, and it
    checks those that come together in any order.
    """

    def __init__(self, api: str, *, pause: float = 0.02) -> None:
        self._api = api
        self._pause = pause
        self.heard: list[bytes] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._http = aiohttp.ClientSession()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)
        await self._http.close()

    async def call(self, name: str, *arguments: tuple[str, str], content: bytes | None = None) -> Any:
        """A call that answers one JSON object, or nothing."""
        form = None
        if content is not None:
            form = aiohttp.FormData()
            form.add_field("file", content, filename="f", content_type="application/octet-stream")
        async with self._http.post(f"{self._api}/api/v0/{name}", params=arguments, data=form) as answer:
            text = await answer.text()
            assert answer.status == 200, f"{name}: {answer.status} {text}"
            return json.loads(text) if text else None

    async def listen(self, topic: str) -> None:
        """Hear what is said on `topic` from now on."""
        forever = aiohttp.ClientTimeout(total=None)
        arguments = {"arg": multibase(topic.encode())}
        answer = await self._http.post(f"{self._api}/api/v0/pubsub/sub", params=arguments, timeout=forever)
        self._tasks.append(asyncio.create_task(self._hear(answer), name=f"hears {topic}"))

    async def publish(self, topic: str, data: bytes) -> None:
        """Say `data` on `topic`, again while a Kubo has checked a later message of its own before this one."""
        while True:
            try:
                await self.call("pubsub/pub", ("arg", multibase(topic.encode())), content=data)
            except AssertionError as refused:
                if "validation ignored" not in str(refused):
                    raise
            else:
                await asyncio.sleep(self._pause)
                return

    async def peers(self, topic: str) -> list[str]:
        """The other nodes that this one's daemon knows on `topic`."""
        found: list[str] = (await self.call("pubsub/peers", ("arg", multibase(topic.encode()))))["Strings"] or []
        return found

    async def cat(self, name: str) -> bytes:
        """The file of that name."""
        async with self._http.post(f"{self._api}/api/v0/cat", params={"arg": name}) as answer:
            assert answer.status == 200, await answer.text()
            return await answer.read()

    async def _hear(self, answer: aiohttp.ClientResponse) -> None:
        async with answer:
            async for line in answer.content:
                data = json.loads(line).get("data")
                if data is not None:
                    self.heard.append(urlsafe_b64decode(data[1:] + "=" * (-len(data[1:]) % 4)))
