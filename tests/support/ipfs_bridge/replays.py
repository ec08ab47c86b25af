"""Replays of the RPC of two generations of daemons, for the calls that a bridge makes.

`OldDaemon` is go-ipfs 0.4.18, after its `core/commands/pubsub.go`: any method; a topic is an argument as it is, each
further argument is a message; the lines of a subscription hold base64.

`RecentDaemon` is a Kubo of 2026, after its `core/commands/pubsub.go`, `core/corehttp/commands.go`,
`core/node/libp2p/pubsub.go` and the `http` of go-ipfs-cmds: POST only; topics and data in base64url behind a `u`;
published data is a file; browsers and clients without a listed `Authorization` get 403 as plain text. Since 0.40 a
message whose number is validated after a higher one of the same node is refused with `validation ignored` by the node
itself, and silently dropped by others.

Both send the headers of a subscription at once, without the first line `{}` of js-ipfs.
"""

from __future__ import annotations

import asyncio
import json
from abc import ABC, abstractmethod
from base64 import b64encode, urlsafe_b64decode, urlsafe_b64encode
from hashlib import sha256
from itertools import count
from typing import TYPE_CHECKING, ClassVar, Self

from aiohttp import web

from tests.support.ports import free_port

if TYPE_CHECKING:
    from types import TracebackType

    from aiohttp.typedefs import Handler

TEXT = "application/json"
DENIED = (
    "Kubo RPC Access Denied: Please provide a valid authorization token as defined in the API.Authorizations "
    "configuration."
)


class Replay(ABC):
    """One daemon at `api`. `others` are the rest of its swarm; `pubsub` is the setting with which it was started."""

    version: ClassVar[str]
    disabled: ClassVar[str]
    """Its error while PubSub is disabled."""

    def __init__(self, *, pubsub: bool = True, authorization: str = "") -> None:
        self.port = free_port()
        self.api = f"http://127.0.0.1:{self.port}"
        self.others: list[Replay] = []
        self._pubsub = pubsub
        self._authorization = authorization
        self.identity = sha256(str(self.port).encode()).digest()
        self._sequence = count(1)
        self._subscribers: dict[str, list[asyncio.Queue[bytes]]] = {}

    @property
    def peer_id(self) -> str:
        """Its peer id, as the RPC writes it in lists."""
        return f"Qm{self.identity.hex()}"

    async def __aenter__(self) -> Self:
        @web.middleware
        async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
            if (denied := self.denies(request)) is not None:
                return denied
            if not self._pubsub and "/pubsub/" in request.path:
                return refusal(self.disabled)
            return await handler(request)

        app = web.Application(middlewares=[guarded])
        app.router.add_route("*", "/api/v0/version", self._version)
        app.router.add_route("*", "/api/v0/id", self._id)
        app.router.add_route("*", "/api/v0/swarm/peers", self._swarm_peers)
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

    def listens(self, topic: str) -> bool:
        """Whether it is subscribed to `topic`."""
        return bool(self._subscribers.get(topic))

    def deliver(self, topic: str, data: bytes, sender: Replay, sequence: int) -> None:
        """Deliver a message of the swarm to the subscribers."""
        for queue in self._subscribers.get(topic, []):
            queue.put_nowait(json.dumps(self.event(topic, data, sender, sequence)).encode() + b"\n")

    @abstractmethod
    def denies(self, request: web.Request) -> web.Response | None:
        """The response to a client without access, None for others."""

    @abstractmethod
    def topic_of(self, request: web.Request) -> str:
        """The topic of a call."""

    @abstractmethod
    def event(self, topic: str, data: bytes, sender: Replay, sequence: int) -> dict[str, object]:
        """A line of a subscription."""

    @abstractmethod
    async def _pub(self, request: web.Request) -> web.StreamResponse:
        """Publish."""

    async def _version(self, request: web.Request) -> web.Response:
        return web.json_response(
            {"Version": self.version, "Commit": "", "Repo": "7", "System": "amd64/linux", "Golang": "go1.11.1"}
        )

    async def _id(self, request: web.Request) -> web.Response:
        return web.json_response({"ID": self.peer_id, "Addresses": None, "AgentVersion": f"kubo/{self.version}/"})

    async def _swarm_peers(self, request: web.Request) -> web.Response:
        # Without peers the list is null, not empty.
        return web.json_response({"Peers": [{"Addr": "", "Peer": other.peer_id} for other in self.others] or None})

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
        return web.json_response({"Strings": [other.peer_id for other in self.others if other.listens(topic)]})


class OldDaemon(Replay):
    """A go-ipfs of 2018, behind a proxy that requires `authorization` if it is given."""

    version = "0.4.18"
    disabled = "experimental pubsub feature not enabled. Run daemon with --enable-pubsub-experiment to use."

    def denies(self, request: web.Request) -> web.Response | None:
        if self._authorization and request.headers.get("Authorization") != self._authorization:
            return web.Response(status=401, text="Unauthorized")
        return None

    def topic_of(self, request: web.Request) -> str:
        (topic,) = request.query.getall("arg")
        return topic

    def event(self, topic: str, data: bytes, sender: Replay, sequence: int) -> dict[str, object]:
        return {
            "from": b64encode(sender.identity).decode(),
            "data": b64encode(data).decode(),
            "seqno": b64encode(sequence.to_bytes(8, "big")).decode(),
            "topicIDs": [topic],
        }

    async def _pub(self, request: web.Request) -> web.StreamResponse:
        topic, *messages = request.query.getall("arg")
        if not messages:
            return refusal('argument "data" is required')
        for message in messages:
            sequence = next(self._sequence)
            for daemon in (self, *self.others):
                daemon.deliver(topic, message.encode(), self, sequence)
        return web.Response(text="", content_type=TEXT)


class RecentDaemon(Replay):
    """A Kubo of 2026; `authorization` is listed in its `API.Authorizations` with all paths that a bridge needs.

    It waits `slow` seconds between numbering and validating every second message of its own, and `busy` seconds between
    receiving and validating every second message of others, so that concurrent messages are validated out of order.
    """

    version = "0.44.0"
    disabled = "experimental pubsub feature not enabled, run daemon with --enable-pubsub-experiment to use"

    def __init__(self, *, pubsub: bool = True, authorization: str = "", slow: float = 0.0, busy: float = 0.0) -> None:
        super().__init__(pubsub=pubsub, authorization=authorization)
        self.slow = slow
        self.busy = busy
        self.refused_as_replay = 0
        """Messages of its own that it refused."""
        self.numbered = 0
        """The number of its own last message."""
        self.validates = asyncio.Event()
        """While it is cleared, every second message of its own waits to be validated."""
        self.validates.set()
        self.lost = 0
        """Messages of others that it dropped."""
        self._highest: dict[Replay, int] = {}

    def denies(self, request: web.Request) -> web.Response | None:
        if request.method != "POST":
            return web.Response(status=405, text="405 - Method Not Allowed\n")
        browser = request.headers.get("User-Agent", "").startswith("Mozilla")
        if browser or {"Origin", "Referer"} & request.headers.keys():
            return web.Response(status=403, text="403 - Forbidden\n")
        if self._authorization and request.headers.get("Authorization") != self._authorization:
            return web.Response(status=403, text=f"{DENIED}\n")
        return None

    def topic_of(self, request: web.Request) -> str:
        (text,) = request.query.getall("arg")
        if not text.startswith("u"):
            raise web.HTTPInternalServerError(text=refusal("URL arg must be base64url encoded").text)
        return urlsafe_b64decode(text[1:] + "=" * (-len(text[1:]) % 4)).decode()

    def event(self, topic: str, data: bytes, sender: Replay, sequence: int) -> dict[str, object]:
        return {
            "from": sender.peer_id,
            "data": multibase(data),
            "seqno": multibase(sequence.to_bytes(8, "big")),
            "topicIDs": [multibase(topic.encode())],
        }

    def deliver(self, topic: str, data: bytes, sender: Replay, sequence: int) -> None:
        if sender is self:
            super().deliver(topic, data, sender, sequence)
        else:
            loop = asyncio.get_running_loop()
            loop.call_later(self.busy * (sequence % 2), self._check, topic, data, sender, sequence)

    async def _pub(self, request: web.Request) -> web.StreamResponse:
        topic = self.topic_of(request)
        part = await (await request.multipart()).next()
        data = await part.read()  # type: ignore[union-attr]
        self.numbered = sequence = next(self._sequence)
        if sequence % 2:
            await asyncio.sleep(self.slow)
            await self.validates.wait()
        if not self._is_next(self, sequence):
            self.refused_as_replay += 1
            return refusal("validation ignored")
        for daemon in (self, *self.others):
            daemon.deliver(topic, bytes(data), self, sequence)
        return web.Response(text="", content_type="text/plain")

    def _check(self, topic: str, data: bytes, sender: Replay, sequence: int) -> None:
        if self._is_next(sender, sequence):
            super().deliver(topic, data, sender, sequence)
        else:
            self.lost += 1

    def _is_next(self, sender: Replay, sequence: int) -> bool:
        if sequence <= self._highest.get(sender, 0):
            return False
        self._highest[sender] = sequence
        return True


def multibase(data: bytes) -> str:
    """Bytes as current daemons write them."""
    return "u" + urlsafe_b64encode(data).decode().rstrip("=")


def refusal(why: str) -> web.Response:
    """The error response of a command."""
    return web.json_response({"Message": why, "Code": 0, "Type": "error"}, status=500)
