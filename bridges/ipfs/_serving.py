"""The part of an IPFS daemon's RPC that legacy pages use, answered from the mesh: for machines without IPFS.

`new IPFS('http://localhost:5001')` of a page finds version, id, PubSub in both dialects, and files. Topics are markets:
what is published on one is verified and put on the mesh. Files are those of the mesh's stores.
"""

from __future__ import annotations

import asyncio
import tarfile
import tempfile
from base64 import b64encode, urlsafe_b64decode, urlsafe_b64encode
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec
from aiohttp import BodyPartReader, web

from mesh.base.background import Background
from mesh.base.door import DoorLimits
from mesh.base.http_server import HttpServer
from mesh.base.lifecycle import Role
from mesh.errors import AiraError, InputError
from mesh.network import Channel
from schemas import Demand, Offer, Result, cid_of_bytes, decode, encode, verify_message

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    import zenoh

    from mesh.content import Exchange, Store

    Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

VERSION: Final = "0.4.23"
"""The version that it says it is: the last one of the older dialect, which the clients of 2018 speak."""
LIMITS: Final = DoorLimits(connections=256, per_address=256)


class PubsubLimits(NamedTuple):
    """What the clients may subscribe to."""

    topics: int = 16
    """Topics in all."""
    waiting: int = 1000
    """Messages that wait for a subscriber."""


PUBSUB_LIMITS: Final = PubsubLimits()
HERE: Final = ("localhost", "127.0.0.1", "::1")
"""Where a page must come from: a page of a stranger could publish and read in its visitor's name."""


class IpfsApi(Role):
    """The RPC at `host` and `port`: `async with IpfsApi(...) as api`, then `api.url` and `run`.

    `size_limit` is of the largest file that is added or fetched, and `timeout` in seconds without a block of it.
    """

    title = "IPFS API"

    def __init__(
        self,
        session: zenoh.Session,
        store: Store,
        exchange: Exchange,
        *,
        host: str = "127.0.0.1",
        port: int = 5001,
        size_limit: int,
        timeout: float,
    ) -> None:
        self._session = session
        self._store = store
        self._exchange = exchange
        self._size_limit = size_limit
        self._timeout = timeout
        self._id = cid_of_bytes(str(session.zid()).encode())
        self._subscribers: dict[str, set[asyncio.Queue[bytes]]] = {}
        self._channels: dict[str, Channel] = {}
        app = web.Application(middlewares=[self._checked], client_max_size=size_limit + (1 << 20))
        calls: dict[str, Handler] = {
            "version": self._version,
            "id": self._identity,
            "pubsub/sub": self._subscribe,
            "pubsub/pub": self._publish,
            "pubsub/ls": self._topics,
            "pubsub/peers": self._peers,
            "add": self._add,
            "cat": self._cat,
            "get": self._get,
        }
        for name, handler in calls.items():
            for method in ("GET", "POST", "OPTIONS"):
                app.router.add_route(method, f"/api/v0/{name}", handler)
        self._server = HttpServer(app, host, port, limits=LIMITS, option="--serve-api HOST:PORT")
        self._host = host

    @property
    def url(self) -> str:
        return f"http://{self._host}:{self._server.port}"

    async def _open(self, stack: AsyncExitStack) -> None:
        self._open_channels = await stack.enter_async_context(AsyncExitStack())
        self._tasks = await stack.enter_async_context(Background())
        await stack.enter_async_context(self._server)

    async def _work(self) -> None:
        await asyncio.Event().wait()

    @web.middleware
    async def _checked(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse pages from elsewhere, and answer errors as a daemon does."""
        origin = request.headers.get("Origin", "")
        if origin and urlsplit(origin).hostname not in HERE:
            return web.json_response({"Message": "only pages of this machine", "Code": 0, "Type": "error"}, status=403)
        try:
            answer = web.Response() if request.method == "OPTIONS" else await handler(request)
        except (AiraError, ValueError, KeyError) as error:
            answer = web.json_response({"Message": str(error), "Code": 0, "Type": "error"}, status=500)
        if origin and not answer.prepared:
            answer.headers["Access-Control-Allow-Origin"] = origin
            answer.headers["Access-Control-Allow-Headers"] = "Content-Type, X-Requested-With"
        return answer

    async def _version(self, _request: web.Request) -> web.Response:
        return web.json_response({"Version": VERSION, "Commit": "", "Repo": "7", "System": "aira", "Golang": ""})

    async def _identity(self, _request: web.Request) -> web.Response:
        about = {"AgentVersion": "aira", "ProtocolVersion": "ipfs/0.1.0", "PublicKey": "", "Addresses": []}
        return web.json_response({"ID": self._id, **about})

    async def _topics(self, _request: web.Request) -> web.Response:
        return web.json_response({"Strings": [topic for topic, found in self._subscribers.items() if found]})

    async def _peers(self, request: web.Request) -> web.Response:
        channel = await self._channel(_topic(request)[0])
        return web.json_response({"Strings": [cid_of_bytes(key.agent.encode()) for key in await channel.present()]})

    async def _publish(self, request: web.Request) -> web.Response:
        """Verify a message, and put it on the mesh."""
        (topic, _), more = _topic(request), request.query.getall("arg")[1:]
        data = more[0].encode() if more else await self._file(request, 64 << 10)  # bytes of a message
        message = decode(data)
        if not isinstance(message, Demand | Offer | Result):
            raise InputError("only demands, offers and results are published here")
        verify_message(message)
        (await self._channel(topic)).publish(message)
        return web.Response()

    async def _subscribe(self, request: web.Request) -> web.StreamResponse:
        topic, is_multibase = _topic(request)
        await self._channel(topic)
        waiting: asyncio.Queue[bytes] = asyncio.Queue(PUBSUB_LIMITS.waiting)
        answer = web.StreamResponse(headers={"Content-Type": "application/json", "X-Chunked-Output": "1"})
        if origin := request.headers.get("Origin"):
            answer.headers["Access-Control-Allow-Origin"] = origin
        await answer.prepare(request)
        await answer.write(b"{}\n")  # tells clients that they are subscribed
        self._subscribers[topic].add(waiting)
        try:
            number = 0
            while True:
                number += 1
                line = self._line(topic, await waiting.get(), number, is_multibase=is_multibase)
                await answer.write(line)
        finally:
            self._subscribers[topic].discard(waiting)

    def _line(self, topic: str, data: bytes, number: int, *, is_multibase: bool) -> bytes:
        encoded = _multibase if is_multibase else lambda part: b64encode(part).decode()
        sender = self._id if is_multibase else b64encode(self._id.encode()).decode()
        fields = {
            "from": sender,
            "data": encoded(data),
            "seqno": encoded(number.to_bytes(8, "big")),
            "topicIDs": [_multibase(topic.encode()) if is_multibase else topic],
        }
        return msgspec.json.encode(fields) + b"\n"

    async def _channel(self, topic: str) -> Channel:
        """The market with that name, to which this process is subscribed from now on. Raises `InvalidKey`."""
        if topic not in self._channels:
            if len(self._channels) >= PUBSUB_LIMITS.topics:
                raise InputError(f"there are {PUBSUB_LIMITS.topics} topics already")
            channel = self._channels[topic] = await self._open_channels.enter_async_context(
                Channel(self._session, topic)
            )
            self._subscribers.setdefault(topic, set())
            for kind in (Demand, Offer, Result):
                self._tasks.start(self._hear(channel, topic, kind), f"{kind.__name__}s of {topic}")
        return self._channels[topic]

    async def _hear(self, channel: Channel, topic: str, kind: type[Demand | Offer | Result]) -> None:
        async with channel.subscribe(kind) as messages:
            async for verified in messages:
                data = encode(verified.message)
                for waiting in self._subscribers[topic]:
                    if not waiting.full():  # else its reader has stopped
                        waiting.put_nowait(data)

    async def _file(self, request: web.Request, limit: int) -> bytes:
        """The first file in a request. Raises `InputError` without one."""
        async for part in await request.multipart():
            if isinstance(part, BodyPartReader):
                data = bytearray()
                while chunk := await part.read_chunk(1 << 16):
                    data += chunk
                    if len(data) > limit:
                        raise InputError(f"more than {limit} bytes")
                return bytes(data)
        raise InputError("there is no file in the request")

    async def _add(self, request: web.Request) -> web.Response:
        """Put files into the store, from which the mesh gets them."""
        lines = []
        async for part in await request.multipart():
            if not isinstance(part, BodyPartReader):
                continue
            with tempfile.TemporaryFile() as file:
                size = 0
                while chunk := await part.read_chunk(1 << 18):
                    size += len(chunk)
                    if size > self._size_limit:
                        raise InputError(f"more than {self._size_limit} bytes")
                    await asyncio.to_thread(file.write, chunk)
                file.seek(0)
                cid = await asyncio.to_thread(self._store.put_stream, file, pin="ipfs-api")
            lines.append(msgspec.json.encode({"Name": part.filename or cid, "Hash": cid, "Size": str(size)}))
        chunked = {"X-Chunked-Output": "1"}
        return web.Response(body=b"\n".join(lines) + b"\n", content_type="application/json", headers=chunked)

    async def _cat(self, request: web.Request) -> web.StreamResponse:
        path = await self._fetched(request)
        return web.FileResponse(path, headers={"X-Stream-Output": "1", "Content-Type": "text/plain"})

    async def _get(self, request: web.Request) -> web.StreamResponse:
        """The file in a tar archive, as a daemon sends it."""
        path, cid = await self._fetched(request), request.query["arg"].removeprefix("/ipfs/")
        head = tarfile.TarInfo(cid)
        head.size = path.stat().st_size
        answer = web.StreamResponse(headers={"Content-Type": "application/x-tar", "X-Stream-Output": "1"})
        await answer.prepare(request)
        await answer.write(head.tobuf(tarfile.GNU_FORMAT))
        with path.open("rb") as file:
            while chunk := await asyncio.to_thread(file.read, 1 << 18):
                await answer.write(chunk)
        await answer.write(bytes(-head.size % tarfile.BLOCKSIZE + 2 * tarfile.BLOCKSIZE))
        return answer

    async def _fetched(self, request: web.Request) -> Any:
        cid = request.query["arg"].removeprefix("/ipfs/")
        return await self._exchange.fetch(cid, size_limit=self._size_limit, timeout=self._timeout)


def _topic(request: web.Request) -> tuple[str, bool]:
    """The topic of a call, and whether it is in the newer dialect, as the topics of markets do not begin so."""
    text = request.query["arg"]
    if text.startswith("u") and "." not in text:
        return urlsafe_b64decode(text[1:] + "=" * (-len(text[1:]) % 4)).decode(), True
    return text, False


def _multibase(data: bytes) -> str:
    return "u" + urlsafe_b64encode(data).rstrip(b"=").decode()
