"""The RPC of a go-ipfs 0.4.18 daemon, answer for answer.

After `core/commands/pubsub.go` of that version: a topic is an argument as it is, each further argument is a message; a
subscription's headers go out at once and its lines hold base64; there is no list of arguments in a body. Only what a
bridge asks is there. Several daemons of a list are one swarm.
"""

from __future__ import annotations

import asyncio
import json
from base64 import b64encode
from hashlib import sha256
from itertools import count
from typing import TYPE_CHECKING, Self

from aiohttp import web

from tests.support.ports import free_port

if TYPE_CHECKING:
    from types import TracebackType

    from aiohttp.typedefs import Handler

TEXT = "application/json"
DISABLED = "experimental pubsub feature not enabled. Run daemon with --enable-pubsub-experiment to use."


class OldDaemon:
    """One daemon at `api`. `others` are its swarm; `pubsub` is the flag with which it was started."""

    version = "0.4.18"
    disabled = DISABLED

    def __init__(self, *, pubsub: bool = True, authorization: str = "") -> None:
        self.port = free_port()
        self.api = f"http://127.0.0.1:{self.port}"
        self.others: list[OldDaemon] = []
        self._pubsub = pubsub
        self._authorization = authorization
        self._identity = sha256(str(self.port).encode()).digest()
        self._sequence = count(1)
        self._subscribers: dict[str, list[asyncio.Queue[bytes]]] = {}

    @property
    def peer_id(self) -> str:
        """Its name in the swarm, as the RPC writes it in lists."""
        return f"Qm{self._identity.hex()}"

    async def __aenter__(self) -> Self:
        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self.guard(request, handler)

        app = web.Application(middlewares=[guard])
        app.router.add_route("*", "/api/v0/version", self._version)
        app.router.add_route("*", "/api/v0/id", self._id)
        app.router.add_route("*", "/api/v0/pubsub/pub", self._pub)
        app.router.add_route("*", "/api/v0/pubsub/sub", self._sub)
        app.router.add_route("*", "/api/v0/pubsub/peers", self._peers)
        self._runner = web.AppRunner(app, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", self.port).start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._runner.cleanup()

    def deliver(self, topic: str, data: bytes, sender: OldDaemon, sequence: int) -> None:
        """A message of the swarm has come."""
        for queue in self._subscribers.get(topic, []):
            queue.put_nowait(json.dumps(self.event(topic, data, sender, sequence)).encode() + b"\n")

    def event(self, topic: str, data: bytes, sender: OldDaemon, sequence: int) -> dict[str, object]:
        """A line of a subscription."""
        return {
            "from": b64encode(sender._identity).decode(),
            "data": b64encode(data).decode(),
            "seqno": b64encode(sequence.to_bytes(8, "big")).decode(),
            "topicIDs": [topic],
        }

    def topic_of(self, request: web.Request) -> str:
        """The topic that a call names."""
        (topic,) = request.query.getall("arg")
        return topic

    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer who may ask."""
        if self._authorization and request.headers.get("Authorization") != self._authorization:
            return web.Response(status=401, text="Unauthorized")
        return await self.answer(request, handler)

    async def answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer what the daemon was started for."""
        if not self._pubsub and "/pubsub/" in request.path:
            return self._refuse(self.disabled)
        return await handler(request)

    async def _version(self, request: web.Request) -> web.Response:
        return web.json_response(
            {"Version": self.version, "Commit": "", "Repo": "7", "System": "amd64/linux", "Golang": "go1.11.1"}
        )

    async def _id(self, request: web.Request) -> web.Response:
        return web.json_response({"ID": self.peer_id, "Addresses": None, "AgentVersion": f"go-ipfs/{self.version}/"})

    async def _pub(self, request: web.Request) -> web.StreamResponse:
        topic, *messages = request.query.getall("arg")
        if not messages:
            return self._refuse('argument "data" is required')
        for message in messages:
            sequence = next(self._sequence)
            for daemon in (self, *self.others):
                daemon.deliver(topic, message.encode(), self, sequence)
        return web.Response(text="", content_type=TEXT)

    async def _sub(self, request: web.Request) -> web.StreamResponse:
        topic = self.topic_of(request)
        answer = web.StreamResponse(
            headers={"Content-Type": TEXT, "X-Chunked-Output": "1", "Trailer": "X-Stream-Error"}
        )
        answer.enable_chunked_encoding()
        queue: asyncio.Queue[bytes] = asyncio.Queue()
        self._subscribers.setdefault(topic, []).append(queue)
        try:
            await answer.prepare(request)
            while True:
                await answer.write(await queue.get())
        except ConnectionError:
            return answer
        finally:
            self._subscribers[topic].remove(queue)

    async def _peers(self, request: web.Request) -> web.Response:
        topic = self.topic_of(request)
        return web.json_response({"Strings": [other.peer_id for other in self.others if other._subscribers.get(topic)]})

    def _refuse(self, why: str) -> web.Response:
        return web.json_response({"Message": why, "Code": 0, "Type": "error"}, status=500)
